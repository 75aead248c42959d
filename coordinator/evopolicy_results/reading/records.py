"""The analysis's records: a run read from its directory, its submits, and the paths left out.

Typed, immutable, without policy sources (those stay on disk, at `PastRun.checkpoint`), so that a thousand runs fit
in memory. `rows` turns any list of records into dicts for a data frame.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.records.rescores import RescoreRecord
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.summary import Summary
from evopolicy_results.code.topology import Features
from evopolicy_results.reading.environments import by_name, grouped, ordered_environments
from evopolicy_results.reading.published import PUBLISHED

EditType = Literal["first", "synthesis", "parametric", "rollback", "retest", "data"]
"""Relation of a score-bearing submit to the one before it; see `edits`."""


class PolicySource(msgspec.Struct, frozen=True, kw_only=True):
    """Description of one checkpoint's policy source bundle (`policy.py` and reachable local modules)."""

    digest: str
    """SHA-256 of its paths and bytes."""
    topology: str
    """Hash of the AST without numeric constants; see `topology`."""
    features: Features
    files: tuple[str, ...]
    """Paths of the bundle's files under `system/`."""


class PastSubmit(msgspec.Struct, frozen=True, kw_only=True):
    index: int
    status: str
    n_episodes: int
    consumed_before: int
    """Budget spent before it, episodes."""
    consumed: int
    """Budget spent after it, episodes."""
    mean_return: float | None = None
    """Visible train mean; None when not ok."""
    val_mean: float | None = None
    """Hidden validation mean, known after the run; None when not ok or not eligible."""
    n_failed_episodes: int = 0
    started_at: str = ""
    bundle_digest: str = ""
    """Digest of the whole `system/`, including data files; empty when unknown."""
    source: PolicySource | None = None
    """None when there is no readable checkpoint."""
    changed_lines: int | None = None
    """Lines added plus removed in the source bundle since the previous ok submit; None for the first, or if unknown."""
    summary: Summary | None = None
    """Without its fields by episode, of which a run has thousands; None without one, and of the published software."""

    @property
    def label(self) -> str:
        """`s00k`, the paper's label of a submit."""
        return f"s{self.index:03d}"

    @property
    def is_scored(self) -> bool:
        """True for a score-bearing submit: ok, with a validation mean and a readable policy."""
        return self.status == "ok" and self.val_mean is not None and self.source is not None


class PastRun(msgspec.Struct, frozen=True, kw_only=True):
    """One complete run directory."""

    path: Path
    record: RunRecord
    submits: tuple[PastSubmit, ...]
    """In order of their index."""
    rescore: RescoreRecord | None = None
    """The re-score that the record's held-out results were replaced by; None for the run's own."""

    @property
    def entry(self) -> str:
        """Leaderboard entry: the model, or the operator's name for the agent."""
        return self.record.agent.entry or self.record.model

    @property
    def harness(self) -> str:
        return self.record.agent.harness

    @property
    def env(self) -> str:
        return self.record.env

    @property
    def budget(self) -> int:
        """Budget of train episodes."""
        return self.record.experiment_dimensions.episode_budget

    @property
    def is_published(self) -> bool:
        """Whether the published software wrote the run, which records less (`published`)."""
        return self.record.record_version == PUBLISHED

    @property
    def submit_size(self) -> str:
        """Minimum and maximum train episodes of a submit, such as `1 to 128`; empty if unknown."""
        if self.is_published:
            return ""
        dimensions = self.record.experiment_dimensions
        return f"{dimensions.min_episodes_per_submit} to {dimensions.max_episodes_per_submit}"

    @property
    def score(self) -> float | None:
        """Held-out mean return of the selected checkpoint; None without an ok submit."""
        return self.record.outcome.score

    @property
    def scored(self) -> tuple[PastSubmit, ...]:
        """Score-bearing submits in order."""
        return tuple(submit for submit in self.submits if submit.is_scored)

    @property
    def selected(self) -> PastSubmit | None:
        best = self.record.outcome.best_submit_index
        return next((submit for submit in self.submits if submit.index == best), None)

    @property
    def policy(self) -> str:
        """Digest of the selected policy's bundle; empty if unknown."""
        return self.selected.bundle_digest if self.selected is not None else ""

    @property
    def name(self) -> str:
        """`entry / env / exp-id`, plus the repeat number unless it is 0: unique within a report."""
        repeat = f" #{self.record.repeat}" if self.record.repeat else ""
        return f"{self.entry} / {self.env} / {self.record.exp_id}{repeat}"

    @property
    def workspace(self) -> Path:
        return self.path / (self.record.artifacts.workspace or "workspace")

    def feedback(self, index: int) -> Path:
        """Folder of the feedback on a submit, whether or not it exists."""
        return checkpoint_folder(self.workspace, "feedback", index)

    def checkpoint(self, index: int) -> Path:
        """Folder of a submit's checkpoint, whether or not it exists."""
        return checkpoint_folder(self.path, self.record.artifacts.checkpoints or "checkpoints", index)


class LeftOut(msgspec.Struct, frozen=True, kw_only=True):
    """A path that was read as a run and is not part of the analysis."""

    path: Path
    reason: str


def checkpoint_folder(run: Path, folder: str, index: int) -> Path:
    """`checkpoints/submit_NNN`: NNN has at least three digits, more if the budget has more."""
    places = [run / folder / f"submit_{index:0{width}d}" for width in (3, 4, 5, 6, 7)]
    return next((place for place in places if place.is_dir()), places[0])


def by_cell(runs: Iterable[PastRun]) -> dict[tuple[str, str], list[PastRun]]:
    """The runs by (environment, entry): environments in catalogue order, entries by name."""
    cells = grouped(runs, lambda run: (run.env, run.entry))
    place = {env: i for i, env in enumerate(ordered_environments(env for env, _ in cells))}
    return {key: cells[key] for key in sorted(cells, key=lambda key: (place[key[0]], by_name(key[1])))}


def path_text(path: Path) -> str:
    """The path as writable text, also when it is not UTF-8."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def rows(records: Iterable[object]) -> list[dict[str, Any]]:
    """The records as dicts of plain values, fields in declared order: input for `pandas.DataFrame`."""
    return [msgspec.to_builtins(record, enc_hook=str) for record in records]
