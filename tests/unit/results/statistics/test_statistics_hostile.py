"""Statistics of what is missing, equal, infinite or not comparable: never a crash, never a number that is none."""

from __future__ import annotations

import itertools
import math
import re
import shutil
import warnings
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from invented.policies import Version, policy
from invented.run_dirs import write_run
from invented.simulated_entries import World, observed_scores, suite_samples
from invented.study import write_suite

from evopolicy_common.statistics.intervals import TOO_FEW_CASES, over_cases
from evopolicy_results.notebook import figures_of, tables_of
from evopolicy_results.scoring.scores import Cell, RunReturns, Scale, heldout_returns
from evopolicy_results.statistics.aggregates import NO_SCALE, Aggregate, aggregates
from evopolicy_results.statistics.intervals import holm
from evopolicy_results.statistics.pairs import (
    NO_COMMON_CASES,
    NO_RETURNS,
    NO_SCORE,
    Pair,
    cell_mean,
    matched,
    pairs,
)
from evopolicy_results.statistics.standings import Standings, standings
from evopolicy_results.studies.study import study, study_of
from evopolicy_results.tables.latex import to_latex
from evopolicy_results.tables.table import Table, to_csv, to_markdown


def run(*returns: float, case_set: str = "cases", score: float | None = math.nan) -> RunReturns:
    finite = [value for value in returns if math.isfinite(value)]
    own = float(np.mean(finite)) if finite else 0.0
    expected = own if score is not None and math.isnan(score) else score
    return RunReturns(score=expected, returns=returns, case_set=case_set)


def entry(name: str, *runs: RunReturns, env: str = "env", is_fixed: bool = False) -> Cell:
    return Cell(entry=name, env=env, runs=runs, fixed=runs[0].score if is_fixed else None)


def together(*entries: Cell) -> dict[tuple[str, str], Cell]:
    return {(one.entry, one.env): one for one in entries}


def pair_of(first: Cell, second: Cell) -> Pair:
    (found,) = pairs(together(first, second), [first.entry, second.entry], ["env"])
    return found


def rising(n: int, shift: float = 0.0) -> tuple[float, ...]:
    return tuple(float(i) + shift + 0.1 * math.sin(7.0 * i + shift) for i in range(n))


def repeated(name: str, n: int, shift: float, step: float = 1.0) -> Cell:
    """An entry of n runs, each `step` above the one before."""
    return entry(name, *(run(*rising(32, shift + step * r)) for r in range(n)))


def test_missing_cases_leave_only_common_ones_and_their_number_is_reported() -> None:
    first = entry("A", run(*rising(20, 1.0)))
    second = entry("B", run(math.nan, *rising(20)[1:18], math.inf))
    found = pair_of(first, second)
    assert (found.n_cases, found.n_left_out) == (17, 3)
    expected = np.array(rising(20, 1.0)[1:18]) - np.array(rising(20)[1:18])
    assert found.gap.value == pytest.approx(expected.mean())


def test_entries_on_other_cases_do_not_pair() -> None:
    found = pair_of(entry("A", run(*rising(20))), entry("B", run(*rising(20), case_set="others")))
    assert found.reason == NO_COMMON_CASES
    assert (found.verdict, found.p, found.n_cases) == ("not comparable", None, 0)
    own_cases = pair_of(entry("A", run(*rising(20), case_set="")), entry("B", run(*rising(20), case_set="")))
    assert own_cases.reason == NO_COMMON_CASES


def test_runs_with_cases_of_their_own_are_compared_as_runs() -> None:
    first = entry("A", *(run(*rising(8, 5.0 + 0.3 * r), case_set=f"a{r}") for r in range(8)))
    second = entry("B", *(run(*rising(8, 0.3 * r), case_set=f"b{r}") for r in range(8)))
    found = pair_of(first, second)
    assert (found.gap.method, found.gap.over, found.n_cases) == ("Welch t", "runs", 0)
    assert (found.verdict, found.compares) == ("first", "agents")


