"""How often the intervals of a report cover, and its verdicts are wrong: `python tests/bench/coverage.py [TRIALS]`.

Prints the tables of docs/explanation/statistics.md, asserts nothing. 2,000 trials take about twenty minutes on one core.
"""

from __future__ import annotations

import sys

from invented.simulated_entries import (
    CASE_SHAPES,
    RUN_SHAPES,
    Rate,
    case_coverage,
    false_gaps_by_holm,
    iqm_coverage,
    rank_rates,
    run_coverage,
)

CASES = (5, 8, 16, 32, 64, 256)
RUNS = (2, 3, 5, 10, 16)


def shown(rate: Rate) -> str:
    """Coverage of the intervals that were given, and how many were not, in percent."""
    if not rate.given:
        return "none"
    missing = 100.0 * (1.0 - rate.given / rate.trials)
    return f"{100.0 * rate.share:.1f}" + (f" ({missing:.0f} none)" if missing >= 0.5 else "")


def table(head: str, columns: tuple[object, ...], rows: dict[str, list[str]]) -> None:
    print(f"| {head} | " + " | ".join(map(str, columns)) + " |")
    print("|---|" + "---:|" * len(columns))
    for name, cells in rows.items():
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    print()


def main() -> None:
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    few = max(20, trials // 10)
    table(
        "one run: cases", CASES,
        {shape: [shown(case_coverage(shape, n, trials)) for n in CASES] for shape in CASE_SHAPES},
    )  # fmt: skip
    table(
        "runs of each agent, 32 cases", RUNS,
        {kind: [shown(run_coverage(kind, n, trials)) for n in RUNS] for kind in RUN_SHAPES},
    )  # fmt: skip
    rows: dict[str, list[str]] = {}
    for n_runs in (1, 3, 10):
        for spread in (0.0, 0.1, 0.3, 1.0):
            found = rank_rates(spread, few, n_runs=n_runs)
            rows[f"{n_runs} run{'s' * (n_runs > 1)}, gaps {spread:g}"] = [
                shown(found.score), shown(found.rank), shown(found.false_gap), f"{100 * found.pairs_apart:.0f}"
            ]  # fmt: skip
    table("rank scores", ("score covered", "ranks covered", "false gaps", "pairs separated"), rows)
    table(
        "Holm, equal entries",
        (1, 4, 10),
        {"suites with a false gap": [shown(false_gaps_by_holm(n, 2 * few)) for n in (1, 4, 10)]},
    )
    table(
        "IQM, runs a cell",
        (2, 3, 5, 10),
        {"covered": [shown(iqm_coverage(n, trials)) for n in (2, 3, 5, 10)]},
    )


if __name__ == "__main__":
    main()
