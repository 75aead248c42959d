"""Differences between two run directories, except for the published lists `EXCLUDED_FILES` and `EXCLUDED_FIELDS`.

All else must be equal byte for byte, JSON files except for the excluded fields: the same agent on the same cases gives
the same run, independent of the number of workers, their order, and failures.
"""

from __future__ import annotations

import filecmp
import fnmatch
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.messages.run_settings import AllConditions
from evopolicy_common.processes.left_files import left_files
from evopolicy_common.regular_files import MAX_BYTES, read_regular

EXCLUDED_FILES: Mapping[str, str] = {
    "logs/*": "what happened on the way, with its times",
    ".passed.json": "digests with a key of the run's own",
    ".replay.json": "the run's own addresses",
    "workspace/AGENTS.md": "names the gateway's port and its random token",
}
"""Path patterns in a run directory that are not compared, with the reason."""

EXCLUDED_FIELDS: Mapping[str, Mapping[str, str]] = {
    "run.json": {
        "exp_id": "the run's own name",
        "attempt": "counts what was begun anew",
        "run": "the coordinator's name of the run",
        "replay_of": "the coordinator's name of another run",
        "timing": "times",
        "agent.retries": "counts what was asked again",
        "agent.resources": "what the agent used of its machine, and how that one limits it",
        "agent.model_use.first_token_s": "a time",
        "outcome.auxiliary.infrastructure_retries": "counts what was played again",
        "rejected_submits.at": "a time",
        "committed": "the run's own place in the journal, and a random salt",
        "versions.agents_md_hash": "of a file that names the gateway's port",
        "versions.installations": "which workers played; what decides their numbers is in versions.fingerprint",
    },
    "summary.json": {
        "submit_started_at": "a time",
        "submit_completed_at": "a time",
        "wall_time_seconds": "a time",
    },
    "_meta.json": {"submit_time": "a time"},
    "errors.txt": {"timestamp": "a time"},
    "error.txt": {"timestamp": "a time"},
}
"""Fields that are not compared, by the name of their file, with the reason. The text files hold JSON lines."""

_USUAL = {
    f"experiment_dimensions.{field.name}": field.default for field in msgspec.structs.fields(AllConditions)
}
"""By path in `run.json`, the value of a condition in runs of versions that did not have it."""

MAX_PARSED_BYTES = MAX_BYTES
"""Files above this size (bytes) were written by an agent, whatever their names, and are compared as plain bytes."""
MAX_COMPARED_BYTES = 1 << 30
"""Larger files, in bytes, are not compared: an agent may leave huge sparse files."""


def differences(left: Path, right: Path) -> list[str]:
    """One line per file or field in which two run directories differ; empty when they are the same run."""
    ours, theirs = _files(left), _files(right)
    lines = [f"{name}: only in {left}" for name in sorted(ours.keys() - theirs.keys())]
    lines += [f"{name}: only in {right}" for name in sorted(theirs.keys() - ours.keys())]
    for name in sorted(ours.keys() & theirs.keys()):
        lines += _file_differences(name, ours[name], theirs[name])
    return lines


def shortened(differing: Sequence[str], left: Path, right: Path) -> list[str]:
    """`differences` for people: scores first, and folders in place of files that one run lacks."""
    ends = tuple(f": only in {side}" for side in (left, right))
    scores = [line for line in differing if line.startswith("run.json: outcome.")]
    scores.sort(key=lambda line: not line.startswith("run.json: outcome.final_score:"))
    others = [line for line in differing if line not in scores and not line.endswith(ends)]
    lacking: dict[str, list[str]] = {}
    for line in differing:
        for end in ends:
            if line.endswith(end):
                name = line.removesuffix(end)
                folder = "/".join(name.split("/")[: 3 if name.startswith("workspace/feedback/") else 2])
                lacking.setdefault(f"{folder}{end}", []).append(line)
    folders = [
        lines[0] if len(lines) == 1 else f"{name} ({len(lines)} files)" for name, lines in lacking.items()
    ]
    return [*scores, *others, *folders]


def _files(root: Path) -> dict[str, Path]:
    paths = {str(path.relative_to(root)): path for path, _ in left_files(root)}
    for pattern in EXCLUDED_FILES:
        paths = {name: path for name, path in paths.items() if not fnmatch.fnmatchcase(name, pattern)}
    return paths


def _file_differences(name: str, left: Path, right: Path) -> list[str]:
    sizes = [path.stat().st_size for path in (left, right)]
    if min(sizes) > MAX_COMPARED_BYTES:
        return [f"{name}: {sizes[0]} and {sizes[1]} bytes, too many to compare"]
    if filecmp.cmp(left, right, shallow=False):
        return []
    file = name.rpartition("/")[2]
    if file not in EXCLUDED_FIELDS or max(sizes) > MAX_PARSED_BYTES:
        return [f"{name}: {sizes[0]} and {sizes[1]} bytes that are not the same"]
    excluded = tuple(EXCLUDED_FIELDS[file])
    try:
        ours, theirs = (_parse(name, read_regular(path)) for path in (left, right))
        usual = _USUAL if name == "run.json" else {}
        return [
            f"{name}: {path or 'content'}: {_short(a)} and {_short(b)}"
            for path, a, b in _value_differences("", ours, theirs)
            if not any(path == each or path.startswith(f"{each}.") for each in excluded)
            and path.rpartition(".")[2] not in (excluded if name.endswith(".txt") else ())
            and not (path in usual and (a, b) in ((..., usual[path]), (usual[path], ...)))
        ]
    except (ValueError, TypeError, AttributeError) as error:
        return [f"{name}: cannot be read: {error}"]
    except RecursionError:
        return [
            f"{name}: {sizes[0]} and {sizes[1]} bytes that are not the same, nested too deeply to be read"
        ]


def _parse(name: str, data: bytes) -> Any:
    if name.endswith(".txt"):
        return dict(enumerate(map(json.loads, data.splitlines())))
    return json.loads(data)


def _value_differences(path: str, left: Any, right: Any) -> list[tuple[str, object, object]]:
    """Paths at which two JSON values differ, with both values; a missing field differs from every value."""
    if isinstance(left, dict) and isinstance(right, dict):
        differing = []
        for key in [*left, *(key for key in right if key not in left)]:
            below = f"{path}.{key}" if path else str(key)
            differing += _value_differences(below, left.get(key, ...), right.get(key, ...))
        return differing
    if _objects(left) and _objects(right) and len(left) == len(right):
        return [
            differing
            for a, b in zip(left, right, strict=True)
            for differing in _value_differences(path, a, b)
        ]
    # JSON here contains no NaN, so equality is exact.
    return [] if type(left) is type(right) and left == right else [(path, left, right)]


def _objects(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)


def _short(value: object) -> str:
    if value is ...:
        return "nothing"
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
