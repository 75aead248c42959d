"""How often the intervals of a report cover, and its verdicts are wrong: `coverage.py [TRIALS [CLAIM…]]`.

Measures each claim (or those named) of docs/explanation/statistics.md, writes the tables into that page, and asserts
nothing. `test_statistics_claims.py` fails when the page has a claim without a row.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two processes; before numpy is imported

import msgspec
from invented.simulated_entries import (
    CASE_SHAPES,
    RUN_SHAPES,
    SOLVED,
    Rate,
    World,
    aggregate_rates,
    case_coverage,
    false_gaps,
    mean_coverage,
    optimism_rates,
    rank_rates,
    resolved,
    run_coverage,
    welch_coverage,
)

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "statistics.md"
MISSING = "none"

Measure = Callable[[int], "Sequence[Rate | float]"]
"""From a number of trials, one value per column; rates are shown in percent."""


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """One table of the page."""

    head: str
    columns: tuple[str, ...]
    rows: dict[str, tuple[Measure, float]]
    """By setting: its measurement, and its trials as a share of the bench's."""
    at_least: tuple[float | None, ...] = ()
    at_most: tuple[float | None, ...] = ()
    """Bounds of each column in percent, which the page claims; None where it claims none."""
    exceptions: frozenset[str] = frozenset()
    """Settings that the page names as those where the bounds do not hold."""


CASES = (5, 8, 16, 32, 64, 256)
RUNS = (2, 3, 5, 10, 16)
SOLVED_RUNS = (2, 3, 4, 5, 7, 10, 16)


def _gaps(world: World) -> Measure:
    def measured(trials: int) -> Sequence[Rate | float]:
        return float(trials), *false_gaps(world, trials)

    return measured


def _sometimes(
    n_runs: int, share: float, effect: float, *, alone: bool = False, unlike: bool = False
) -> Measure:
    """`alone`: a single comparison. `unlike`: every second entry is always as good as the others on average."""
    solved, size = (share, 1.0) if unlike else (share,), (2, 1) if alone else (4, 8)
    return _gaps(
        World(
            n_runs=(n_runs,),
            run=0.0,
            solved=solved,
            effect=effect,
            n_entries=size[0],
            n_environments=size[1],
        )
    )


def _ranks(world: World) -> Measure:
    def measured(trials: int) -> Sequence[Rate | float]:
        found = rank_rates(world, trials)
        apart = round(100.0 * found.pairs_apart.share) if found.pairs_apart.given else math.nan
        return found.score, found.rank, found.false_gap, apart

    return measured


def _aggregates(n_runs: int, levels: tuple[float, ...]) -> Measure:
    def measured(trials: int) -> Sequence[Rate | float]:
        found = aggregate_rates(n_runs, levels, trials)
        if (
            n_runs == 1
        ):  # shares and probabilities are then of these checkpoints, whose true values are others
            return found.iqm, math.nan, math.nan
        return found.iqm, found.profile, found.improvement

    return measured


_CLEAR, _CLOSE, _EQUAL = (1.0, 2.0, 3.0, 4.0), (3.5, 3.8, 3.9, 4.0), (4.0, 4.0, 4.0, 4.0)
_UNEVEN = "10 runs, skewed, variances 1 to 16"
_GAPS = ("suites", "pairs with p ≤ 0.05", "false gap after Holm", "false gap of tie groups")
_HALF = "solved in 0.5 of runs, effect 3"
_PAIR, _UNLIKE = "2 entries, 1 environment", "every second entry always half as good"


