"""Starting a run from a submit of an earlier one: `--start-from RUN@submit_NNN`.

Rules that this module owns:
- The new workspace is the recorded tree and, read-only below `history/`, the train feedback up to that
  submit. Nothing else of the earlier run is read: its final `workspace/system/` shows the selected policy.
- The coordinator accepts a start only with the digest that the earlier run's gateway sent with the submit.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.run_settings import Start
from evopolicy_common.records.open_run import OpenedRun
from evopolicy_common.records.policies import trees
from evopolicy_common.records.policies.trees import Tree
from evopolicy_common.records.run_files import read_record
from evopolicy_gateway.run_folder.layout import RunFolder, save, saved


class StartPoint(NamedTuple):
    """A start, and where its files are."""

    start: Start
    folder: RunFolder
    """Of the earlier run."""
    submit: str
    tree: Tree


def find(text: str, started_in: Path) -> StartPoint:
    """The submit that `RUN@submit_NNN` names, RUN relative to `started_in`. ConfigError that names the fault."""
    place, _, submit = text.rpartition("@")
    number = trees.submit_number(submit)
    if not place or number is None:
        raise ConfigError(
            f"--start-from {text!r}: use the form RUN@submit_NNN, such as"
            " runs/evolve/gym_acrobot/first@submit_007"
        )
    folder = RunFolder((started_in / place).absolute())
    try:
        # A folder of another user's making could name any run and hold any files.
        if folder.root.stat().st_uid != os.getuid():
            raise ConfigError(
                f"--start-from {text}: {folder.root} belongs to another user; name a run of your own"
            )
        finished = folder.run_json.exists()
        run = read_record(folder.root).run if finished else saved(folder.opened_run, OpenedRun).run
    except OSError as error:
        raise ConfigError(
            f"--start-from {text}: no run is there: {error.strerror}; name a run directory"
        ) from error
    tree, digest = trees.read(folder.root, submit)
    if not (folder.feedback / submit).is_dir():
        raise ConfigError(f"--start-from {text}: the submit has no feedback yet; wait until it is played")
    return StartPoint(Start(run=run, submit_index=number, tree=digest), folder, submit, tree)


def stage(point: StartPoint, folder: RunFolder) -> None:
    """Makes the workspace of a new run. StorageError for a missing content, and where the disk refuses."""
    start, source, submit, tree = point
    folder.workspace.mkdir()
    trees.restore(source.root, tree, folder.workspace)
    omitted = trees.copy_history(source.feedback, source.history, start.submit_index, folder.history)
    folder.history.mkdir(exist_ok=True)
    about = {"submit": submit, "omitted": omitted}
    (folder.history / "START.json").write_bytes(msgspec.json.format(msgspec.json.encode(about)) + b"\n")
    save(folder.start, start)