def test_one_run_compares_checkpoints_and_several_compare_agents() -> None:
    single = entry("B", run(*rising(32)))
    one = pair_of(entry("A", run(*rising(32, 3.0))), single)
    assert (one.compares, one.verdict, one.gap.over) == ("checkpoints", "first", "cases")
    assert pair_of(repeated("A", 4, 3.0), single).compares == "checkpoints"
    fixed = pair_of(repeated("A", 4, 3.0), entry("R", run(*rising(32)), is_fixed=True))
    assert (fixed.compares, fixed.gap.over, fixed.p_exchange) == ("checkpoints", "cases", None)
    several = pair_of(repeated("A", 4, 30.0), repeated("B", 4, 0.0))
    assert (several.compares, several.gap.over) == ("agents", "runs and cases")
    assert (several.verdict, several.p_exchange) == ("first", pytest.approx(2 / 70))


def test_too_few_cases_and_too_few_runs_are_said() -> None:
    found = pair_of(entry("A", run(2.0, 3.0)), entry("B", run(1.0, 1.5)))
    assert (found.gap.low, found.gap.reason, found.verdict) == (None, TOO_FEW_CASES, "not comparable")
    # Two runs each: no exchange of runs can be rarer than one in three, however far apart they are.
    few = pair_of(repeated("A", 2, 50.0), repeated("B", 2, 0.0, 0.1))
    assert few.p < 0.05 < few.p_exchange == pytest.approx(1 / 3)
    assert (few.verdict, few.n_needed) == ("too few runs", 4)
    noisy = pair_of(repeated("A", 2, 2.0, 3.0), repeated("B", 2, 0.0, 3.0))
    assert noisy.verdict == "too few runs"
    assert 5 <= noisy.n_needed <= 40
    same = [repeated(name, 4, 0.0, 3.0) for name in ("A", "B")]
    assert pair_of(*same).verdict == "not told apart"


def test_runs_that_would_do_follow_from_the_whole_family() -> None:
    """Four runs reach the level of one comparison, not that of three environments; there five would do."""
    envs = ["a", "b", "c"]
    cells = [repeated(name, 4, shift) for name, shift in (("A", 50.0), ("B", 0.0))]
    samples = together(*(msgspec.structs.replace(cell, env=env) for cell in cells for env in envs))
    for n, verdict in ((3, "too few runs"), (1, "first")):
        found = pairs(samples, ["A", "B"], envs[:n])
        assert {one.verdict for one in found} == {verdict}
        assert {one.n_needed for one in found} == {5 if n == 3 else None}


def test_identical_returns_have_no_spread_and_no_gap() -> None:
    same = pair_of(repeated("A", 1, 0.0), repeated("B", 1, 0.0))
    assert (same.gap.value, same.gap.low, same.gap.reason) == (0.0, None, "no spread: 32 identical cases")
    assert (same.p, same.verdict) == (None, "not comparable")
    constant = [entry(name, *[run(*[1.0] * 32)] * 3) for name in ("A", "B")]
    found = pair_of(*constant)
    assert (found.gap.reason, found.p) == ("no spread: 3 identical repeats", None)


def test_returns_of_nought_and_one_are_counted() -> None:
    first, second = [1.0] * 30 + [0.0] * 2, [0.0] * 16 + [1.0] * 16
    gap = pair_of(entry("A", run(*first)), entry("B", run(*second))).gap
    assert gap.method == "score"
    assert -1.0 <= gap.low < gap.value < gap.high <= 1.0
    mean = cell_mean(entry("A", run(*first)))
    assert 0.0 <= mean.low < mean.value < mean.high <= 1.0


def test_a_run_without_an_ok_submit_has_no_gap_and_stays_last() -> None:
    failed = entry("C", RunReturns(score=None))
    samples = together(entry("A", run(*rising(32, 1.0))), entry("B", run(*rising(32))), failed)
    found = pairs(samples, ["A", "B", "C"], ["env"])
    assert [one.reason for one in found] == ["", NO_SCORE, NO_SCORE]
    assert found[1].gap is None
    board = standings(samples, {"A": 1.0, "B": 0.5, "C": 0.0}, ["env"], compared=found)
    assert [(row.entry, row.ties) for row in board.rows] == [("A", "a"), ("B", "b"), ("C", "c")]
    (a, _, c), _ = aggregates(samples, ["A", "B", "C"], {"env": Scale(random=0.0, best=20.0)})
    assert a.iqm is not None
    assert c.iqm is None
    assert cell_mean(failed) is None