CLAIMS: dict[str, Claim] = {
    "one-run": Claim(
        head="one run, number of cases",
        columns=tuple(map(str, CASES)),
        rows={shape: (lambda t, s=shape: [case_coverage(s, n, t) for n in CASES], 1.0) for shape in CASE_SHAPES},
        at_least=(None, None, None, 92.0, 92.0, 92.0),
        at_most=(None, None, None, 98.5, 98.5, 98.5),
        exceptions=frozenset({"very skewed (log-normal)"}),
    ),
    "runs": Claim(
        head="runs of each agent (32 cases)",
        columns=tuple(map(str, RUNS)),
        rows={kind: (lambda t, k=kind: [run_coverage(k, n, t) for n in RUNS], 1.0) for kind in RUN_SHAPES},
        at_least=(92.0,) * 5,
        at_most=(None, 98.5, 98.5, 98.5, 98.5),
    ),
    "solved-runs": Claim(
        head="agents that solve a task in some runs (32 cases), runs of each",
        columns=tuple(map(str, RUNS)),
        rows={kind: (lambda t, k=kind: [run_coverage(k, n, t) for n in RUNS], 1.0) for kind in SOLVED},
        at_least=(87.0, 92.0, 92.0, 92.0, 92.0),
    ),
    "solved-means": Claim(
        head="mean of one entry that solves a task in some runs (32 cases), runs",
        columns=tuple(map(str, SOLVED_RUNS)),
        rows={kind: (lambda t, k=kind: [mean_coverage(n, k, t) for n in SOLVED_RUNS], 1.0) for kind in SOLVED},
        at_least=(48.0, 60.0, 66.0, 80.0, 88.0, 90.0, 94.0),
    ),
    "solved-gaps": Claim(
        head="equal entries that solve a task in some runs, 32 cases",
        columns=_GAPS,
        rows={
            **{
                f"{n} runs, {kind}": (_sometimes(n, *how), 0.2)
                for kind, how in SOLVED.items()
                for n in SOLVED_RUNS[:-1]
            },
            **{f"{n} runs, {_HALF}, {_PAIR}": (_sometimes(n, 0.5, 3.0, alone=True), 1.0) for n in (4, 5, 10)},
            **{f"{n} runs, {_HALF}, {_UNLIKE}": (_sometimes(n, 0.5, 3.0, unlike=True), 0.2) for n in (7, 10)},
        },
        at_most=(None, None, 5.0, 5.0),
        exceptions=frozenset(f"{n} runs, {_HALF}, {_UNLIKE}" for n in (7, 10)),
    ),
    "means": Claim(
        head="mean of one entry (32 cases), runs",
        columns=("1", "3", "10"),
        rows={
            shape: (lambda t, s=shape: [mean_coverage(n, s, t) for n in (1, 3, 10)], 1.0)
            for shape in ("normal", "skewed", "0/1")
        },
        at_least=(92.0,) * 3,
    ),
    "own-cases": Claim(
        head="runs with cases of their own, one agent twice as noisy",
        columns=("2", "3", "5", "10"),
        rows={
            kind: (lambda t, k=kind: [welch_coverage(k, n, t) for n in (2, 3, 5, 10)], 1.0)
            for kind in ("normal", "skewed", *(kind for kind in SOLVED if kind.endswith("3")))
        },
        at_least=(89.0,) * 4,
    ),
    "false-gaps": Claim(
        head="equal entries, 8 environments, 32 cases",
        columns=_GAPS,
        rows={
            **{
                f"4 entries, {n} run{'s' * (n > 1)}, agent × case {sd:g}": (
                    _gaps(World(n_runs=(n,), interaction=sd)), 0.4
                )
                for n in (1, 4, 10)
                for sd in (0.0, 0.5, 1.0)
            },
            "10 entries, 4 runs, agent × case 0.5": (_gaps(World(n_entries=10, interaction=0.5)), 0.2),
            "20 entries, 4 runs, agent × case 0.5": (_gaps(World(n_entries=20, interaction=0.5)), 0.1),
            "2, 10, 3 and 5 runs, variances 4, 1, 1/4 and 1, agent × case 0": (
                _gaps(World(n_runs=(2, 10, 3, 5), noise=(2.0, 1.0, 0.5, 1.0))), 0.4
            ),
            "2, 10, 3 and 5 runs, variances 1, 4, 1/4 and 1, agent × case 0.5": (
                _gaps(World(n_runs=(2, 10, 3, 5), noise=(1.0, 2.0, 0.5, 1.0), interaction=0.5)), 0.4
            ),
            "4, 4, 4 and 1 runs that do not vary, agent × case 0.5": (
                _gaps(World(n_runs=(4, 4, 4, 1), run=0.0, interaction=0.5)), 0.4
            ),
            "1 environment, 4 runs, agent × case 0.5": (_gaps(World(n_environments=1, interaction=0.5)), 1.0),
            "4 runs, 0/1, agent × case 0.5": (_gaps(World(shape="0/1", interaction=0.5)), 0.4),
            "1 run, 0/1": (_gaps(World(shape="0/1", n_runs=(1,))), 0.4),
            "4 runs, skewed, agent × case 0.5": (_gaps(World(shape="skewed", interaction=0.5)), 0.4),
            _UNEVEN: (
                _gaps(World(shape="skewed", n_runs=(10,), interaction=0.5, run=1.0, noise=(1.0, 2.0, 0.5, 1.0))), 0.4
            ),
        },
        at_most=(None, 5.5, 5.0, 5.0),
        exceptions=frozenset({_UNEVEN}),
    ),
    "ranks": Claim(
        head="rank scores, 5 entries, 16 environments",
        columns=("score covered", "ranks covered", "false gaps", "pairs separated"),
        rows={
            f"{n} run{'s' * (n > 1)}, gaps {gap:g}": (
                _ranks(World(n_runs=(n,), spread=gap, n_entries=5, n_environments=16)), 0.1
            )
            for n in (1, 3, 10)
            for gap in (0.0, 0.1, 0.3, 1.0)
        },
        at_least=(88.0, 95.0, None, None),
        at_most=(None, None, 5.0, None),
    ),
    "aggregates": Claim(
        head="aggregates of 16 environments",
        columns=("IQM", "profile at 0.5", "probability of improvement"),
        rows={
            **{f"{n} run{'s' * (n > 1)}, clear best agent": (_aggregates(n, _CLEAR), 0.2) for n in (1, 3, 5, 10)},
            "5 runs, close agents": (_aggregates(5, _CLOSE), 0.2),
            "5 runs, equal agents": (_aggregates(5, _EQUAL), 0.2),
        },
        at_least=(92.0, 85.0, 88.0),
        exceptions=frozenset({"5 runs, close agents", "5 runs, equal agents"}),
    ),
    "resolution": Claim(
        head="a difference of the stated size is resolved",
        columns=("share",),
        rows={
            **{
                f"{n} runs, smallest difference, by the interval": (lambda t, n=n: [resolved(n, t)], 1.0)
                for n in (3, 5, 10)
            },
            "runs needed after Holm over 48 pairs": (lambda t: [resolved(0, t, level=0.05 / 48)], 1.0),
        },
        at_least=(40.0,),
        at_most=(70.0,),
    ),
    "optimism": Claim(
        head="optimism of equally good submits, 16 environments",
        columns=("above 0", "interval covers"),
        rows={
            f"{n} submits": (lambda t, n=n: optimism_rates(t, n_submits=n), 1.0) for n in (2, 10, 50)
        },
        at_least=(90.0, 92.0),
    ),
}  # fmt: skip


