"""Where two run directories differ, leaving out the published list of what may: `EXCLUDED_FILES` and `EXCLUDED_FIELDS`.

What is left must be equal byte for byte, JSON files up to the excluded fields: the same agent on the same cases comes to
the same run whatever the number of workers, their order, and the failures on the way. A run that an earlier version wrote is
compared with one of this version up to `OLD_FILES` and `OLD_FIELDS`, which only one of the two tells.
"""

from __future__ import annotations

import filecmp
import fnmatch
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evopolicy_common.processes.left_files import left_files
from evopolicy_common.records.run_record import upgraded

EXCLUDED_FILES: Mapping[str, str] = {
    "logs/*": "what happened on the way, with its times",
    "workspace/AGENTS.md": "names the gateway's port and its random token",
}
"""Patterns of paths in a run directory that are not compared, and why."""

EXCLUDED_FIELDS: Mapping[str, Mapping[str, str]] = {
    "run.json": {
        "exp_id": "the run's own name",
        "attempt": "counts what was begun anew",
        "run": "the coordinator's name of the run",
        "timing": "times",
        "agent.retries": "counts what was asked again",
        "outcome.auxiliary.infrastructure_retries": "counts what was played again",
        "rejected_submits.at": "a time",
        "committed": "the run's own place in the journal, and a random salt",
        "audit": "which workers played, and played again",
        "versions.agents_md_hash": "of a file that names the gateway's port",
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
"""Fields that are not compared, by the name of their file, and why. The text files hold JSON lines."""

OLD_FILES = ("checkpoints/*/_meta.json", "checkpoints/*/metrics.json")
OLD_FIELDS: Mapping[str, tuple[str, ...]] = {
    "run.json": ("versions.data_train_hash", "versions.data_valid_hash", "versions.data_heldout_hash"),
    "summary.json": ("schema_version", "env_instances", "first_global_episode"),
    "errors.txt": ("schema_version",),
    "error.txt": ("schema_version",),
}
"""What earlier versions wrote otherwise. Fields that only one of the two runs has are left out too."""

_OLD_SYSTEM = re.compile(r"^(checkpoints/[^/]+/)system/")

MAX_PARSED_BYTES = 64 << 20
"""A file above this is an agent's, whatever its name, and compared as it is."""
MAX_COMPARED_BYTES = 1 << 30
"""An agent may leave files of any size that take no room."""


def left_out() -> list[str]:
    """The published list, a line for each: what is not compared, and why."""
    files = [f"{pattern}: {why}" for pattern, why in EXCLUDED_FILES.items()]
    fields = EXCLUDED_FIELDS.items()
    return files + [f"{file}, {name}: {why}" for file, names in fields for name, why in names.items()]


def differences(left: Path, right: Path) -> list[str]:
    """One line for each file or field in which two run directories differ; empty when they are the same run."""
    old = _is_old(left) != _is_old(right)
    ours, theirs = _files(left, old), _files(right, old)
    found = [f"{name}: only in {left}" for name in sorted(ours.keys() - theirs.keys())]
    found += [f"{name}: only in {right}" for name in sorted(theirs.keys() - ours.keys())]
    for name in sorted(ours.keys() & theirs.keys()):
        found += _file_differences(name, ours[name], theirs[name], old)
    return found


def shortened(found: Sequence[str], left: Path, right: Path) -> list[str]:
    """The lines of `differences(left, right)` for people: scores first, and folders in place of files that one run lacks."""
    ends = tuple(f": only in {side}" for side in (left, right))
    scores = [line for line in found if line.startswith("run.json: outcome.")]
    scores.sort(key=lambda line: not line.startswith("run.json: outcome.final_score:"))
    others = [line for line in found if line not in scores and not line.endswith(ends)]
    lacking: dict[str, list[str]] = {}
    for line in found:
        for end in ends:
            if line.endswith(end):
                name = line.removesuffix(end)
                folder = "/".join(name.split("/")[: 3 if name.startswith("workspace/feedback/") else 2])
                lacking.setdefault(f"{folder}{end}", []).append(line)
    folders = [
        lines[0] if len(lines) == 1 else f"{name} ({len(lines)} files)" for name, lines in lacking.items()
    ]
    return [*scores, *others, *folders]


def _is_old(root: Path) -> bool:
    """Whether an earlier version wrote the run."""
    try:
        told = json.loads((root / "run.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(told, dict) and told.get("schema_version") == 1


def _files(root: Path, old: bool) -> dict[str, Path]:
    """Regular files by their path in the run, those that are excluded aside. `old`: one of the two runs is old."""
    paths = {str(path.relative_to(root)): path for path, _ in left_files(root)}
    if old and _is_old(root):
        paths = {_OLD_SYSTEM.sub(r"\1", name): path for name, path in paths.items()}
    excluded = (*EXCLUDED_FILES, *(OLD_FILES if old else ()))
    return {
        name: path
        for name, path in paths.items()
        if not any(fnmatch.fnmatchcase(name, pattern) for pattern in excluded)
    }


def _file_differences(name: str, left: Path, right: Path, old: bool) -> list[str]:
    sizes = [path.stat().st_size for path in (left, right)]
    if min(sizes) > MAX_COMPARED_BYTES:
        return [f"{name}: {sizes[0]} and {sizes[1]} bytes, too many to compare"]
    if filecmp.cmp(left, right, shallow=False):
        return []
    file = name.rpartition("/")[2]
    if file not in EXCLUDED_FIELDS or max(sizes) > MAX_PARSED_BYTES:
        return [f"{name}: {sizes[0]} and {sizes[1]} bytes that are not the same"]
    excluded = (*EXCLUDED_FIELDS[file], *(OLD_FIELDS.get(file, ()) if old else ()))
    try:
        ours, theirs = (_parse(name, path.read_bytes()) for path in (left, right))
        return [
            f"{name}: {path or 'content'}: {_short(a)} and {_short(b)}"
            for path, a, b in _value_differences("", ours, theirs)
            if not any(path == each or path.startswith(f"{each}.") for each in excluded)
            and path.rpartition(".")[2] not in (excluded if name.endswith(".txt") else ())
            and not (old and (a is ... or b is ...))
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
    told = json.loads(data)
    is_old = name == "run.json" and isinstance(told, dict) and told.get("schema_version") == 1
    return upgraded(told) if is_old else told


def _value_differences(path: str, left: Any, right: Any) -> list[tuple[str, Any, Any]]:
    """Paths at which two JSON values differ, with both values; a missing field differs from every value."""
    if isinstance(left, dict) and isinstance(right, dict):
        found = []
        for key in [*left, *(key for key in right if key not in left)]:
            below = f"{path}.{key}" if path else str(key)
            found += _value_differences(below, left.get(key, ...), right.get(key, ...))
        return found
    if _objects(left) and _objects(right) and len(left) == len(right):
        return [found for a, b in zip(left, right, strict=True) for found in _value_differences(path, a, b)]
    # NaN is no JSON here, so equality is exact.
    return [] if type(left) is type(right) and left == right else [(path, left, right)]


def _objects(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, dict) for item in value)


def _short(value: Any) -> str:
    if value is ...:
        return "nothing"
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
