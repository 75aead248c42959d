"""Finds run directories below folders, and reads the records of finished runs; `policies/submits` reads their submits.

Rule that this module owns: no link is followed below a run directory, which could lead to files of the reader's
machine.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import msgspec

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records.run_record import Artifacts, RunRecord, decode_run_record
from evopolicy_common.regular_files import read_regular

RUN_JSON = "run.json"
_PLACES = ("workspace/feedback", "checkpoints", "logs")
"""Folders of a run directory whose files are read, whatever `run.json` names."""


def read_record(folder: Path) -> RunRecord:
    """A finished run's record. Raises OSError, or ProtocolError for a bad file and as `check_places`."""
    record = decode_run_record(read_regular(folder / RUN_JSON))
    check_places(folder, record.artifacts)
    return record


def read_or_reason(folder: Path) -> RunRecord | str:
    """The record of a finished run, or why there is none that can be read."""
    try:
        return read_record(folder)
    except FileNotFoundError:
        return f"the run did not finish: it has no {RUN_JSON}"
    except OSError as error:
        return f"{RUN_JSON} cannot be read: {error.strerror}"
    except ProtocolError as error:
        return f"{RUN_JSON}: {error}"


def check_places(folder: Path, artifacts: Artifacts) -> None:
    """Raises ProtocolError when a place of a run's files is outside its directory, also by a link."""
    named = msgspec.structs.asdict(artifacts)
    places = {f"artifacts.{name}": place for name, place in named.items() if place is not None}
    for name, place in {**dict(zip(_PLACES, _PLACES, strict=True)), **places}.items():
        parts = Path(place).parts
        links = any(folder.joinpath(*parts[: n + 1]).is_symlink() for n in range(len(parts)))
        if Path(place).is_absolute() or ".." in parts or links:
            raise ProtocolError(f"{name} is outside the run directory: {place[:200]!r}")


def run_folders(paths: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Run directories at or under `paths`, sorted and distinct, and those of `paths` that contain none.

    A run directory is a folder with a `run.json`, or one of a started run (`workspace/` beside `logs/` or
    `checkpoints/`); it is not searched further. Links below the given paths are not followed.
    """
    runs: set[Path] = set()
    without: list[Path] = []
    for path in paths:
        root = path.resolve()
        below = {root.parent} if root.is_file() and root.name == RUN_JSON else set()
        for folder, names, files in os.walk(root):
            begun = "workspace" in names and ("logs" in names or "checkpoints" in names)
            if RUN_JSON in files or begun:
                below.add(Path(folder))
                names.clear()
            names[:] = [name for name in names if not name.startswith(".")]
        runs |= below
        if not below:
            without.append(path)
    return sorted(runs), without


def no_run_below(*paths: Path) -> str:
    """The text of an error."""
    return f"no run directory at or below {', '.join(map(str, paths))}; name one, or a folder of them, such as runs"
