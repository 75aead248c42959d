"""Realised structure of selected policies, and edit size against improvement (paper, mechanism section and
appendix)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec

from evopolicy_results.behaviour.edits import GROUPS, Transition, classify, demand_groups
from evopolicy_results.code.topology import Features
from evopolicy_results.reading.environments import by_name
from evopolicy_results.reading.records import EditType, Run

FEATURES = ("functions", "branches", "loops", "depth", "state")
"""The paper's five columns, in its order."""

UNCHANGED, DATA_ONLY = "unchanged", "data only"
BINS: dict[str, tuple[int, int | None]] = {
    UNCHANGED: (0, 0),
    DATA_ONLY: (0, 0),
    "1–5": (1, 5),
    "6–20": (6, 20),
    "21–60": (21, 60),
    "61–150": (61, 150),
    "151+": (151, None),
}
"""Edit sizes in changed lines of the source bundle, inclusive. The first bin is for unchanged bundles only (retests),
the second for submits that changed only files outside it."""


class StructureMean(msgspec.Struct, frozen=True, kw_only=True):
    """Mean features of one entry's selected policies in one demand group. Runs have equal weight within an
    environment, environments within the group."""

    demand: str
    entry: str
    harness: str
    n_environments: int
    n_runs: int
    functions: float
    branches: float
    loops: float
    depth: float
    state: float
    nodes: float
    lines: float


class EditSizeBin(msgspec.Struct, frozen=True, kw_only=True):
    """Transitions of one entry whose edit size is in one bin."""

    entry: str
    label: str
    """Key of `BINS`."""
    n: int
    n_visible: int
    """Number of these with visible means on both sides."""
    visible_improved: int
    """Number of these whose visible train mean rose."""
    validation_improved: int
    """Number of these whose validation best rose."""

    @property
    def p_visible(self) -> float | None:
        """Share whose visible mean rose; None if none can be compared."""
        return self.visible_improved / self.n_visible if self.n_visible else None

    @property
    def p_validation(self) -> float | None:
        """Share that raised the validation best; None for an empty bin."""
        return self.validation_improved / self.n if self.n else None


def structure_means(runs: Sequence[Run]) -> list[StructureMean]:
    """Rows by demand group (`all` last, over every environment), then entry."""
    harness = {run.entry: run.harness for run in runs}
    groups: dict[tuple[str, str], dict[str, list[Features]]] = {}
    for run in runs:
        if run.selected is not None and run.selected.source is not None:
            for group in demand_groups(run.env):
                by_env = groups.setdefault((group, run.entry), {})
                by_env.setdefault(run.env, []).append(run.selected.source.features)
    keys = sorted(groups, key=lambda key: (GROUPS.index(key[0]), by_name(key[1])))
    return [
        StructureMean(
            demand=demand,
            entry=entry,
            harness=harness[entry],
            n_environments=len(by_env),
            n_runs=sum(map(len, by_env.values())),
            **{
                name: fmean(fmean(getattr(one, name) for one in several) for several in by_env.values())
                for name in (*FEATURES, "nodes", "lines")
            },
        )
        for demand, entry in keys
        for by_env in [groups[demand, entry]]
    ]


def edit_size_bins(runs: Iterable[Run]) -> list[EditSizeBin]:
    """Every transition with a known edit size, by entry (sorted) and bin (all bins, including empty ones)."""
    by_entry: dict[str, dict[str, list[Transition]]] = {}
    for run in runs:
        bins = by_entry.setdefault(run.entry, {label: [] for label in BINS})
        for transition in classify(run.submits):
            if transition.previous is not None and transition.changed_lines is not None:
                bins[_bin_of(transition.edit, transition.changed_lines)].append(transition)
    return [
        EditSizeBin(
            entry=entry,
            label=label,
            n=len(inside),
            n_visible=sum(t.mean_improved is not None for t in inside),
            visible_improved=sum(t.mean_improved is True for t in inside),
            validation_improved=sum(t.hit for t in inside),
        )
        for entry in sorted(by_entry, key=by_name)
        for label, inside in by_entry[entry].items()
    ]


def _bin_of(edit: EditType, changed_lines: int) -> str:
    """A key of `BINS`. A change without changed lines (line ends, empty module) counts as one line."""
    if edit in ("retest", "data"):
        return UNCHANGED if edit == "retest" else DATA_ONLY
    size = max(1, changed_lines)
    return next(label for label, (low, high) in BINS.items() if low and low <= size <= (high or math.inf))