def test_scores_alone_have_no_interval_and_do_not_tie() -> None:
    samples = together(*(entry(name, RunReturns(score=score)) for name, score in (("A", 1.0), ("B", 2.0))))
    assert pairs(samples, ["A", "B"], ["env"])[0].reason == NO_RETURNS
    assert standings(samples, {"A": 0.0, "B": 1.0}, ["env"]) == Standings()


def test_an_aggregate_without_spread_says_so_instead_of_a_zero_width() -> None:
    samples = together(entry("A", *[run(*[1.0] * 8)] * 6))
    (found,), _ = aggregates(samples, ["A"], {"env": Scale(random=0.0, best=2.0)})
    assert (found.iqm.value, found.iqm.low, found.iqm.reason) == (0.5, None, "no spread: 6 identical repeats")
    # The best agent's own mean is the scale, whatever it is.
    (found,), _ = aggregates(samples, ["A"], {"env": Scale(random=0.0, best=1.0)})
    assert (found.iqm.value, found.iqm.low) == (1.0, None)


def aggregated(a: Cell, b: Cell, reference: Cell, best: Cell) -> list[Aggregate]:
    """Of A and B, on the scale from the reference's mean to that of the best."""
    scale = Scale(random=float(np.mean(reference.scores)), best=float(np.mean(best.scores)))
    return aggregates(together(a, b, reference), ["A", "B"], {"env": scale})[0]


def test_an_uncertain_scale_widens_the_interval_of_an_iqm() -> None:
    """A's own scores hardly vary, B's (the best) and the reference's do: A's share of the scale is uncertain."""
    generator = np.random.default_rng(0)
    a = entry("A", *(run(*[5.0 + 0.001 * r] * 32) for r in range(6)))
    b = entry("B", *(run(*generator.normal(10.0 + 2.0 * r, 1.0, 32)) for r in range(6)))
    found, _ = aggregated(a, b, entry("R", run(*generator.normal(0.0, 4.0, 32)), is_fixed=True), b)
    # Standard errors of the ends: about 1.5 and 0.7, of a width of 15.
    assert 0.08 < found.iqm.high - found.iqm.low < 0.4


def test_a_scale_that_may_be_none_gives_no_interval() -> None:
    """The best agent's mean is above the reference's by far less than its standard error."""
    generator = np.random.default_rng(1)
    reference = generator.normal(0.0, 1.0, 32)
    a = entry("A", *(run(*(reference[::-1] + 0.1 * r)) for r in range(6)))
    b = entry("B", *(run(*generator.normal(-0.5, 1.0, 32)) for _ in range(6)))
    _, found = aggregated(a, b, entry("R", run(*reference), is_fixed=True), a)
    assert (found.iqm.low, found.iqm.reason) == (None, NO_SCALE)


def test_tie_letters_are_shared_exactly_where_entries_are_not_told_apart() -> None:
    """A is better than C; B is told apart from neither."""
    generator = np.random.default_rng(0)
    base = generator.normal(size=(16, 32))
    shifts = {"A": 0.35, "B": 0.175, "C": 0.0}
    samples = together(
        *(
            entry(name, run(*(base[i] + shift + generator.normal(0, 1, 32)).tolist()), env=f"e{i}")
            for name, shift in shifts.items()
            for i in range(16)
        )
    )
    found = standings(samples, {"A": 0.9, "B": 0.5, "C": 0.1}, [f"e{i}" for i in range(16)])
    letters = {row.entry: set(row.ties) for row in found.rows}
    ranks = {row.entry: (row.rank_low, row.rank_high) for row in found.rows}
    assert not letters["A"] & letters["C"]
    for name, low, high in (("A", 1, 2), ("C", 2, 3)):
        assert low <= ranks[name][0] <= ranks[name][1] <= high


