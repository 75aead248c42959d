"""Realised structure of selected policies, and edit size against improvement (paper, mechanism section and
appendix)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec

from evopolicy_results.behaviour.edits import Transition, classify, demand_of
from evopolicy_results.code.topology import Features
from evopolicy_results.reading.records import Run

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
        if run.selected is None or run.selected.source is None:
            continue
        demand = demand_of(run.env)
        for group in ([demand] if demand else []) + ["all"]:
            by_group = groups.setdefault((group, run.entry), {})
            by_group.setdefault(run.env, []).append(run.selected.source.features)
    order = {"synthesis": 0, "tuning": 1, "all": 2}
    rows: list[StructureMean] = []
    for (demand, entry), by_env in sorted(
        groups.items(), key=lambda item: (order[item[0][0]], item[0][1].casefold(), item[0][1])
    ):
        means = {
            name: fmean(fmean(getattr(one, name) for one in found) for found in by_env.values())
            for name in (*FEATURES, "nodes", "lines")
        }
        n_runs = sum(len(found) for found in by_env.values())
        rows.append(
            StructureMean(
                demand=demand,
                entry=entry,
                harness=harness[entry],
                n_environments=len(by_env),
                n_runs=n_runs,
                **means,
            )
        )
    return rows


def edit_size_bins(runs: Iterable[Run]) -> list[EditSizeBin]:
    """Every transition with a known edit size, by entry (sorted) and bin (all bins, including empty ones)."""
    by_entry: dict[str, list[Transition]] = {}
    for run in runs:
        found = [t for t in classify(run.submits) if t.previous is not None and t.changed_lines is not None]
        by_entry.setdefault(run.entry, []).extend(found)
    rows: list[EditSizeBin] = []
    for entry in sorted(by_entry, key=lambda name: (name.casefold(), name)):
        for label in BINS:
            inside = [t for t in by_entry[entry] if bin_of(t) == label]
            rows.append(
                EditSizeBin(
                    entry=entry,
                    label=label,
                    n=len(inside),
                    n_visible=sum(t.mean_improved is not None for t in inside),
                    visible_improved=sum(t.mean_improved is True for t in inside),
                    validation_improved=sum(t.hit for t in inside),
                )
            )
    return rows


def bin_of(transition: Transition) -> str:
    """The transition's key of `BINS`. A change without changed lines (line ends, empty module) counts as one line."""
    if transition.edit in ("retest", "data"):
        return UNCHANGED if transition.edit == "retest" else DATA_ONLY
    size = max(1, transition.changed_lines or 0)
    return next(label for label, (low, high) in BINS.items() if low and low <= size <= (high or math.inf))
