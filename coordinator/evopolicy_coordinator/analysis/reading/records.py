"""The analysis's nouns: a run read from its directory, its submits, and what was left out.

Typed, immutable, free of policy sources (those stay on disk, `Run.checkpoint` says where), so that a thousand runs fit
in memory. `rows` turns any list of records into dicts, ready for a data frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.records.run_record import RunRecord
from evopolicy_coordinator.analysis.behaviour.topology import Features
from evopolicy_coordinator.analysis.reading.published import PUBLISHED
from evopolicy_coordinator.analysis.simulators.look import Flag

EditType = Literal["first", "synthesis", "parametric", "rollback", "retest", "data"]
"""What a score-bearing submit is to the score-bearing submit before it; see `edits`."""


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """What is kept of one checkpoint's policy source bundle (`policy.py` and reachable local modules)."""

    digest: str
    """SHA-256 of its paths and bytes."""
    topology: str
    """Hash of the AST with numeric constants stripped; see `topology`."""
    features: Features
    files: tuple[str, ...]
    """Paths of the bundle's files under `system/`."""


class Submit(msgspec.Struct, frozen=True, kw_only=True):
    """One accepted submit."""

    index: int
    status: str
    n_episodes: int
    """Episodes charged."""
    consumed_before: int
    """Budget spent before it, episodes."""
    consumed: int
    """Budget spent after it."""
    mean_return: float | None = None
    """Visible train mean; None when not ok."""
    std_return: float | None = None
    val_mean: float | None = None
    """Hidden validation mean, known after the run; None when not ok or not eligible."""
    n_failed_episodes: int = 0
    """Train episodes in which the policy failed."""
    started_at: str = ""
    completed_at: str = ""
    wall_s: float = 0.0
    bundle_digest: str = ""
    """Of the whole `system/`, data files included; empty when unknown."""
    source: Source | None = None
    """None when there is no readable checkpoint."""
    changed_lines: int | None = None
    """Lines added plus lines removed in the source bundle since the previous ok submit; None for the first, or unknown."""

    @property
    def label(self) -> str:
        """`s00k`, as the paper labels submits."""
        return f"s{self.index:03d}"

    @property
    def is_scored(self) -> bool:
        """True for a score-bearing submit: ok, with a validation mean and a readable policy."""
        return self.status == "ok" and self.val_mean is not None and self.source is not None


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """One complete run directory."""

    path: Path
    record: RunRecord
    submits: tuple[Submit, ...]
    """In order of their index."""
    simulator_flags: tuple[Flag, ...] = ()
    """Code that looks like a simulator; empty where the run's rules allow simulation, as then nobody looked."""

    @property
    def simulation_allowed(self) -> bool:
        return self.record.experiment_dimensions.simulation == "allowed"

    @property
    def entry(self) -> str:
        """Leaderboard entry: model and harness, or the operator's name for it."""
        return self.record.agent.entry or self.record.model

    @property
    def harness(self) -> str:
        return self.record.agent.harness

    @property
    def env(self) -> str:
        return self.record.env

    @property
    def budget(self) -> int:
        """Train episodes that the run could spend."""
        return self.record.experiment_dimensions.episode_budget

    @property
    def is_published(self) -> bool:
        """The published software wrote it: it tells less (`published`)."""
        return self.record.record_version == PUBLISHED

    @property
    def submit_size(self) -> str:
        """Fewest and most train episodes of a submit, such as `1 to 128`; empty where unknown."""
        if self.is_published:
            return ""
        dimensions = self.record.experiment_dimensions
        return f"{dimensions.min_episodes_per_submit} to {dimensions.max_episodes_per_submit}"

    @property
    def score(self) -> float | None:
        """Held-out mean return of the selected checkpoint; None with no ok submit."""
        return self.record.outcome.score

    @property
    def scored(self) -> tuple[Submit, ...]:
        """Score-bearing submits in order."""
        return tuple(submit for submit in self.submits if submit.is_scored)

    @property
    def selected(self) -> Submit | None:
        best = self.record.outcome.best_submit_index
        return next((submit for submit in self.submits if submit.index == best), None)

    @property
    def name(self) -> str:
        """`entry / env / exp-id`, with the repeat where it is not the first: unique within a report."""
        repeat = f" #{self.record.repeat}" if self.record.repeat else ""
        return f"{self.entry} / {self.env} / {self.record.exp_id}{repeat}"

    def checkpoint(self, index: int) -> Path:
        """Folder of a submit's checkpoint, whether or not it is there."""
        return checkpoint_folder(self.path, self.record.artifacts.checkpoints or "checkpoints", index)


class LeftOut(msgspec.Struct, frozen=True, kw_only=True):
    """A path that looked like a run and is not in the analysis."""

    path: Path
    reason: str


def checkpoint_folder(run: Path, folder: str, index: int) -> Path:
    """`checkpoints/submit_NNN`: NNN is padded to at least three digits, more where the budget has more."""
    for width in (3, 4, 5, 6, 7):
        found = run / folder / f"submit_{index:0{width}d}"
        if found.is_dir():
            return found
    return run / folder / f"submit_{index:03d}"


def path_text(path: Path) -> str:
    """The path as text that can be written, also where it is no UTF-8."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def rows(records: Iterable[Any]) -> list[dict[str, Any]]:
    """The records as dicts of plain values, one each, fields in declared order: what `pandas.DataFrame` takes."""
    return [msgspec.to_builtins(record, enc_hook=str) for record in records]
