"""Submits: what is refused, what is charged, the gate at index 0, verdicts, long polls, idempotency."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from rigs.core_rig import BUNDLE, Rig, done, outcome_of, result, split_of
from rigs.store_rows import blob

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages.episode import PolicyFailure, ResourceLimits
from evopolicy_common.messages.worker import Refused
from evopolicy_coordinator.core.contract.effects import ReadResults
from evopolicy_coordinator.core.contract.records import OutcomeRow, SubmitRow, submit_done


def started(*ids: int, **settings: Any) -> tuple[Rig, str]:
    rig = Rig()
    return rig, rig.begin(*ids, worker={"slots": 8}, run=settings)


@pytest.mark.parametrize(
    ("ids", "status"),
    [
        ((), "budget_invalid"),
        ((64,), "invalid_env_instance"),
        ((-1,), "invalid_env_instance"),
        ((0,) * 17, "budget_invalid"),
    ],
)
def test_rejected_request_costs_no_budget(ids: tuple[int, ...], status: str) -> None:
    rig, _ = started()
    answer = rig.submit(*ids)
    assert isinstance(answer, Refused)
    assert answer.status == status
    state = rig.ask(gateway.StateRequest, run="r1")
    assert (state.remaining_budget, state.n_submits) == (16, 0)
    assert not [row for row in rig.rows.values() if isinstance(row, SubmitRow)]


def test_one_key_is_one_submit_and_another_request_a_conflict() -> None:
    rig, session = started()
    first = rig.submit(0, 1)
    assert rig.submit(0, 1) == first
    rig.work_off(session)
    rig.load()
    assert rig.submit(0, 1) == first
    assert rig.submit(0, 2).status == "key_conflict"
    assert rig.submit(0, 1, bundle="b" * 64).status == "key_conflict"


def test_a_second_submit_while_one_runs_is_refused_and_names_the_first() -> None:
    rig, _ = started(0)
    answer = rig.submit(1, key="k1")
    assert (answer.status, "submit 0" in answer.message) == ("busy", True)


def test_a_run_without_a_worker_waits_to_be_opened(rig: Rig) -> None:
    rig.create()
    assert rig.ask(gateway.OpenRun, run="r1").status == "no_worker"
    rig.register()
    assert isinstance(rig.ask(gateway.OpenRun, run="r1"), gateway.RunOpened)


def test_nothing_is_released_before_the_episode_at_index_0_shows_a_policy() -> None:
    rig, session = started(0, 1, 2)
    leases = {lease.job.episodes[0].index: lease for lease in rig.poll(session, 8)}
    rig.play(session, leases[1])
    assert rig.results().upto == 0
    assert rig.ask(gateway.ResultsRequest, run="r1", submit_index=0, cursor=0, wait_s=9.0) is None
    poll = rig._requests
    rig.play(session, leases[0])
    assert rig.replies[poll].upto == 2


def test_one_page_has_all_results_of_a_report() -> None:
    rig, session = started(0, 1, 2, 3)
    leases = rig.poll(session, 8)
    rig.ask(gateway.ResultsRequest, run="r1", submit_index=0, cursor=0, wait_s=9.0)
    poll = rig._requests
    rig.play(session, *leases[:3])
    assert rig.replies[poll].upto == 3


def test_a_bundle_without_a_policy_is_charged_in_full() -> None:
    rig, session = started(0, 1, 2)
    leases = {lease.job.episodes[0].index: lease for lease in rig.poll(session, 8)}
    rig.play(session, leases[1], failure="import_error")
    assert rig.row(SubmitRow, "r1", 0).status is None
    rig.play(session, leases[0], failure="import_error")
    row = rig.row(SubmitRow, "r1", 0)
    assert (row.status, row.released, row.n_kept, row.mean_return) == ("import_error", 0, 0, None)
    assert row.failure is not None
    assert rig.core.state.runs["r1"].ledger.settled == 3
    reply = rig.beat(session, leases[2])
    assert reply.cancelled == (leases[2].lease_id,)


def test_a_later_episode_without_a_policy_is_only_that_episodes_failure() -> None:
    rig, session = started(0, 1)
    for lease in rig.poll(session, 8):
        rig.play(session, lease, failure="init_error" if lease.job.episodes[0].index else None)
    assert rig.row(SubmitRow, "r1", 0).status == "ok"


def test_a_snapshot_that_could_not_be_made_is_a_verdict_and_charged() -> None:
    rig, _ = started()
    failure = PolicyFailure(category="missing_policy", step_index=None, message="no policy.py")
    answer = rig.submit(0, 1, bundle=None, bundle_error=failure)
    assert answer.remaining_budget == 14
    row, settled = rig.row(SubmitRow, "r1", 0), rig.core.state.runs["r1"].ledger.settled
    assert (row.status, row.failure, settled) == ("missing_policy", failure, 2)
    assert rig.results().upto == 0
    assert isinstance(rig.submit(0, key="k1"), gateway.SubmitAccepted)


def test_a_submit_limit_keeps_episodes_before_the_first_unfinished() -> None:
    rig, session = started(limits=ResourceLimits(submit_wall_s=30.0))
    rig.pass_time(20.0)
    rig.beat(session)
    rig.submit(0, 1, 2, 3)
    leases = {lease.job.episodes[0].index: lease for lease in rig.poll(session, 8)}
    rig.play(session, leases[0], leases[1], leases[3])
    rig.stay(session, 10, 4.0, leases[2])
    row = rig.row(SubmitRow, "r1", 0)
    assert (row.status, row.n_kept, row.released) == ("rollout_timeout", 2, 3)


def test_a_fault_of_ours_costs_neither_limit_nor_budget() -> None:
    rig, session = started(0, limits=ResourceLimits(submit_wall_s=30.0))
    for _ in range(4):
        (lease,) = rig.poll(session, 8, wait_s=1.0)
        rig.report_results(session, result(lease, "failed", error="environment my/env, step 3: it hangs"))
        rig.stay(session, 10, 3.0)
        assert rig.row(SubmitRow, "r1", 0).status is None
    ledger = rig.core.state.runs["r1"].ledger
    assert (ledger.reserved, ledger.settled) == (1, 0)
    assert "my/env, step 3" in next(iter(rig.core.state.groups["r1/s0/train"].jobs.values())).last_failure
    # Without further faults the limit counts.
    (lease,) = rig.poll(session, 8, wait_s=1.0)
    rig.stay(session, 30, 3.0, lease)
    assert rig.row(SubmitRow, "r1", 0).status == "rollout_timeout"


def test_a_fault_counts_after_an_episode_with_more_is_done() -> None:
    rig, session = started(0, 1, limits=ResourceLimits(submit_wall_s=30.0))
    leases = {lease.job.episodes[0].index: lease for lease in rig.poll(session, 8)}
    rig.report_results(session, result(leases[0], "failed", error="environment my/env: it hangs"))
    rig.stay(session, 12, 3.0, leases[1])  # the limit begins again
    (again,) = rig.poll(session, 8, wait_s=1.0)
    rig.play(session, again)
    rig.report_results(session, result(leases[1], "failed", error="environment my/env: it hangs"))
    rig.stay(session, 12, 3.0)
    assert rig.row(SubmitRow, "r1", 0).status is None


def test_scope_submit_plays_hidden_cases_in_equal_chunks() -> None:
    rig, session = started(4, 4, 9, policy_scope="submit", n_valid=5)
    (lease,) = rig.poll(session, 8)
    assert [spec.case.seed for spec in lease.job.episodes] == [4, 4, 9]
    assert len({spec.policy_seed for spec in lease.job.episodes}) == 3
    rig.report_results(session, done(lease))
    rig.close()
    hidden = [each for each in rig.poll(session, 8) if split_of(each.job) == "validation"]
    assert [[spec.episode_index for spec in each.job.episodes] for each in hidden] == [[0, 1, 2], [0, 1]]
    assert {each.job.record for each in hidden} == {"actions"}
    assert all(each.job.env_meta == lease.job.env_meta for each in hidden)


def test_outcomes_that_do_not_fit_the_job_are_the_workers_failure() -> None:
    rig, session = started(0)
    endless = PolicyFailure(category="act_error", step_index=0, message="", used=float("inf"))
    wordy = PolicyFailure(category="act_error", step_index=0, message="", traceback="x" * (3 << 20))
    bad = [
        (outcome_of(1),),
        (),
        (outcome_of(0, float("nan")),),
        (outcome_of(0, 1.7e308),),  # the sum of two is not finite
        (outcome_of(0), outcome_of(0)),
        (msgspec.structs.replace(outcome_of(0), policy_cpu_s=float("inf")),),
        (msgspec.structs.replace(outcome_of(0), failure=endless),),
        (msgspec.structs.replace(outcome_of(0), length=2**40),),
        (msgspec.structs.replace(outcome_of(0), wall_s=-1.0),),
        # A page with them could not be sent to the gateway, which would ask for it for ever.
        (msgspec.structs.replace(outcome_of(0), stdout=bytes(9 << 20), stderr=bytes(9 << 20)),),
        (msgspec.structs.replace(outcome_of(0), trajectory=blob(bytes(3 << 20))),),
        (msgspec.structs.replace(outcome_of(0), failure=wordy),),
        (msgspec.structs.replace(outcome_of(0), reward_components={f"{k:1024}": 0.0 for k in range(3000)}),),
    ]
    for episodes in bad:
        rig.stay(session, 8, 10.0)
        (lease,) = rig.poll(session, 1, wait_s=0.5)
        rig.report_results(session, result(lease, "done", episodes=episodes))
        assert rig.core.state.groups["r1/s0/train"].done == 0
    assert rig.core.state.runs["r1"].state.infrastructure_retries == len(bad)


def test_stored_returns_with_an_infinite_sum_have_a_mean() -> None:
    rig, session = started(0, 1, 2)
    for lease in rig.poll(session, 2):
        rig.report_results(session, done(lease))
    for index in range(2):
        row = rig.row(OutcomeRow, "r1/s0/train", index)
        large = msgspec.structs.replace(row.outcome, episode_return=1.7e308)
        rig.rows[OutcomeRow, "r1/s0/train", index] = msgspec.structs.replace(row, outcome=large)
    session = rig.restarted(slots=2)
    (last,) = rig.poll(session, 2)
    rig.report_results(session, done(last))
    assert rig.row(SubmitRow, "r1", 0).mean_return == pytest.approx(2 / 3 * 1.7e308)


def test_a_cancelled_run_refunds_its_open_submit_and_answers_who_waits() -> None:
    rig, session = started(0, 1)
    (first, _) = rig.poll(session, 2)
    assert rig.ask(gateway.ResultsRequest, run="r1", submit_index=0, cursor=0, wait_s=9.0) is None
    poll = rig._requests
    rig.ask(operator.CancelRun, run="r1")
    assert isinstance(rig.replies[poll], ReadResults)
    assert (rig.finished().status, rig.finished().budget_used) == ("cancelled", 0)
    row = rig.row(SubmitRow, "r1", 0)
    assert (row.status, row.refunded) == ("cancelled", True)
    done = submit_done(row)
    assert (done.n_episodes, done.remaining_budget) == (0, 16)
    assert rig.beat(session, first).cancelled == (first.lease_id,)
    assert rig.submit(0, bundle=BUNDLE, key="k9").status == "run_cancelled"
    state = rig.ask(gateway.StateRequest, run="r1")
    assert (state.is_finalized, state.cancelled, state.remaining_budget) == (True, True, 16)
