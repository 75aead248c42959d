"""The report's tables about the uncertainty of its scores. Each caption explains its intervals and their units."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from evopolicy_common.statistics.distributions import ALPHA
from evopolicy_common.statistics.intervals import Estimate
from evopolicy_results.reading.environments import title_of
from evopolicy_results.statistics.aggregates import LEAST_RUNS, TAUS, Bounded
from evopolicy_results.statistics.pairs import Pair
from evopolicy_results.statistics.repeats import MAX_REPEATS, Repeats
from evopolicy_results.statistics.resolution import GAPS, Resolution
from evopolicy_results.statistics.starts import StartGroup
from evopolicy_results.studies.study import Suite
from evopolicy_results.tables.run_tables import ENTRY, ENV
from evopolicy_results.tables.table import Column, Table, tabulated

CHECKPOINTS = "With one run a cell this compares the selected checkpoints, not the agents: how an agent's runs vary is not known."  # noqa: E501
OVER = "What a repetition would draw anew: cases, runs, or runs and cases."
_SHOWN_TAUS = (0.1, 0.25, 0.5, 0.75, 0.9)


def statistics_tables(suite: Suite) -> list[Table]:
    """The tables in the order of the report; some may have no rows."""
    return [
        _pairs(suite),
        _resolution(suite),
        _aggregates(suite),
        _improvements(suite),
        _generalisation(suite),
    ]


def starts_table(groups: Sequence[StartGroup]) -> Table:
    """Runs from the same submit of an earlier run, compared with each other; no rows without such runs."""

    def pair_row(pair: Pair) -> dict[str, Any]:
        return {
            "first": pair.first,
            "second": pair.second,
            "runs": "{} and {}".format(*pair.n_runs),
            "gap": None if pair.gap is None else pair.gap.value,
            "interval": interval_text(pair.gap) or pair.reason or None,
            "over": None if pair.gap is None or pair.gap.low is None else pair.gap.over,
            "p_holm": pair.p_holm,
            "told_apart": _told_apart(pair),
            "cases": pair.n_cases or None,
        }

    rows: list[dict[str, Any]] = []
    for group in groups:
        of = {
            "env": title_of(group.env),
            "start": f"{group.parent}, submit {group.start.submit_index}",
            "scored": "yes" if group.parent_scored else "no",
        }
        found = [pair_row(pair) for pair in group.pairs]
        lone = [
            {"first": label, "runs": str(n), "interval": "no other agent or setting"}
            for label, n in group.variants.items()
        ]
        rows += [of | row for row in found or lone]
    return Table(
        name="starts",
        title="Differences between runs from one state",
        caption=(
            "Runs that start from a submit of an earlier run, compared with those from the same submit: first minus"
            " second, in held-out returns, paired by case, with the 95 % interval and Holm's correction over all pairs"
            " from one state. They are on no leaderboard and in no other table of scores. Parent scored: the agent of"
            " the earlier run, or of a run before it, had ended when one of these started, so a result may have chosen"
            " the submit. The differences between runs from it stay valid; their level is not a score from scratch."
        ),
        columns=(
            ENV,
            Column("start", "From"),
            Column("scored", "Parent scored"),
            Column("first", "First"),
            Column("second", "Second"),
            Column("gap", "Difference", "number"),
            Column("interval", "95 % interval"),
            Column("over", "Over", note=OVER),
            Column("p_holm", "Corrected p", "number", digits=4, below=True),
            Column("told_apart", "Significantly better"),
            Column("runs", "Runs"),
            Column("cases", "Cases", "integer"),
        ),
        rows=tuple(rows),
    )


def span(low: float | None, high: float | None, digits: int) -> str | None:
    """`low to high`; None without bounds."""
    return None if low is None or high is None else f"{_rounded(low, digits)} to {_rounded(high, digits)}"


def _rounded(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text


def interval_text(estimate: Estimate | None, digits: int = 3) -> str | None:
    """The interval, or the reason why there is none."""
    if estimate is None:
        return None
    return span(estimate.low, estimate.high, digits) or estimate.reason or None


def _bounds(bounded: Bounded | None, digits: int = 2) -> str | None:
    return None if bounded is None else span(bounded.low, bounded.high, digits) or bounded.reason or None


def has_single_runs(suite: Suite) -> bool:
    """Whether an agent has one run on an environment."""
    return any(pair.compares == "checkpoints" for pair in suite.statistics.pairs)


def _pairs(suite: Suite) -> Table:
    pairs = suite.statistics.pairs
    left_out = sum(pair.n_left_out > 0 for pair in pairs)

    def with_interval(field: str) -> Callable[[Pair], str | None]:
        return lambda pair: None if pair.gap is None or pair.gap.low is None else getattr(pair.gap, field)

    return tabulated(
        pairs,
        (
            ENV,
            Column("first", "First"),
            Column("second", "Second"),
            Column(
                "gap", "Difference", "number", of=lambda pair: None if pair.gap is None else pair.gap.value
            ),
            Column(
                "interval", "95 % interval", of=lambda pair: interval_text(pair.gap) or pair.reason or None
            ),
            Column(
                "over",
                "Over",
                note=OVER,
                of=with_interval("over"),
            ),
            Column("method", "Method", of=with_interval("method")),
            Column("p", "p", "number", digits=4, below=True),
            Column("p_holm", "Corrected p", "number", digits=4, below=True),
            Column(
                "told_apart",
                "Significantly better",
                note="The better entry, or the reason for none.",
                of=_told_apart,
            ),
            Column(
                "needed",
                "Needed",
                "integer",
                note="Runs of each agent, or cases of checkpoints.",
                of=lambda pair: pair.n_needed,
            ),
            Column("p_these_cases", "p, these cases only", "number", digits=4, below=True),
            Column("compares", "Compares", note="Checkpoints, where an entry has one run; else agents."),
            Column("runs", "Runs", of=lambda pair: "{} and {}".format(*pair.n_runs)),
            Column("cases", "Cases", "integer", of=lambda pair: pair.n_cases or None),
            Column(
                "left_out",
                "Cases left out",
                "integer",
                note="Cases that only some of the runs have.",
                of=lambda pair: pair.n_left_out,
            ),
        ),
        name=f"pairs_{suite.name}",
        title=f"{suite.title} differences",
        caption=(
            "Every two entries on every environment: first minus second, in held-out returns of the cases that both"
            " have. Interval: 95 %, for one environment and pair alone, over what the column Over names. p: of no"
            " difference, two-sided, from the interval's own distribution; it is at most 0.05 exactly if the interval"
            " excludes 0. Corrected p: Holm, over all rows of this table together, so a false difference in any row has"
            " a probability of at most 5 %. Significant: corrected p at most 0.05. About how many runs (or cases) would"
            " be needed: so many that every second experiment resolves a true difference of the size seen here, whose"
            " own size is uncertain. These cases only: permutation test that exchanges runs and takes the cases as"
            " given; with other cases the difference may vanish, and no verdict rests on it. The tie groups of the"
            " leaderboard are a second family of comparisons at 5 %, so both together have at most 10 %."
        )
        + (f" {CHECKPOINTS}" if has_single_runs(suite) else "")
        + (
            f" In {left_out} rows the entries' cases differ: only common cases pair, and the others are left out."
            if left_out
            else ""
        ),
    )


def _told_apart(pair: Pair) -> str | None:
    named = {"first": pair.first, "second": pair.second, "not told apart": _not_told(pair)}
    return named.get(pair.verdict)


def _not_told(pair: Pair) -> str:
    checkpoints = pair.compares == "checkpoints"
    # One run is that of the random reference.
    n = str(pair.n_cases) if checkpoints else " and ".join(map(str, sorted({*pair.n_runs} - {1})))
    # The interval beside it is for this pair alone.
    alone = pair.p is not None and pair.p <= ALPHA
    text = "not after the correction for all pairs" if alone else "not distinguishable"
    text += f" on {n} cases" if checkpoints else f" with {n} runs"
    if pair.n_needed is not None:
        return f"{text}; about {pair.n_needed} would be needed"
    more_cases = not checkpoints and pair.n_cases and pair.gap is not None and pair.gap.value != 0.0
    return f"{text}; more cases would be needed" if more_cases else text


def _resolution(suite: Suite) -> Table:
    resolutions = suite.statistics.resolutions
    rows = [_resolved(title_of(one.env), one) for one in resolutions]
    if rows and suite.statistics.overall is not None:
        rows.append({**_resolved("Mean of all", suite.statistics.overall), "gap": None})
    gap = suite.statistics.standings.gap
    return Table(
        name=f"resolution_{suite.name}",
        title=f"{suite.title} resolution",
        caption=(
            "The smallest difference between two agents that these cases and runs resolve: the half width of its 95 %"
            " interval, median over pairs, in returns and as a share of the random-to-best scale. A true difference of"
            " that size is resolved every second time. Repeats: runs of each agent that a difference of that share of"
            f' the scale would need; "more cases" where more runs do not help (up to {MAX_REPEATS} were tried); a'
            " dash with one run a cell, which does not show how runs vary. Mean of all: of the normalised scores"
            " over the environments, which are fixed."
        )
        + (
            ""
            if gap is None
            else f" Of the suite's rank score, a difference of {gap:.3f} is the smallest that is resolved."
        ),
        columns=(
            ENV,
            Column("gap", "Smallest difference", "number"),
            Column("normalised_gap", "Normalised", "number", note="As a share of the random-to-best scale."),
            Column("runs", "Runs a cell"),
            Column("cases", "Cases", "integer"),
            *(Column(_gap_key(gap), f"Repeats for {gap:g}") for gap in GAPS),
        ),
        rows=tuple(rows),
    )


def _gap_key(gap: float) -> str:
    return f"repeats_{gap:g}".replace(".", "_")


def _resolved(env: str, one: Resolution) -> dict[str, Any]:
    fewest, most = one.n_runs
    return {
        "env": env,
        "gap": one.gap,
        "normalised_gap": one.normalised_gap,
        "runs": str(fewest) if fewest == most else f"{fewest} to {most}",
        "cases": one.n_cases or None,
        **{_gap_key(gap): _repeats(one.repeats(gap)) for gap in GAPS},
    }


def _repeats(found: Repeats | None) -> str | None:
    if found is None:
        return None
    return "more cases" if found.n is None else str(found.n)


def _aggregates(suite: Suite) -> Table:
    rows = [
        {
            "entry": one.entry,
            "iqm": one.iqm.value if one.iqm is not None else None,
            "iqm_interval": _bounds(one.iqm),
            **{
                key: value
                for tau in _SHOWN_TAUS
                for key, value in _share(tau, one.profile[TAUS.index(tau)]).items()
            },
            "environments": one.n_environments,
            "runs": one.n_runs,
            "over": one.over,
        }
        for one in suite.statistics.aggregates
    ]
    return Table(
        name=f"aggregates_{suite.name}",
        title=f"{suite.title} aggregates",
        caption=(
            "Over the normalised scores of single runs, not clipped, on the environments that have a random-to-best"
            " scale (Agarwal et al. 2021). IQM: mean of the middle half. Above: share of the runs whose normalised"
            " score is above it (the performance profile). Intervals: 95 %, percentiles of a bootstrap stratified by"
            " environment, over what the column Over names; the scale is estimated again in each resample. The best"
            " agent's observed mean is the scale's end; where several agents are about as good it is too high on"
            " average, IQMs are too low, and their intervals miss: compare such agents by their differences. Two runs"
            f" to {LEAST_RUNS - 1} are too few for the intervals of shares."
        )
        + (f" {CHECKPOINTS}" if has_single_runs(suite) else ""),
        columns=(
            ENTRY,
            Column("iqm", "IQM", "number", note="Interquartile mean."),
            Column("iqm_interval", "95 % interval"),
            *(
                column
                for tau in _SHOWN_TAUS
                for column in (
                    Column(_tau_key(tau), f"Above {tau:g}", "number", digits=2),
                    Column(f"{_tau_key(tau)}_interval", "95 % interval"),
                )
            ),
            Column("environments", "Environments", "integer"),
            Column("runs", "Runs", "integer"),
            Column("over", "Over", note="What the bootstrap draws anew."),
        ),
        rows=tuple(rows),
    )


def _tau_key(tau: float) -> str:
    return f"above_{tau:g}".replace(".", "_")


def _share(tau: float, share: Bounded) -> dict[str, Any]:
    return {_tau_key(tau): share.value, f"{_tau_key(tau)}_interval": _bounds(share)}


def _improvements(suite: Suite) -> Table:
    return tabulated(
        suite.statistics.improvements,
        (
            Column("first", "First"),
            Column("second", "Second"),
            Column("probability", "Probability", "number", of=lambda one: one.probability.value),
            Column("interval", "95 % interval", of=lambda one: _bounds(one.probability, 3)),
            Column("environments", "Environments", "integer", of=lambda one: one.n_environments),
        ),
        name=f"improvement_{suite.name}",
        title=f"{suite.title} probability of improvement",
        caption=(
            "How probably a run of the first agent scores above a run of the second, ties counting half, mean over the"
            " environments that have a scale (Agarwal et al. 2021). Interval: 95 %, stratified bootstrap over runs and"
            " their cases, or over the cases of single runs."
        )
        + (f" {CHECKPOINTS}" if has_single_runs(suite) else ""),
    )


def _generalisation(suite: Suite) -> Table:
    rows: list[dict[str, Any]] = [
        {
            "env": title_of(one.env),
            "entry": one.entry,
            "train": one.train,
            "validation": one.validation,
            "heldout": one.heldout,
            "optimism": one.optimism,
            "normalised_optimism": one.normalised_optimism,
            "success": one.success,
            "runs": one.n_runs,
        }
        for one in suite.statistics.generalisation
    ]
    rows += [
        {
            "env": "Mean of all",
            "entry": one.entry,
            "normalised_optimism": one.mean.value,
            "optimism_interval": interval_text(one.mean),
        }
        for one in suite.statistics.optimism
    ]
    return Table(
        name=f"generalisation_{suite.name}",
        title=f"{suite.title} generalisation",
        caption=(
            "Mean return of the selected checkpoint on its own submit's train episodes, on validation, and on held-out"
            " cases; means over completed runs. Optimism: validation minus held-out. Selection takes the best of many"
            " validation scores, so it is above 0 on average even where an agent fits nothing. Normalised: as a share"
            " of the random-to-best scale; its last rows are means over environments with a 95 % t interval whose unit"
            " is the environment. Success: share of held-out episodes that reached the goal, where the environment"
            " reports it (Fetch, parking), or the return tells it exactly (MiniGrid, Acrobot, continuous MountainCar)."
        ),
        columns=(
            ENV,
            ENTRY,
            Column("train", "Train mean", "number"),
            Column("validation", "Validation mean", "number"),
            Column("heldout", "Held-out mean", "number"),
            Column("optimism", "Optimism", "number"),
            Column("normalised_optimism", "Normalised optimism", "number"),
            Column("optimism_interval", "95 % interval"),
            Column("success", "Success", "percent"),
            Column("runs", "Runs", "integer"),
        ),
        rows=tuple(rows),
    )
