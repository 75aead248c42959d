"""All signals of one run: from a run directory, or from published results."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_common.processes.left_files import left_files
from evopolicy_common.regular_files import open_regular, read_regular
from evopolicy_results.scan.code import code_signals, file_signals
from evopolicy_results.scan.copies import copied_actions
from evopolicy_results.scan.log import log_signals
from evopolicy_results.scan.signals import MAX_SIGNALS, TITLES, Files, Signal, Trajectories

_MAX_FILES, _MAX_FILE_BYTES, _MAX_LOG_BYTES = 200, 4 << 20, 64 << 20
_MAX_RUN_BYTES = 256 << 20
"""Different files of a run's checkpoints that are searched."""
_SEARCHED = (".py", ".json", ".npy", ".npz", ".csv", ".txt")
_LIBRARIES = frozenset({"__pycache__", "site-packages", "dist-packages", "node_modules"})
"""Folders that are not searched."""
_MAX_ROWS = 20_000
"""Rows of a submit's trajectories that are read."""


def scan(
    checkpoints: Iterable[tuple[int, Files]],
    log: Iterable[bytes],
    trajectories: Trajectories,
    *,
    env: str = "",
    workspace: Files | None = None,
) -> tuple[Signal, ...]:
    """All signals of a run: `checkpoints` in order (submit index, files by path), the lines of its log, and the train
    actions of each submit. At most `MAX_SIGNALS` of each kind; equal evidence counts once.

    `env` and the Python files of the `workspace` are given for a run whose agent must not simulate: numbers of the
    environment's dynamics are searched, and simulators in the workspace."""
    signals: dict[tuple[str, str, str], Signal] = {}
    kept = _kept(checkpoints)
    for index, files in kept:
        for one in code_signals(index, files, env):
            key = (one.kind, one.path, one.quote)
            known = signals.setdefault(key, one)
            if known is not one:
                signals[key] = msgspec.structs.replace(known, submits=(*known.submits, index))
    for one in (*copied_actions(kept, trajectories), *log_signals(log)):
        signals.setdefault((one.kind, one.path.partition(":")[0], one.quote), one)
    known_quotes = {(one.path.rpartition("/")[2], one.quote) for one in signals.values()}
    for path, source in (workspace or {}).items():
        for one in file_signals(f"workspace/{path}", source, env):
            if one.kind == "simulator" and (path.rpartition("/")[2], one.quote) not in known_quotes:
                signals.setdefault((one.kind, one.path, one.quote), one)
    ordered = sorted(signals.values(), key=lambda one: (one.path, one.line))
    return tuple(one for kind in TITLES for one in [o for o in ordered if o.kind == kind][:MAX_SIGNALS])


def _kept(checkpoints: Iterable[tuple[int, Files]]) -> list[tuple[int, Files]]:
    """The files that are searched, each content once in memory, as a run may have thousands of checkpoints."""
    contents: dict[bytes, bytes] = {}
    remaining = _MAX_RUN_BYTES
    kept: list[tuple[int, Files]] = []
    for index, files in checkpoints:
        searched: dict[str, bytes] = {}
        for path, data in files.items():
            new = 0 if data in contents else len(data)
            if path.endswith(_SEARCHED) and new <= remaining:
                remaining -= new
                searched[path] = contents.setdefault(data, data)
        kept.append((index, searched))
    return kept


def policy_files(folder: Path) -> dict[str, bytes]:
    """The files of a checkpoint's policy by path, without large ones; empty when they cannot be read."""
    return _files(
        folder, lambda name: name.endswith(_SEARCHED) and not name.endswith(("_meta.json", "metrics.json"))
    )


def workspace_files(workspace: Path) -> dict[str, bytes]:
    """The Python files of a workspace by path, without its feedback, libraries, and large files."""
    return _files(workspace, lambda name: name.endswith(".py") and not name.startswith("feedback/"))


def _files(folder: Path, wanted: Callable[[str], bool]) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    for path, size in left_files(folder, enter=lambda name: name not in _LIBRARIES):
        name = path.relative_to(folder).as_posix()
        if wanted(name) and size <= _MAX_FILE_BYTES:
            with suppress(OSError):
                files[name] = read_regular(path, _MAX_FILE_BYTES)
        if len(files) >= _MAX_FILES:
            break
    return files


def log_lines(path: Path | None) -> Iterator[bytes]:
    """The lines of an agent's log; none for a missing or huge file, or for anything but a regular file."""
    try:
        if path is None or path.stat().st_size > _MAX_LOG_BYTES:
            return
        with open_regular(path) as lines:
            yield from lines
    except OSError:
        return


class _Row(msgspec.Struct):
    action: Any = None


_rows = msgspec.json.Decoder(_Row)


def feedback_actions(submit: Path) -> Iterator[list[Any]]:
    """The actions of each train episode in a submit's feedback folder."""
    remaining = _MAX_ROWS
    for path in sorted(submit.glob("episodes/*/trajectory.jsonl")):
        actions = []
        try:
            if path.stat().st_size > _MAX_LOG_BYTES:
                continue
            with open_regular(path) as lines:
                for line in itertools.islice(lines, remaining):
                    remaining -= 1
                    actions.append(_rows.decode(line).action)
        except (OSError, *DECODE_ERRORS):
            continue
        yield actions
        if remaining <= 0:
            return