worlds = st.builds(
    World,
    n_runs=st.lists(st.integers(1, 5), min_size=1, max_size=3).map(tuple),
    interaction=st.sampled_from([0.0, 0.5, 1.0]),
    noise=st.sampled_from([(1.0,), (0.2, 3.0)]),
    spread=st.sampled_from([0.0, 0.5, 2.0]),
    n_entries=st.integers(2, 4),
    n_environments=st.integers(1, 3),
    n_cases=st.integers(1, 12),
    shape=st.sampled_from(["normal", "skewed", "0/1"]),
)


@settings(max_examples=100, deadline=None)
@given(worlds, st.integers(0, 2**32 - 1))
def test_a_verdict_never_contradicts_the_interval_beside_it(world: World, seed: int) -> None:
    generator = np.random.default_rng(seed)
    samples = suite_samples(world.returns(generator, world.means(generator)))
    for pair in pairs(samples, world.names, world.environments, resamples=200):
        gap = pair.gap
        excluded = gap.low is not None and gap.high is not None and (gap.low > 0.0 or gap.high < 0.0)
        assert (pair.p is not None and pair.p <= 0.05) == excluded
        if pair.verdict in ("first", "second"):
            assert excluded
            assert pair.p_exchange is None or pair.p_exchange <= 0.05
            assert (gap.value > 0.0) == (pair.verdict == "first")
            assert pair.n_needed is None
    if world.n_environments == 1:
        found = pairs(samples, world.names, world.environments, resamples=200)
        told = {frozenset((one.first, one.second)) for one in found if one.verdict in ("first", "second")}
        scores = observed_scores(world, samples)
        rows = standings(samples, scores, world.environments, compared=found, resamples=200).rows
        for one, other in itertools.combinations(rows, 2):
            if not set(one.ties) & set(other.ties):
                assert frozenset((one.entry, other.entry)) in told


returns = st.lists(
    st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.sampled_from([0.0, 1.0, -1.0])), max_size=12
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.lists(returns, min_size=1, max_size=3), min_size=2, max_size=3))
def test_any_numbers_give_finite_intervals_or_a_reason(every: list[list[list[float]]]) -> None:
    names = [f"entry-{i}" for i in range(len(every))]
    samples = {
        (name, "env"): entry(name, *(run(*(min(1e100, max(-1e100, v)) if math.isfinite(v) else v for v in one)) for one in runs))  # noqa: E501
        for name, runs in zip(names, every, strict=True)
    }  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = pairs(samples, names, ["env"], resamples=50)
        board = standings(samples, dict.fromkeys(names, 0.5), ["env"], compared=found, resamples=50)
    for one in found:
        assert one.p is None or 0.0 < one.p <= 1.0
        if one.gap is not None and one.gap.low is not None:
            assert math.isfinite(one.gap.low)
            assert one.gap.low <= one.gap.value + 1e-6 * abs(one.gap.value)
            assert one.gap.value - 1e-6 * abs(one.gap.value) <= one.gap.high
        else:
            assert one.reason
    for row in board.rows:
        assert 0.0 <= row.score_low <= 0.5 <= row.score_high <= 1.0, "the observed score is in its interval"
        assert 1 <= row.rank_low <= row.rank_high <= len(names)


def test_matched_keeps_the_order_of_runs_and_refuses_unknown_cases() -> None:
    found = matched([entry("A", run(1.0, 2.0), run(3.0, 4.0)), entry("B", run(5.0, math.nan))])
    assert [matrix.tolist() for matrix in found.returns] == [[[1.0], [3.0]], [[5.0]]]
    assert matched([entry("A", RunReturns(score=1.0))]) is None
    assert matched([]) is None


def table_named(tables: list[Table], name: str) -> Table:
    return next(table for table in tables if table.name == name)


ENVS = ["gym/acrobot", "gymnasium/MiniGrid-FourRooms-v0", "gym/ant5"]


