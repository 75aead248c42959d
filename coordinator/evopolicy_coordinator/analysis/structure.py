"""Realised structure of selected policies, and edit size against improvement (paper, mechanism section and appendix)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from statistics import fmean

import msgspec

from evopolicy_coordinator.analysis.edits import Transition, classify, demand_of
from evopolicy_coordinator.analysis.records import Run
from evopolicy_coordinator.analysis.topology import Features

FEATURES = ("functions", "branches", "loops", "depth", "state")
"""The paper's five columns, in its order."""

BINS: tuple[tuple[int, int | None], ...] = ((0, 0), (1, 5), (6, 20), (21, 60), (61, 150), (151, None))
"""Edit sizes in changed lines, inclusive; the first bin is for unchanged source bundles alone."""


class SelectedStructure(msgspec.Struct, frozen=True, kw_only=True):
    """Features of one run's validation-selected policy."""

    run: str
    entry: str
    env: str
    features: Features


class StructureMean(msgspec.Struct, frozen=True, kw_only=True):
    """Mean features of one entry's selected policies in one demand group; runs weigh equally within an environment,
    environments equally within the group."""

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
    low: int
    high: int | None
    """Inclusive; None for no upper end."""
    n: int
    n_visible: int
    """Of them, with visible means on both sides."""
    visible_improved: int
    """The visible train mean rose."""
    validation_improved: int
    """The validation best rose."""

    @property
    def label(self) -> str:
        return bin_label(self.low, self.high)

    @property
    def p_visible(self) -> float | None:
        return self.visible_improved / self.n_visible if self.n_visible else None

    @property
    def p_validation(self) -> float | None:
        return self.validation_improved / self.n if self.n else None


def bin_label(low: int, high: int | None) -> str:
    """`unchanged`, `6–20`, `151+`."""
    if high == 0:
        return "unchanged"
    return f"{low}+" if high is None else f"{low}–{high}"


def selected_structures(runs: Iterable[Run]) -> list[SelectedStructure]:
    """One record for every run whose selected checkpoint can be read."""
    out: list[SelectedStructure] = []
    for run in runs:
        selected = run.selected
        if selected is not None and selected.source is not None:
            out.append(
                SelectedStructure(
                    run=run.name, entry=run.entry, env=run.env, features=selected.source.features
                )
            )
    return out


def structure_means(runs: Sequence[Run]) -> list[StructureMean]:
    """Rows by demand group (`all` last, over every environment), then entry."""
    harness = {run.entry: run.harness for run in runs}
    groups: dict[tuple[str, str], dict[str, list[Features]]] = {}
    for found in selected_structures(runs):
        demand = demand_of(found.env)
        for group in ([demand] if demand else []) + ["all"]:
            groups.setdefault((group, found.entry), {}).setdefault(found.env, []).append(found.features)
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
    """Every transition with a known edit size, by entry (sorted) and bin (all bins, also empty ones)."""
    by_entry: dict[str, list[Transition]] = {}
    for run in runs:
        found = [t for t in classify(run.submits) if t.previous is not None and t.changed_lines is not None]
        by_entry.setdefault(run.entry, []).extend(found)
    rows: list[EditSizeBin] = []
    for entry in sorted(by_entry, key=lambda name: (name.casefold(), name)):
        for low, high in BINS:
            inside = [t for t in by_entry[entry] if low <= _size(t) <= (math.inf if high is None else high)]
            rows.append(
                EditSizeBin(
                    entry=entry,
                    low=low,
                    high=high,
                    n=len(inside),
                    n_visible=sum(t.mean_improved is not None for t in inside),
                    visible_improved=sum(t.mean_improved is True for t in inside),
                    validation_improved=sum(t.hit for t in inside),
                )
            )
    return rows


def _size(transition: Transition) -> int:
    """Changed lines; a bundle that changed without a changed line (line ends, an empty module) counts as one."""
    if transition.edit == "retest":
        return 0
    return max(1, transition.changed_lines or 0)
