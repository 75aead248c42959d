"""Edit types: the kind of change of each score-bearing submit, and its effect (paper, mechanism section, Table "edit
types"); edit size against improvement, and realised structure of selected policies (same section, and appendix).

A *transition* goes from one score-bearing submit (ok, with a validation mean) to the next. Its type follows from the
source bundle's topology, which leaves out numeric constants (`topology`), in this order:

- `retest`: the source bundle and all of `system/` are byte-identical to the previous ones.
- `data`: the source bundle is byte-identical, and other files of `system/` changed (weights, tables, unreachable
  modules). Those are outside the paper's boundary, so this is neither edit type. It is no retest either, as the
  policy may act differently. If the checkpoints' digests are unknown, such submits count as retests.
- `parametric`: bytes changed, and the topology equals that of the immediately previous submit.
- `rollback`: the topology differs from the previous one, and an earlier score-bearing submit of this run had it.
- `synthesis`: the topology is new to this run.

The first score-bearing submit has no predecessor. Its type is `first`; it is no transition, counts in no rate, and is
counted among the excluded. A transition is a *hit* when it strictly raises the best validation mean so far.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

import msgspec

from evopolicy_common import catalogue
from evopolicy_results.code.topology import Features
from evopolicy_results.reading.environments import by_name
from evopolicy_results.reading.records import EditType, PastRun, PastSubmit

RATED: tuple[EditType, ...] = ("synthesis", "parametric")
"""The edit types that have a hit rate; the others are candidate management."""
GROUPS = ("synthesis", "tuning", "all")
"""Groups of environments by their demand, in the order of tables."""


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """One score-bearing submit and its relation to the previous one."""

    index: int
    previous: int | None
    """Index of the previous score-bearing submit; None for the first."""
    consumed_before: int
    consumed: int
    edit: EditType
    hit: bool
    """Whether it raised the best validation mean so far; always true for the first."""
    val_mean: float
    best: float
    """Best validation mean so far, including this submit."""
    val_drop: bool
    """Whether the validation mean is below that of the previous score-bearing submit."""
    mean_return: float | None
    mean_improved: bool | None
    """Whether the visible mean rose; None for the first."""
    changed_lines: int | None
    """Edit size; None for the first, and after an ok submit without a score."""
    back_to: int | None = None
    """For a rollback: the latest earlier submit with that topology."""


class EditRates(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the edit-type table: an entry's edits in one demand group, pooled over its runs."""

    entry: str
    demand: str
    """`synthesis`, `tuning`, or `all` for every environment, including those that the paper places in neither group."""
    n_synthesis: int = 0
    hits_synthesis: int = 0
    n_parametric: int = 0
    hits_parametric: int = 0
    n_rollback: int = 0
    n_retest: int = 0
    n_data: int = 0
    """Submits that changed only files outside the source bundle."""
    n_first: int = 0
    n_not_ok: int = 0
    n_unscored: int = 0
    """Ok submits without a validation mean or a readable policy."""

    @property
    def rate_synthesis(self) -> float | None:
        """Share of syntheses that hit; None if there are none."""
        return self.hits_synthesis / self.n_synthesis if self.n_synthesis else None

    @property
    def rate_parametric(self) -> float | None:
        """Share of parametric edits that hit; None if there are none."""
        return self.hits_parametric / self.n_parametric if self.n_parametric else None


def classify(submits: Sequence[PastSubmit]) -> list[Transition]:
    """One record for every score-bearing submit of a run, in order; the first has edit type `first`."""
    out: list[Transition] = []
    by_topology: dict[str, int] = {}
    previous: PastSubmit | None = None
    best = float("-inf")
    skipped = False
    for submit in submits:
        if not submit.is_scored:
            skipped = skipped or submit.status == "ok"
            continue
        assert submit.source is not None
        assert submit.val_mean is not None
        edit = _edit(previous, submit, by_topology)
        hit = submit.val_mean > best
        best = max(best, submit.val_mean)
        before = None if previous is None else previous.mean_return
        after = submit.mean_return
        out.append(
            Transition(
                index=submit.index,
                previous=None if previous is None else previous.index,
                consumed_before=submit.consumed_before,
                consumed=submit.consumed,
                edit=edit,
                hit=hit,
                val_mean=submit.val_mean,
                best=best,
                val_drop=bool(out) and submit.val_mean < out[-1].val_mean,
                mean_return=after,
                mean_improved=None if before is None or after is None else after > before,
                changed_lines=None if previous is None or skipped else submit.changed_lines,
                back_to=by_topology.get(submit.source.topology) if edit == "rollback" else None,
            )
        )
        by_topology[submit.source.topology] = submit.index
        previous, skipped = submit, False
    return out