def test_report_of_single_runs_says_that_it_compares_checkpoints(tmp_path: Path) -> None:
    write_suite(tmp_path / "runs", environments=ENVS)
    found = study([tmp_path / "runs"])
    tables = tables_of(found)
    for name in ("leaderboard", "pairs", "aggregates", "improvement"):
        assert "compares the selected checkpoints, not the agents" in table_named(tables, name).caption
    board = table_named(tables, "leaderboard")
    agents = [row for row in board.rows if row["harness"] != "Uniform"]
    assert all(row["ties"] and row["score_interval"] and row["rank_interval"] for row in agents)
    shown = table_named(tables, "pairs")
    assert {row["compares"] for row in shown.rows} == {"checkpoints"}
    assert {row["cases"] for row in shown.rows if row["second"] != "Random policy"} == {32}
    resolution = table_named(tables, "resolution")
    assert {row["repeats_0_1"] for row in resolution.rows} == {None}
    assert "profiles_core16" in {plot.name for plot in figures_of(found)}
    general = table_named(tables, "generalisation")
    success = {row["env"]: row.get("success") for row in general.rows if row["entry"] == "Kestrel"}
    assert success["Acrobot"] == 1.0
    assert success["Ant"] is None
    assert 0.0 <= success["FourRooms"] <= 1.0


def test_report_of_repeats_compares_agents_and_tells_repeats(tmp_path: Path) -> None:
    write_suite(tmp_path / "runs", environments=ENVS, repeats=3)
    tables = tables_of(study([tmp_path / "runs"]))
    assert "not the agents" not in table_named(tables, "pairs").caption
    shown = table_named(tables, "pairs")
    agents = [row for row in shown.rows if row["second"] != "Random policy"]
    assert {(row["compares"], row["over"], row["method"]) for row in agents} == {
        ("agents", "runs and cases", "crossed t")
    }
    verdicts = {row["told_apart"] for row in agents}
    assert any(re.fullmatch(r"too few runs to tell with 3; about \d+ would do", v) for v in verdicts)
    assert all(row["repeats_0_2"] for row in table_named(tables, "resolution").rows)


def test_an_incomplete_entry_stands_beside_no_complete_one_by_a_mean(tmp_path: Path) -> None:
    for folder in write_suite(tmp_path / "runs", environments=ENVS, repeats=2):
        if folder.parts[-3:-1] == ("Kestrel", "gym_ant5"):
            shutil.rmtree(folder)
    found = study([tmp_path / "runs"])
    tables = tables_of(found)
    (lacking,) = table_named(tables, "incomplete").rows
    assert (lacking["entry"], lacking["environments"], lacking["missing"]) == ("Kestrel", "2 of 3", "Ant")
    for name in ("leaderboard", "aggregates", "improvement"):
        table = table_named(tables, name)
        for text in (to_csv(table), to_latex(table), to_markdown(table)):
            assert "Northwind" in text
            assert "Kestrel" not in text
    means = [row for row in table_named(tables, "normalised").rows if row["env"] == "Tuning mean"]
    assert [row["Kestrel"] for row in means] == [None]
    optimism = table_named(tables, "generalisation").rows
    assert "Kestrel" not in {row["entry"] for row in optimism if row["env"] == "Mean of all"}
    # Single environments and differences keep it.
    assert {row["env"] for row in table_named(tables, "cells").rows if row["entry"] == "Kestrel"} == {
        "Acrobot", "FourRooms",
    }  # fmt: skip
    assert "Kestrel" in to_csv(table_named(tables, "pairs"))
    plots = {plot.name: plot for plot in figures_of(found)}
    for name in ("rank_scores_core16", "profiles_core16"):
        assert "Kestrel" not in {row["entry"] for row in plots[name].data}
    (group,) = [
        r for r in plots["normalised_core16"].data if (r["entry"], r["demand"]) == ("Kestrel", "tuning")
    ]
    assert group["value"] is None


def test_the_papers_own_table_has_scores_only_and_says_so() -> None:
    found = study_of([], scores=heldout_returns())
    tables = tables_of(found)
    shown = table_named(tables, "pairs")
    assert {row["interval"] for row in shown.rows} == {NO_RETURNS}
    assert "ties" not in {column.key for column in table_named(tables, "leaderboard").columns}
    assert msgspec.json.encode(shown.rows)


VERSIONS = [Version(policy(gain=1.0), (-200.0,), -180.0)]


