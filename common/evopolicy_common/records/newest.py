"""Recognises files of the newest published software, EvoPolicyGym 0.3.0, which evopolicy names and does not read."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_common.regular_files import read_regular

_NAMES = {
    "evopolicygym/run-record/": (
        "a run of EvoPolicyGym{version}, which evopolicy does not read; play a policy of it with"
        " `evopolicy try RUN/submissions/ID/program --env ENVIRONMENT`"
    ),
    "evopolicygym/leaderboard-results/": (
        "leaderboard results of EvoPolicyGym{version}, whose scores are of other cases than"
        " evopolicy's; play the entries' policies with `evopolicy try PROGRAM --env ENVIRONMENT` to compare them"
    ),
    "evopolicygym/": (
        "a file of EvoPolicyGym{version}, which evopolicy does not read; it plays policies of that software:"
        " `evopolicy try PROGRAM --env ENVIRONMENT`"
    ),
}
"""Start of a file's `schema` to a description, with one sentence on what can be done instead."""
_POLICY = (
    "a policy of EvoPolicyGym 0.3.0 (`make_policy`); play it with `evopolicy try {path} --env ENVIRONMENT`,"
    " or submit it as a run's system/"
)
_FILES = ("run.json", "results.json")
_MAX_BYTES = 64 << 20
_MAKES = re.compile(rb"^(def make_policy\(|make_policy = )", re.MULTILINE)


class _Header(msgspec.Struct):
    schema: str = ""
    library_version: str = ""


_decoder = msgspec.json.Decoder(_Header)


def described_data(data: bytes) -> str:
    """The description of such a file by its bytes; empty for any other."""
    try:
        record = _decoder.decode(data)
    except DECODE_ERRORS:
        return ""
    version = f" {record.library_version[:20]}" if record.library_version.isprintable() else ""
    texts = (text for start, text in _NAMES.items() if record.schema.startswith(start))
    return next(texts, "").format(version=version.rstrip())


def described(path: Path) -> str:
    """The description of such a file, run directory or program folder; empty for any other."""
    for file in [path / name for name in _FILES] if path.is_dir() else [path]:
        if text := described_data(_read(file)):
            return text
    policies = (folder / "policy.py" for folder in (path, path / "program"))
    if path.is_dir() and any(_MAKES.search(_read(file)) for file in policies):
        return _POLICY.format(path=path)
    return ""


def _read(path: Path) -> bytes:
    try:
        return read_regular(path, _MAX_BYTES, links=True)
    except (OSError, ValueError):
        return b""