def shown(value: Rate | float) -> str:
    """A rate in percent with its standard error, and how many trials gave no interval or verdict."""
    if not isinstance(value, Rate):
        return MISSING if math.isnan(value) else f"{value:.0f}"
    if not value.given:
        return MISSING
    missing = 100.0 * (1.0 - value.given / value.trials)
    share = value.share
    # Of 0 or all, that of one more or fewer.
    error = math.sqrt(max(share * (1.0 - share), 1.0 / value.given) / value.given)
    return f"{100.0 * share:.1f} ± {100.0 * error:.1f}" + (f" ({missing:.0f} none)" if missing >= 0.5 else "")


def measured(name: str, setting: str, trials: int) -> str:
    """One row of a claim's table."""
    measure, share = CLAIMS[name].rows[setting]
    return f"| {setting} | " + " | ".join(map(shown, measure(max(10, int(trials * share))))) + " |"


def table(name: str, rows: Sequence[str]) -> str:
    claim = CLAIMS[name]
    head = f"| {claim.head} | " + " | ".join(claim.columns) + " |"
    return "\n".join([head, "|---|" + "---:|" * len(claim.columns), *rows])


def main() -> None:
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    names = sys.argv[2:] or list(CLAIMS)
    with ProcessPoolExecutor(2) as pool:
        asked = {
            name: [pool.submit(measured, name, row, trials) for row in CLAIMS[name].rows] for name in names
        }
        for name, rows in asked.items():
            write(name, table(name, [row.result() for row in rows]))


def write(name: str, made: str) -> None:
    """Prints a table and puts it into the page."""
    print(f"{name}\n{made}\n", flush=True)
    text = PAGE.read_text(encoding="utf-8")
    place = re.compile(rf"(<!-- claim: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    PAGE.write_text(place.sub(lambda found: f"{found[1]}{made}\n{found[2]}", text), encoding="utf-8")


if __name__ == "__main__":
    main()