def test_mixed_splits_that_were_allowed_are_not_paired(tmp_path: Path) -> None:
    for name, split in (("A", "split-1"), ("B", "split-2")):
        write_run(tmp_path / "runs", VERSIONS, entry=name, split=split, heldout=rising(32))
    found = study([tmp_path / "runs"], allow_mixed=True)
    (pair,) = [one for one in found.suites[0].statistics.pairs if one.second == "B"]
    assert pair.reason == NO_COMMON_CASES


def test_pairs_with_the_random_reference_are_of_the_same_family(tmp_path: Path) -> None:
    for name, shift in (("A", 40.0), ("B", 20.0)):
        random = {"mean_return": sum(rising(32)) / 32, "returns": rising(32)}
        change = {"outcome": {"random_reference": random}}
        write_run(tmp_path / "runs", VERSIONS, entry=name, heldout=rising(32, shift), change=change)
    found = study([tmp_path / "runs"]).suites[0].statistics
    assert [(one.first, one.second, one.verdict) for one in found.pairs] == [
        ("A", "B", "first"), ("A", "Random policy", "first"), ("B", "Random policy", "first"),
    ]  # fmt: skip
    assert [one.p_holm for one in found.pairs] == pytest.approx(holm([one.p for one in found.pairs]))
    assert all(one.p_holm > one.p for one in found.pairs[:2] if one.p and one.p_holm)
    assert {(row.entry, row.ties, row.rank_low, row.rank_high) for row in found.standings.rows} == {
        ("A", "a", 1, 1), ("B", "b", 2, 2), ("Random policy", "c", 3, 3),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("env", "returns", "share"),
    [
        ("gym/acrobot", [-500.0, -499.0, -80.0, -500.0], 0.5),
        ("gym/continuouscar", [-99.9, 0.0, 0.1, 93.0], 0.5),
        ("gymnasium/MiniGrid-FourRooms-v0", [0.0, 0.1, 0.9, 1.0], 0.75),
        ("gym/racing", [900.0, 950.0, 10.0, 1.0], None),
    ],
)
def test_success_is_reported_where_the_return_tells_it(
    tmp_path: Path, env: str, returns: list[float], share: float | None
) -> None:
    for number, (reported, expected) in enumerate([(..., share), ([True, True, True, False], 0.75)]):
        # What the environment reported comes first.
        change = {"outcome": {"heldout_successes": reported}}
        runs = tmp_path / str(number)
        write_run(runs, VERSIONS, env=env, heldout=returns, random_mean=None, change=change)
        (one,) = study([runs]).suites[0].statistics.generalisation
        assert one.success == expected


@pytest.mark.parametrize(
    ("repaired", "rate"),
    [
        ({"steps": 1000, "action_invalid": 5}, 0.005),
        ({"steps": 0, "action_invalid": 0}, None),
        ({"steps": 3, "action_invalid": 4}, None),
        ({"steps": "many", "action_invalid": 4}, None),
        ([1], None),
        (None, None),
    ],
)
def test_rate_of_repaired_actions_is_reported_where_it_was_recorded(
    tmp_path: Path, repaired: object, rate: float | None
) -> None:
    change = {"outcome": {"auxiliary": {"transitions": ... if repaired is None else repaired}}}
    write_run(tmp_path / "runs", VERSIONS, change=change)
    tables = tables_of(study([tmp_path / "runs"]))
    assert [row.get("repaired_rate") for row in table_named(tables, "audit").rows] == [rate]


def test_selection_optimism_is_validation_minus_heldout(tmp_path: Path) -> None:
    versions = [
        Version(policy(gain=1.0), (-200.0, -190.0), -180.0),
        Version(policy(gain=2.0), (-90.0,), -95.0),
    ]
    write_run(tmp_path / "runs", versions, heldout=[-100.0, -110.0])
    (one,) = study([tmp_path / "runs"]).suites[0].statistics.generalisation
    assert (one.train, one.validation, one.heldout, one.optimism) == (-90.0, -95.0, -105.0, 10.0)
    assert one.normalised_optimism == pytest.approx(10.0 / 395.0)


def test_rounding_errors_of_constant_resamples_are_no_spread() -> None:
    found = over_cases(np.array([-73.0, -68.0] + [-80.0] * 10))
    assert (found.low, found.reason) == (None, TOO_FEW_CASES)
