"""Edits of JSON files in place."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def edited(path: Path) -> Iterator[Any]:
    """The file's document, which is written back as it is at the end."""
    document = json.loads(path.read_bytes())
    yield document
    overwrite(path, json.dumps(document))


def overwrite(path: Path, content: str | bytes) -> None:
    """Writes a file that may be read-only."""
    path.chmod(0o644)
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def put(*path: str | int, value: Any) -> Callable[[Any], None]:
    """Sets a part of a document, which has another value before."""

    def change(document: Any) -> None:
        for step in path[:-1]:
            document = document[step]
        assert document[path[-1]] != value
        document[path[-1]] = value

    return change