def _edit(previous: PastSubmit | None, submit: PastSubmit, by_topology: Mapping[str, int]) -> EditType:
    assert submit.source is not None
    if previous is None or previous.source is None:
        return "first"
    if submit.source.digest == previous.source.digest:
        known = bool(submit.bundle_digest and previous.bundle_digest)
        return "data" if known and submit.bundle_digest != previous.bundle_digest else "retest"
    if submit.source.topology == previous.source.topology:
        return "parametric"
    return "rollback" if submit.source.topology in by_topology else "synthesis"


def edit_rates(runs: Iterable[PastRun]) -> list[EditRates]:
    """Rows by entry (sorted) and demand group, with `all` last in each entry. Counts are pooled over runs."""
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for run in runs:
        transitions = classify(run.submits)
        own = Counter(f"n_{each.edit}" for each in transitions)
        own.update(f"hits_{each.edit}" for each in transitions if each.hit and each.edit in RATED)
        unscored = (submit for submit in run.submits if not submit.is_scored)
        own.update("n_unscored" if submit.status == "ok" else "n_not_ok" for submit in unscored)
        for group in demand_groups(run.env):
            counts[run.entry, group] += own
    keys = sorted(counts, key=lambda key: (by_name(key[0]), GROUPS.index(key[1])))
    return [EditRates(entry=entry, demand=group, **counts[entry, group]) for entry, group in keys]


def demand_groups(env: str) -> list[str]:
    """The groups in whose means an environment counts."""
    demand = demand_of(env)
    return [demand, "all"] if demand else ["all"]


def demand_of(env: str) -> str | None:
    """The environment's demand group in the catalogue; None if it has none or is unknown."""
    entry = catalogue.entries().get(env)
    return entry.demand if entry is not None else None


def phases(transitions: Sequence[Transition]) -> list[tuple[int, int, str]]:
    """Bands (from, to, edit type) over consumed episodes, each of adjacent transitions of one type. The phase continues
    through rollbacks and retests."""
    bands: list[tuple[int, int, str]] = []
    for transition in transitions:
        edit = transition.edit
        if edit in ("rollback", "retest"):
            edit = bands[-1][2] if bands else "first"  # type: ignore[assignment]
        if bands and bands[-1][2] == edit:
            bands[-1] = (bands[-1][0], transition.consumed, edit)
        else:
            bands.append((bands[-1][1] if bands else transition.consumed_before, transition.consumed, edit))
    return bands


def events_of(transition: Transition) -> list[str]:
    """`hit` or `miss`, plus `rollback` or `retest` if the submit is one."""
    outcome = ["hit" if transition.hit else "miss"]
    return outcome + ([transition.edit] if transition.edit in ("rollback", "retest") else [])


FEATURES = ("functions", "branches", "loops", "depth", "state")
"""The paper's five columns, in its order."""

UNCHANGED, DATA_ONLY = "unchanged", "data only"
BINS = (UNCHANGED, DATA_ONLY, "1–5", "6–20", "21–60", "61–150", "151+")
"""Edit sizes in changed lines of the source bundle; unchanged: retests; data only: other files changed."""
_LARGEST = (5, 20, 60, 150)
"""Largest sizes of the bins from `1–5` on."""


class StructureMean(msgspec.Struct, frozen=True, kw_only=True):
    """Mean features of an entry's selected policies in a demand group: over runs, then over environments."""

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


def structure_means(runs: Sequence[PastRun]) -> list[StructureMean]:
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


def edit_size_bins(runs: Iterable[PastRun]) -> list[EditSizeBin]:
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
    """One of `BINS`. A change without changed lines (line ends, empty module) counts as one line."""
    if edit in ("retest", "data"):
        return UNCHANGED if edit == "retest" else DATA_ONLY
    return BINS[2 + bisect_left(_LARGEST, changed_lines)]
