"""The report's tables about the uncertainty of its scores. Each caption explains its intervals and their units."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

from msgspec.structs import replace

from evopolicy_common.statistics.intervals import ALPHA
from evopolicy_results.reading.environments import grouped, title_of
from evopolicy_results.statistics.aggregates import LEAST_RUNS, TAUS
from evopolicy_results.statistics.pairs import GAPS, MAX_REPEATS, Pair, least_runs
from evopolicy_results.statistics.starts import StartGroup
from evopolicy_results.studies.study import SuiteStudy
from evopolicy_results.tables.run_tables import ENTRY, ENV, RUNS
from evopolicy_results.tables.table import (
    INTERVAL,
    Column,
    Table,
    interval_text,
    rows_of,
    tabulated,
    with_interval,
)

_SHOWN_TAUS = (0.1, 0.25, 0.5, 0.75, 0.9)
ENVIRONMENTS = Column("environments", "Environments", "integer", of="n_environments")
OVER = Column("over", "Over", note="Drawn anew in a repetition: cases, runs, or runs and cases.")


def statistics_tables(suite: SuiteStudy) -> list[Table]:
    """The tables in the order of the report; some may have no rows."""
    results = suite.statistics
    n_unpaired = sum(pair.n_left_out > 0 for pair in results.pairs)
    return [
        tabulated(
            "pairs",
            f"{suite.title} differences",
            (ENV, *_PAIR),
            results.pairs,
            "Is one agent better than another on an environment? First minus second, in held-out returns of the"
            " cases that both"
            " have. Interval: 95 %, for one environment and pair alone, over what the column Over names. p: of no"
            " difference, two-sided, from the interval's own distribution; it is at most 0.05 exactly if the interval"
            " excludes 0. Exchange p: exact test that exchanges the runs of both agents, on these cases; it does not"
            " rely on the variance of a few runs. Corrected p: Holm, of the larger of both p, over all rows of this"
            " table together. Significant: corrected p at most 0.05. Too few runs to tell: no returns of so few runs"
            " could reach the corrected level. About how many runs (or cases) would be needed: so many that every"
            " second experiment resolves a true difference of the size seen here, whose own size is uncertain. Against"
            " the random policy, which is one policy, an agent's selected checkpoints are compared. The tie"
            " groups of the leaderboard are a second family of comparisons."
            + checkpoints(suite)
            + f" In {n_unpaired} rows the entries' cases differ: only common cases pair, and the others are left out."
            * bool(n_unpaired),
        ),
        _resolution(suite),
        tabulated(
            "aggregates",
            f"{suite.title} aggregates",
            (
                ENTRY,
                Column(
                    "iqm",
                    "IQM",
                    "number",
                    note="Interquartile mean.",
                    of="iqm.value",
                    spread=lambda one: one.iqm,
                ),
                Column("iqm_interval", INTERVAL, of=lambda one: interval_text(one.iqm)),
                *itertools.chain(*map(_above, _SHOWN_TAUS)),
                ENVIRONMENTS,
                RUNS,
                Column("over", "Over", note="Drawn anew by the bootstrap."),
            ),
            results.aggregates,
            "How good is a typical run of each agent? Over the normalised scores of single runs, not clipped, on"
            " the environments that have a random-to-best"
            " scale (Agarwal et al. 2021). IQM: mean of the middle half. Above: share of the runs whose normalised"
            " score is above it (the performance profile). Intervals: 95 %, percentiles of a bootstrap stratified by"
            " environment, over what the column Over names; the scale is estimated again in each resample. The best"
            " agent's observed mean is the scale's end; where several agents are about as good it is too high on"
            " average, IQMs are too low, and their intervals miss: compare such agents by their differences. Two runs"
            f" to {LEAST_RUNS - 1} are too few for the intervals of shares." + checkpoints(suite),
        ),
        tabulated(
            "improvement",
            f"{suite.title} probability of improvement",
            (
                *_PAIR[:2],
                Column(
                    "probability",
                    "Probability",
                    "number",
                    of="probability.value",
                    spread=lambda one: one.probability,
                ),
                Column("interval", INTERVAL, of=lambda one: interval_text(one.probability)),
                ENVIRONMENTS,
            ),
            results.improvements,
            "How often does a run of the first agent beat a run of the second? Ties count half; mean over the"
            " environments that have a scale (Agarwal et al. 2021). Interval: 95 %, stratified bootstrap over runs and"
            " their cases, or over the cases of single runs." + checkpoints(suite),
        ),
        _generalisation(suite),
    ]


def _above(tau: float) -> tuple[Column, Column]:
    place = TAUS.index(tau)
    key = f"above_{tau:g}".replace(".", "_")
    return with_interval(key, f"Above {tau:g}", lambda one: one.profile[place], 2)


def checkpoints(suite: SuiteStudy) -> str:
    """A caption's sentences where an agent has one run on an environment, or runs that returned the same policy; else
    empty."""
    cells = [cell for cell in suite.table.cells.values() if cell.fixed is None]
    parts = []
    if any(len(cell.samples) == 1 for cell in cells):
        parts.append(
            "With one run or policy a cell this compares the selected checkpoints, not the agents: how an agent's runs"
            " vary is not known."
        )
    same = grouped((cell for cell in cells if cell.repeated), lambda cell: (cell.entry, cell.repeated))
    if same:
        parts.append("Runs that returned the same policy, byte for byte, are one sample.")
    for (entry, repeated), several in same.items():
        parts.append(f"{entry}, {', '.join(title_of(cell.env) for cell in several)}: {repeated}.")
    return "".join(f" {part}" for part in parts)


def _with_interval(field: str) -> Callable[[Pair], str | None]:
    return lambda pair: None if pair.gap is None or pair.gap.low is None else getattr(pair.gap, field)


def _told_apart(pair: Pair) -> str | None:
    if pair.verdict in ("first", "second"):
        return pair.first if pair.verdict == "first" else pair.second
    if pair.verdict == "not comparable":
        return None
    is_of_checkpoints = pair.compares == "checkpoints"
    n = str(pair.n_cases) if is_of_checkpoints else " and ".join(map(str, sorted({*pair.n_runs})))
    if pair.verdict == "too few runs":
        return f"too few runs to tell with {n}; about {pair.n_needed} would do"
    # The interval beside it is for this pair alone.
    alone = pair.p is not None and pair.p <= ALPHA
    text = "not after the correction for all pairs" if alone else "not distinguishable"
    text += f" on {n} cases" if is_of_checkpoints else f" with {n} runs"
    if pair.n_needed is not None:
        return f"{text}; about {pair.n_needed} would be needed"
    more_cases = not is_of_checkpoints and pair.n_cases and pair.gap is not None and pair.gap.value != 0.0
    return f"{text}; more cases would be needed" if more_cases else text


_BETTER = "The better entry, or the reason for none."
_NEEDED = "Runs of each agent, or cases of checkpoints."
_UNPAIRED = "Cases that only some of the runs have."
_PAIR = (
    Column("first", "First"),
    Column("second", "Second"),
    Column("gap", "Difference", "number", of="gap.value", spread=lambda pair: pair.gap),
    Column("interval", INTERVAL, of=lambda pair: interval_text(pair.gap) or pair.reason or None),
    Column("told_apart", "Significantly better", note=_BETTER, of=_told_apart),
    replace(OVER, of=_with_interval("over")),
    Column("method", "Method", of=_with_interval("method")),
    Column("p", "p", "number", digits=4, below=True),
    Column("p_exchange", "Exchange p", "number", digits=4, below=True),
    Column("p_holm", "Corrected p", "number", digits=4, below=True),
    Column("needed", "Needed", "integer", note=_NEEDED, of="n_needed"),
    Column("compares", "Compares", note="Checkpoints, where an entry has one run or policy; else agents."),
    Column(
        "runs",
        "Runs",
        note="Runs that returned the same policy are one.",
        of=lambda pair: "{} and {}".format(*pair.n_runs),
    ),
    Column("cases", "Cases", "integer", of=lambda pair: pair.n_cases or None),
    Column("left_out", "Cases left out", "integer", note=_UNPAIRED, of="n_left_out"),
)


def starts_table(groups: Sequence[StartGroup]) -> Table:
    """Runs from the same submit of an earlier run, compared with each other; no rows without such runs."""
    by_key = {column.key: column for column in _PAIR}
    by_key["told_apart"] = replace(by_key["told_apart"], note="")
    kept = [by_key[key] for key in ("first", "second", "gap", "interval", "over", "p_holm", "told_apart")]
    kept += [by_key["runs"], by_key["cases"]]
    rows: list[dict[str, object]] = []
    for group in groups:
        of = {
            "env": title_of(group.env),
            "start": f"{group.parent}, submit {group.start.submit_index}",
            "scored": "yes" if group.parent_scored else "no",
        }
        rows += [of | row for row in rows_of(group.pairs, (*kept[:2], kept[7], *kept[2:7], kept[8]))] or [
            {**of, "first": label, "runs": str(n), "interval": "no other agent or setting"}
            for label, n in group.variants.items()
        ]
    return Table(
        name="starts",
        title="Differences between runs from one state",
        caption="Runs that start from a submit of an earlier run, compared with those from the same submit:"
        " first minus second, in held-out returns, paired by case, with the 95 % interval and Holm's"
        " correction over all pairs from one state. They are on no leaderboard and in no other table of"
        " scores. Parent scored: the agent of the earlier run, or of a run before it, had ended when one of"
        " these started, so a result may have chosen the submit. The differences between runs from it stay"
        " valid; their level is not a score from scratch.",
        columns=(ENV, Column("start", "From"), Column("scored", "Parent scored"), *kept),
        rows=tuple(rows),
    )


def _resolution(suite: SuiteStudy) -> Table:
    gap, whole = suite.statistics.standings.gap, suite.statistics.overall

    def repeats(share: float) -> Column:
        key = f"repeats_{share:g}".replace(".", "_")
        return Column(key, f"Repeats for {share:g}", of=lambda one: (n := one.repeats(share)) and str(n))

    return tabulated(
        "resolution",
        f"{suite.title} smallest visible differences",
        (
            replace(ENV, of=lambda one: "Mean of all" if one is whole else title_of(one.env)),
            Column("gap", "Smallest difference", "number", of=lambda one: None if one is whole else one.gap),
            Column("normalised_gap", "Normalised", "number", note="As a share of the random-to-best scale."),
            Column("runs", "Runs a cell", of=lambda one: " to ".join(map(str, dict.fromkeys(one.n_runs)))),
            Column("cases", "Cases", "integer", of=lambda one: one.n_cases or None),
            *map(repeats, GAPS),
        ),
        [*suite.statistics.resolutions, *([whole] if whole is not None else [])],
        "How small a difference can these runs and cases show, and how many more runs would a smaller one need? The"
        " half"
        " width of a difference's 95 % interval, median over pairs, in returns and as a share of the random-to-best"
        " scale."
        " Of a true difference of"
        " that size, every second interval excludes 0. Repeats: runs of each agent that a difference of that share of"
        f" the scale would need, at least {least_runs(ALPHA)}, as fewer cannot be significant;"
        f' "more cases" where more runs do not help (up to {MAX_REPEATS} were tried); a'
        " dash with one run a cell, which does not show how runs vary. Mean of all: of the normalised scores"
        " over the environments, which are fixed."
        + (
            ""
            if gap is None
            else f" Of the suite's rank score, a difference of {gap:.3f} is the smallest that is resolved."
        ),
    )


def _generalisation(suite: SuiteStudy) -> Table:
    columns = (
        ENV,
        ENTRY,
        Column("train", "Train mean", "number"),
        Column("validation", "Validation mean", "number"),
        Column("heldout", "Held-out mean", "number"),
        Column("optimism", "Optimism", "number"),
        Column("normalised_optimism", "Normalised optimism", "number"),
        Column("optimism_interval", INTERVAL),
        Column("success", "Success", "percent"),
        RUNS,
    )
    rows = rows_of(suite.statistics.generalisation, [c for c in columns if c.key != "optimism_interval"])
    rows += [
        {
            "env": "Mean of all",
            "entry": entry,
            "normalised_optimism": mean.value,
            "optimism_interval": interval_text(mean),
        }
        for entry, mean in suite.statistics.optimism.items()
    ]
    return Table(
        name="generalisation",
        title=f"{suite.title} generalisation",
        caption="Do the selected policies hold on cases that neither the agent nor the selection saw? Mean return"
        " of the"
        " selected checkpoint on its own submit's train episodes, on validation, and on held-out cases, over"
        " completed runs. Optimism: validation minus held-out. Selection"
        " takes the best of many validation scores, so it is above 0 on average even where an agent fits"
        " nothing. Normalised: as a share of the random-to-best scale; its last rows are means over"
        " environments with a 95 % t interval whose unit is the environment. Success: share of held-out"
        " episodes that reached the goal, where the environment reports it (Fetch, parking), or the return"
        " tells it exactly (MiniGrid, Acrobot, continuous MountainCar).",
        columns=columns,
        rows=tuple(rows),
    )
