"""Reads lines of JSON that others have written, such as logs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS


def objects(lines: Iterable[bytes]) -> Iterator[dict[str, Any]]:
    """The JSON objects among the lines, in order; all other lines are skipped."""
    for line in lines:
        try:
            value = msgspec.json.decode(line)
        except DECODE_ERRORS:
            continue
        if isinstance(value, dict):
            yield value
