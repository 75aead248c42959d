"""Searches a run's checkpoints, workspace and agent log for code that looks like a simulator.

Everything is read as text; nothing is run. Runs whose rules allow simulation are not searched.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.processes.left_files import left_files
from evopolicy_common.regular_files import open_regular, read_regular
from evopolicy_results.code.sources import MAX_FILE_BYTES
from evopolicy_results.simulators.code import Code
from evopolicy_results.simulators.signs import FLAGGED, Kind, Sign, signs_of, with_numbers

MAX_FLAGS = 20
"""Maximum number of kept places per run."""
_QUOTED_LINES, _QUOTED_CHARS = 10, 160
_MAX_FILES, _MAX_LOG_BYTES, _MAX_LOG_LINE, _MAX_LOG_PIECES = 200, 64 << 20, 1 << 20, 200
_LIBRARIES = frozenset({"site-packages", "node_modules", "__pycache__", "dist-packages"})
_NUMBER = re.compile(rb"(?<![\w.])\d[\d_]*(?:\.\d+)?(?:[eE][+-]?\d+)?")
_HERE_DOCUMENT = re.compile(r"<<-?\s*(['\"]?)(\w+)\1[^\n]*\n(.*?)\n\2\b", re.DOTALL)


class Flag(msgspec.Struct, frozen=True, kw_only=True):
    """Code in one place that looks like a simulator."""

    kind: Kind
    submits: tuple[int, ...]
    """Indices of the submits whose checkpoints contain it; empty if found elsewhere."""
    path: str
    """`system/…` of a checkpoint, `workspace/…`, or `logs/agent.jsonl:LINE` for code in a command or a message."""
    line: int
    end_line: int
    """1-based, inclusive; in that file, or in the piece of the log."""
    points: float
    reasons: tuple[str, ...]
    quote: tuple[str, ...]
    """The lines as the agent wrote them, shortened."""


def flags_of(
    checkpoints: Iterable[tuple[int, Mapping[str, bytes]]], workspace: Path, log: Path | None, env: str
) -> tuple[Flag, ...]:
    """Flags in the Python files of each submit (index, files by path), in the workspace and in the log.

    The same lines in several submits are one flag; lines of the workspace that a checkpoint contains too are not
    repeated. Strongest first, at most `MAX_FLAGS`.
    """
    found: dict[tuple[str, tuple[str, ...]], Flag] = {}
    for index, files in checkpoints:
        for sign, quote in look(files, env):
            flag = _flag(sign, quote, f"system/{sign.path}", (index,))
            known = found.setdefault((sign.path.rsplit("/", 1)[-1], quote), flag)
            if known is not flag:
                found[sign.path.rsplit("/", 1)[-1], quote] = msgspec.structs.replace(
                    known, submits=(*known.submits, index)
                )
    left = _left(workspace)
    for sign, quote in look(left, env):
        found.setdefault(
            (sign.path.rsplit("/", 1)[-1], quote), _flag(sign, quote, f"workspace/{sign.path}", ())
        )
    quoted = {quote for _, quote in found}
    for line, piece in _pieces(log) if log is not None else ():
        for sign, quote in look({"piece.py": piece}, env):
            if quote not in quoted:
                quoted.add(quote)
                name = f"logs/agent.jsonl:{line}"
                found[name, quote] = _flag(sign, quote, name, ())
    return tuple(sorted(found.values(), key=lambda flag: (-flag.points, flag.path, flag.line))[:MAX_FLAGS])


def look(files: Mapping[str, bytes], env: str) -> list[tuple[Sign, tuple[str, ...]]]:
    """Flagged signs of one bundle of files (path to source), each with its lines quoted."""
    signs = [with_numbers(sign, files[sign.path], env) for sign in _signs(files)]
    return [(sign, _quoted(files[sign.path], sign)) for sign in signs if sign.points >= FLAGGED]


_known: OrderedDict[bytes, tuple[Sign, ...]] = OrderedDict()
_MAX_KNOWN = 4096


def _signs(files: Mapping[str, bytes]) -> tuple[Sign, ...]:
    """Cached by the files without their numbers: edits of constants, most of a run's edits, are analysed once."""
    digest = hashlib.sha256()
    for path, source in files.items():
        digest.update(b"\0" + path.encode("utf-8", "replace") + b"\0" + _NUMBER.sub(b"0", source))
    key = digest.digest()
    if key not in _known:
        try:
            _known[key] = tuple(signs_of(Code(files)))
        except RecursionError:
            _known[key] = ()
        if len(_known) > _MAX_KNOWN:
            _known.popitem(last=False)
    return _known[key]


def _quoted(source: bytes, sign: Sign) -> tuple[str, ...]:
    lines = source.decode("utf-8", "replace").splitlines()
    kept = [line[:_QUOTED_CHARS] for line in lines[sign.line - 1 : sign.end_line]]
    if len(kept) > _QUOTED_LINES:
        kept = [*kept[: _QUOTED_LINES - 1], f"… {len(kept) - _QUOTED_LINES + 1} more lines"]
    return tuple(kept)


def _flag(sign: Sign, quote: tuple[str, ...], path: str, submits: tuple[int, ...]) -> Flag:
    return Flag(
        kind=sign.kind,
        submits=submits,
        path=path,
        line=sign.line,
        end_line=sign.end_line,
        points=sign.points,
        reasons=sign.reasons,
        quote=quote,
    )


def _left(workspace: Path) -> dict[str, bytes]:
    """Python files left in the workspace, except the feedback, by path."""
    found: dict[str, bytes] = {}
    for path, size in left_files(workspace, enter=lambda name: name not in _LIBRARIES):
        name = path.relative_to(workspace).as_posix()
        if path.suffix == ".py" and size <= MAX_FILE_BYTES and not name.startswith("feedback/"):
            try:
                found[name] = read_regular(path, MAX_FILE_BYTES)
            except OSError:
                continue
            if len(found) >= _MAX_FILES:
                break
    return found


def _pieces(log: Path) -> Iterator[tuple[int, bytes]]:
    """Python in an agent's log, with its line number: here-documents, and texts that are code as a whole."""
    seen: set[str] = set()
    try:
        lines = open_regular(log)
    except OSError:
        return
    with lines:
        if os.fstat(lines.fileno()).st_size > _MAX_LOG_BYTES:
            return
        for number, line in enumerate(lines, start=1):
            if (
                len(line) > _MAX_LOG_LINE
                or b"\\n" not in line
                or not any(word in line for word in (b"for ", b"while ", b"import "))
            ):
                continue
            try:
                value = json.loads(line)
            except (ValueError, RecursionError):
                continue
            for text in _texts(value):
                for piece in (*(found[2] for found in _HERE_DOCUMENT.findall(text)), text):
                    if piece.count("\n") > 2 and piece not in seen:
                        seen.add(piece)
                        yield number, piece.encode("utf-8", "replace")
            if len(seen) >= _MAX_LOG_PIECES:
                return


def _texts(node: Any) -> Iterator[str]:
    """The texts in a JSON value, including nested ones."""
    queue = [node]
    while queue:
        value = queue.pop()
        if isinstance(value, str):
            yield value
        elif isinstance(value, dict):
            queue += value.values()
        elif isinstance(value, list):
            queue += value
