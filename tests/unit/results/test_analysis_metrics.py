"""Edit types, evolution, structure, edit sizes, tokens and audit signals, on cases computed by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_common.records.run_record import Tokens
from evopolicy_results.behaviour.audit import mean_phases, token_use
from evopolicy_results.behaviour.edits import classify, edit_rates, edit_size_bins, structure_means
from evopolicy_results.reading.reader import load_runs, read_run
from evopolicy_results.scoring.evolution import CurvePoint, area, best_at, episodes_to
from evopolicy_results.scoring.scores import RANDOM_ENTRY, Scale, references, score_table
from evopolicy_results.studies.study import study_of
from evopolicy_results.tables.report_tables import tables_of

BROKEN = Version({"policy.py": "import nothing\n"}, (0.0,) * 2, None, "import_error")
VERSIONS = [
    Version(policy(gain=1.0), (10.0,) * 8, 10.0),  # first
    Version(policy(gain=2.0), (12.0,) * 8, 20.0),  # parametric, hit
    BROKEN,
    Version(policy(gain=2.0, integral=True), (11.0,) * 8, 15.0),  # synthesis, no hit
    Version(
        policy(gain=3.0), (15.0,) * 8, 40.0
    ),  # rollback of the topology with other constants, raises the best
    Version(policy(gain=3.0), (14.0,) * 8, 40.0),  # retest
    Version(policy(gain=1.0), (14.0,) * 8, 10.0),  # parametric although these bytes were seen
    Version(policy(gain=1.0, planner=True), (20.0,) * 8, 80.0),  # synthesis, hit
    Version(
        {**policy(gain=1.0, planner=True), "notes.py": "x = 1\n"}, (20.0,) * 8, 80.0
    ),  # a dead module: data only
]


def test_transitions_are_classified_and_hits_raise_the_validation_best(tmp_path: Path) -> None:
    found = classify(read_run(write_run(tmp_path, VERSIONS)).submits)
    assert [t.edit for t in found] == [
        "first", "parametric", "synthesis", "rollback", "retest", "parametric", "synthesis", "data",
    ]  # fmt: skip
    assert [t.hit for t in found] == [True, True, False, True, False, False, True, False]
    assert [t.previous for t in found] == [None, 0, 1, 3, 4, 5, 6, 7]
    assert [t.best for t in found] == [10.0, 20.0, 20.0, 40.0, 40.0, 40.0, 80.0, 80.0]
    assert found[3].back_to == 1
    assert [t.val_drop for t in found] == [False, False, True, False, False, True, False, False]
    assert [t.mean_improved for t in found] == [None, True, False, True, False, False, True, False]


def test_rates_count_what_is_excluded_and_why(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS)
    write_run(tmp_path, VERSIONS[:2], env="gym/racing")
    write_run(tmp_path, VERSIONS[:1], env="toy/line")
    rates = {(row.entry, row.demand): row for row in edit_rates(load_runs([tmp_path]).runs)}
    tuning = rates["Agent A", "tuning"]
    rated = (tuning.n_synthesis, tuning.hits_synthesis, tuning.n_parametric, tuning.hits_parametric)
    assert rated == (2, 1, 2, 1)
    assert (tuning.n_rollback, tuning.n_retest, tuning.n_data) == (1, 1, 1)
    assert (tuning.n_first, tuning.n_not_ok, tuning.n_unscored) == (1, 1, 0)
    assert tuning.rate_synthesis == 0.5
    assert rates["Agent A", "synthesis"].rate_parametric == 1.0
    assert rates["Agent A", "synthesis"].rate_synthesis is None
    assert rates["Agent A", "all"].n_first == 3


def test_ok_submit_without_validation_is_no_transition(tmp_path: Path) -> None:
    versions = [VERSIONS[0], Version(policy(gain=7.0), (1.0,), None), VERSIONS[1]]
    run = read_run(write_run(tmp_path, versions))
    found = classify(run.submits)
    assert [(t.index, t.edit, t.changed_lines) for t in found] == [
        (0, "first", None),
        (2, "parametric", None),
    ]
    (row, _) = edit_rates([run])
    assert row.n_unscored == 1


def test_unchanged_source_with_an_unknown_digest_counts_as_a_retest(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [VERSIONS[-2], VERSIONS[-1]])
    assert [t.edit for t in classify(read_run(folder).submits)] == ["first", "data"]
    (folder / "checkpoints/submit_001/_meta.json").unlink()
    assert [t.edit for t in classify(read_run(folder).submits)] == ["first", "retest"]


def test_evolution_gives_area_and_episodes_on_the_environments_scale(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS[:2], budget=32, random_mean=0.0, entry="Slow")  # 10 at 8, 20 at 16
    write_run(tmp_path, [Version(policy(), (0.0,) * 16, 40.0)], budget=32, random_mean=0.0, entry="Fast")
    fast, slow = study_of(load_runs([tmp_path]).runs).evolutions
    assert (fast.entry, slow.entry) == ("Fast", "Slow")
    # The scale is 0 … 40. Slow: 0 to 8, 0.25 to 16, 0.5 to 32. Fast: 0 to 16, 1 to 32.
    assert slow.area == pytest.approx((8 * 0.25 + 16 * 0.5) / 32)
    assert fast.area == pytest.approx(0.5)
    assert (slow.to_50, slow.to_80) == (16, None)
    assert (fast.to_50, fast.to_80) == (16, 16)
    assert (slow.n_improvements, fast.n_improvements) == (1, 0)


def test_evolution_without_a_scale_has_no_area(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS[:1], random_mean=50.0)
    (only,) = study_of(load_runs([tmp_path]).runs).evolutions
    assert (only.area, only.to_50) == (None, None)
    assert area((), 10, None) is None
    assert episodes_to((), 0.5, Scale(random=0.0, best=1.0)) is None


def test_curve_is_a_step_function_of_the_consumed_budget() -> None:
    steps = (
        CurvePoint(index=0, consumed=4, val_mean=1.0, best=1.0, improved=True),
        CurvePoint(index=1, consumed=9, val_mean=3.0, best=3.0, improved=True),
    )
    assert [best_at(steps, consumed) for consumed in (4, 8, 9, 99)] == [1.0, 1.0, 3.0, 3.0]
    with pytest.raises(ValueError, match="no score by 3"):
        best_at(steps, 3)


def test_structure_is_averaged_over_runs_then_environments(tmp_path: Path) -> None:
    simple, rich = policy(), policy(integral=True, planner=True)
    write_run(tmp_path, [Version(simple, (1.0,), 1.0)])
    write_run(tmp_path, [Version(rich, (1.0,), 1.0)], repeat=1)
    write_run(tmp_path, [Version(rich, (1.0,), 1.0)], env="gym/ant5")
    write_run(tmp_path, [Version(simple, (1.0,), 1.0)], env="gym/racing")
    runs = load_runs([tmp_path]).runs
    sources = [run.selected.source for run in runs if run.selected is not None]
    assert sorted(source.features.functions for source in sources if source is not None) == [3, 3, 4, 4]
    synthesis, tuning, every = structure_means(runs)
    assert (synthesis.functions, synthesis.loops, synthesis.state) == (3.0, 0.0, 2.0)
    assert tuning.functions == pytest.approx((3.5 + 4.0) / 2)
    assert (tuning.n_environments, tuning.n_runs) == (2, 3)
    assert every.functions == pytest.approx((3.5 + 4.0 + 3.0) / 3)


def test_edit_sizes_are_binned_with_unchanged_bundles_apart(tmp_path: Path) -> None:
    bins = {row.label: row for row in edit_size_bins([read_run(write_run(tmp_path, VERSIONS))])}
    assert (bins["unchanged"].n, bins["data only"].n) == (1, 1)
    assert bins["unchanged"].p_validation == 0.0
    assert bins["unchanged"].visible_improved == 0
    small = bins[
        "1–5"
    ]  # two constants changed, the integral added (three lines), and taken away with a constant
    assert (small.n, small.validation_improved, small.visible_improved) == (4, 2, 2)
    assert bins["6–20"].n == 1
    assert sum(row.n for row in bins.values()) == 7
    assert bins["151+"].p_visible is None


def test_audit_signals_of_a_run_are_as_counted_by_hand(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path, VERSIONS, rejected=3))
    (row,) = next(table for table in tables_of(study_of([run])) if table.name == "audit").rows
    assert (row["accepted"], row["rejected"], row["budget_used"], row["budget"]) == (9, 3, 8 * 8 + 2, 128)
    assert (row["not_ok"], row["score_drops"], row["failed_episodes"]) == (1, 2, 0)
    assert row["invalid_rate"] == pytest.approx(1 / 9)
    assert row["episodes_per_submit"] == pytest.approx(66 / 9)
    assert row["complexity_growth"] > 1.0
    assert (row["selected"], row["turns"], row["retries"]) == ("s008", 9, 0)
    phases = {"agent_s": 60.0 * 9, "queue_s": 1.5 * 9, "rollout_s": 16.0 * 9, "feedback_s": 2.5 * 9}
    assert mean_phases([run]) == {run.entry: {**phases, "finalise_s": 90.0}}
    assert {phase: row[phase] for phase in phases} == phases


def test_tokens_are_in_millions_and_missing_ones_are_none(tmp_path: Path) -> None:
    one = Tokens(
        input_noncached=1_000_000, cache_read=2_000_000, cache_creation=500_000, output=100_000, cost=2.0
    )
    two = Tokens(input_noncached=3_000_000, cache_read=0, cache_creation=500_000, output=300_000)
    write_run(tmp_path, VERSIONS[:1], tokens=one)
    write_run(tmp_path, VERSIONS[:1], tokens=two, repeat=1)
    write_run(tmp_path, VERSIONS[:1], entry="Silent")
    reported, silent = token_use(load_runs([tmp_path]).runs)
    assert (reported.input_noncached, reported.cache, reported.output, reported.cost) == (2.0, 1.5, 0.2, None)
    assert (reported.n_runs, silent.n_runs, silent.output) == (2, 0, None)


def test_cost_is_the_mean_of_runs_that_all_have_a_price(tmp_path: Path) -> None:
    for repeat, cost in enumerate((2.0, 5.0)):
        tokens = Tokens(input_noncached=0, cache_read=0, cache_creation=0, output=1, cost=cost)
        write_run(tmp_path, VERSIONS[:1], tokens=tokens, repeat=repeat)
    (reported,) = token_use(load_runs([tmp_path]).runs)
    assert reported.cost == 3.5


def test_a_count_of_the_agent_that_differs_from_the_relays_is_shown(tmp_path: Path) -> None:
    for repeat, own in enumerate((100, 104, 106, None)):
        tokens = Tokens(input_noncached=60, cache_read=20, cache_creation=10, output=10)
        own_count = own and {"input_noncached": 0, "cache_read": 0, "cache_creation": 0, "output": own}
        limits = {"max_requests": 1, "max_tokens": 1}
        use = {"metering": "relay", "limits": limits, "reported": own_count}
        write_run(tmp_path, VERSIONS[:1], tokens=tokens, repeat=repeat, change={"agent": {"model_use": use}})
    (found,) = token_use(load_runs([tmp_path]).runs)
    assert (found.metering, found.differing) == ("relay", 1)


def test_random_reference_of_one_split_counts_once(tmp_path: Path) -> None:
    write_run(tmp_path, VERSIONS[:1], random_mean=-4.0)
    write_run(tmp_path, VERSIONS[:1], random_mean=-4.0, entry="B")
    table = score_table(load_runs([tmp_path]).runs)
    assert table.reference == RANDOM_ENTRY
    assert table.cells[RANDOM_ENTRY, "gym/acrobot"].scores == (-4.0,)
    assert table.agents == ["Agent A", "B"]


def test_tables_and_curves_use_one_random_reference(tmp_path: Path) -> None:
    steps = [Version(policy(), (0.0,) * 8, 27.5), Version(policy(gain=2.0), (0.0,) * 8, 40.0)]
    for repeat, mean in enumerate((0.0, 10.0, 35.0)):
        write_run(tmp_path, steps, budget=32, random_mean=mean, repeat=repeat)
    found = study_of(load_runs([tmp_path]).runs)
    assert found.suites[0].table.cells[RANDOM_ENTRY, "gym/acrobot"].scores == (15.0,)
    # The scale is 15 … 40: 0.5 from 8 to 16, 1 to 32.
    assert [one.area for one in found.evolutions] == pytest.approx([(8 * 0.5 + 16) / 32] * 3)


def test_equal_references_stay_bit_for_bit_what_they_are(tmp_path: Path) -> None:
    for repeat in range(10):
        write_run(tmp_path, VERSIONS[:1], random_mean=0.1, repeat=repeat)
    assert references(load_runs([tmp_path]).runs) == {"gym/acrobot": 0.1}


@given(st.lists(st.integers(0, 20), min_size=1, max_size=12), st.integers(1, 4))
def test_area_is_between_nought_and_the_final_level(levels: list[int], width: int) -> None:
    best, steps = -1.0, []
    for i, level in enumerate(levels):
        improved = level > best
        best = max(best, float(level))
        steps.append(
            CurvePoint(index=i, consumed=(i + 1) * width, val_mean=float(level), best=best, improved=improved)
        )
    value = area(steps, len(levels) * width, Scale(random=0.0, best=20.0))
    assert 0.0 <= value <= best / 20.0
