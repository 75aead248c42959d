"""Leases: attempts, fencing, heartbeats, expiry, adoption, retries, suspects; and when nothing may expire."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from rigs.core_rig import Rig, done, outcome_of, result

from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import PolicyFailure
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.records import OutcomeRow, SubmitRow
from evopolicy_coordinator.core.leasing.leases import lease_id
from evopolicy_coordinator.core.workers.membership import FORGET_S

GROUP = "r1/s0/train"


def one_job(*workers: str, **settings: Any) -> tuple[Rig, list[str], wire.Lease]:
    """A rig in which the first worker holds the lease of the only job."""
    rig = Rig(**settings)
    sessions = [rig.register(worker) for worker in workers]
    rig.create()
    rig.submit(0)
    (lease,) = rig.poll(sessions[0])
    return rig, sessions, lease


def keep(rig: Rig, seconds: float, *beats: tuple[str, tuple[wire.Lease, ...]]) -> None:
    """Let time pass while these workers beat with these leases."""
    for _ in range(int(seconds / 2.0)):
        for session, leases in beats:
            rig.beat(session, *leases)
        rig.pass_time(2.0)


def test_a_lease_lives_as_long_as_heartbeats_name_it() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    keep(rig, 120.0, (first, (lease,)), (second, ()))
    assert rig.core.state.jobs[f"{GROUP}/0"].lease is not None
    assert rig.poll(second) == []


def test_a_silent_workers_lease_goes_to_another_as_next_attempt() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    rig.beat(first, lease)
    keep(rig, 18.0, (second, ()))
    (again,) = rig.poll(second, wait_s=5.0)
    assert (again.job, again.attempt) == (lease.job, lease.attempt + 1)
    assert rig.core.state.jobs[f"{GROUP}/0"].failures == 1


def test_an_operator_sees_which_worker_was_lost_with_how_many_jobs(rig: Rig) -> None:
    first, second = rig.register("w1", slots=2), rig.register("w2")
    rig.create()
    rig.submit(0, 1, 2)
    held = rig.poll(first, 2)
    keep(rig, 2.0, (first, tuple(held)))
    keep(rig, 18.0, (second, ()))
    (run,) = rig.status().runs
    (retry,) = run.retries
    assert (retry.worker, retry.failure, retry.jobs) == ("w1", "worker_lost", 2)
    assert rig.now - 18.0 <= retry.at <= rig.now


def test_the_queue_is_listed_by_priority_with_what_it_waits_for(rig: Rig) -> None:
    session = rig.begin(worker={"slots": 1})
    rig.create(run="r2", key="r2")
    rig.submit(0, 1, 2)
    (_,) = rig.poll(session, 1)
    rig.submit(0, 1, run="r2")
    rig.beat(session)
    (train,) = rig.status().queue
    assert (train.priority, train.env, train.runs) == ("train", "toy/line", 2)
    assert (train.waiting, train.leased) == (4, 1)
    assert [(n, "slot" in why) for why, n in train.waits_for.items()] == [(1, True)]


def test_a_worker_that_was_frozen_is_told_that_its_lease_is_gone() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    keep(rig, 20.0, (second, ()))
    assert rig.beat(first, lease).cancelled == (lease.lease_id,)


def test_an_expired_attempts_result_counts_while_its_job_is_open() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    keep(rig, 18.0, (second, ()))
    (again,) = rig.poll(second, wait_s=5.0)
    assert isinstance(rig.play(first, lease, value=4.0), wire.ResultsReported)
    assert rig.row(OutcomeRow, GROUP, 0).attempt == lease.attempt
    assert rig.beat(second, again).cancelled == (again.lease_id,)


def test_a_late_limit_verdict_is_not_counted() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    keep(rig, 18.0, (second, ()))
    rig.play(first, lease, failure="act_timeout")
    assert rig.core.state.groups[GROUP].done == 0
    (again,) = rig.poll(second, wait_s=5.0)
    rig.play(second, again)
    assert rig.row(OutcomeRow, GROUP, 0).outcome.failure is None


@pytest.mark.parametrize(("fault", "counts"), [("none", True), ("silence", False), ("blocked loop", False)])
def test_a_limit_verdict_counts_unless_a_fault_may_have_caused_it(fault: str, counts: bool) -> None:
    rig, (first,), lease = one_job("w1")
    rig.pass_time(2.0)
    rig.beat(first, lease)
    if fault == "silence":
        rig.pass_time(rig.settings.silence_s + 1.0)
    elif fault == "blocked loop":
        assert rig.settings.standstill_s + 1.5 < rig.settings.silence_s
        rig.now += rig.settings.standstill_s + 1.5
        rig.pass_time(0.0)
    rig.play(first, lease, failure="act_timeout")
    failures = [row.outcome.failure for row in rig.rows.values() if isinstance(row, OutcomeRow)]
    assert [failure and failure.category for failure in failures] == ["act_timeout"] * counts


def test_a_limit_verdict_after_a_silence_is_played_again() -> None:
    rig, _, lease = one_job("w1")
    rig.load()
    session = rig.register("w1")
    rig.beat(session, lease)
    used = PolicyFailure(category="oom", step_index=3, message="", limit=1.0, used=2.0)
    episode = msgspec.structs.replace(outcome_of(0), failure=used)
    rig.report_results(session, result(lease, "done", episodes=(episode,)))
    assert rig.core.state.groups[GROUP].done == 0
    assert len(rig.poll(session, wait_s=1.0)) == 1


def test_the_same_hand_in_twice_is_committed_once() -> None:
    rig, (first,), lease = one_job("w1")
    rig.play(first, lease, value=4.0)
    assert isinstance(rig.play(first, lease, value=4.0), wire.ResultsReported)
    assert rig.row(SubmitRow, "r1", 0).mean_return == 4.0


def test_a_different_result_of_a_done_episode_is_reported_as_nondeterminism(rig: Rig) -> None:
    first, second = rig.register("w1"), rig.register("w2")
    rig.create()
    rig.submit(0, 1)
    leases = rig.poll(first, 2)
    keep(rig, 18.0, (second, ()))
    again = rig.poll(second, 2)
    rig.play(second, *again, value=2.0)
    assert rig.row(SubmitRow, "r1", 0).status is None  # one of the two backs off
    (late,) = [lease for lease in leases if lease.job.job_id == again[0].job.job_id]
    rig.play(first, late, value=2.0)
    assert rig.core.state.runs["r1"].state.nondeterministic_results == 0
    rig.play(first, late, value=3.0)
    assert rig.core.state.runs["r1"].state.nondeterministic_results == 1


def test_an_attempt_that_another_worker_was_given_is_ignored() -> None:
    rig, (_, second), lease = one_job("w1", "w2")
    rig.play(second, lease)
    assert rig.core.state.groups[GROUP].done == 0
    forged = result(lease, "done", episodes=(outcome_of(0),))
    rig.report_results(second, msgspec.structs.replace(forged, attempt=7, lease_id=f"{GROUP}/0#7"))
    assert rig.core.state.groups[GROUP].done == 0


def test_a_lease_that_never_arrived_is_given_to_another_soon() -> None:
    rig, (first, second), _ = one_job("w1", "w2")
    rig.pass_time(16.0)
    keep(rig, 10.0, (first, ()), (second, ()))
    assert len(rig.poll(second)) == 1


def test_after_the_loop_stood_still_nothing_expires_for_one_time_to_live() -> None:
    rig, (first,), lease = one_job("w1")
    rig.pass_time(1.0)
    rig.now += 60.0
    rig._carry_out(rig.core.handle_deadline(rig.now))
    rig.pass_time(10.0)
    assert rig.core.state.jobs[f"{GROUP}/0"].lease is not None
    assert rig.beat(first, lease).cancelled == ()


def test_a_liveliness_hint_is_no_proof() -> None:
    rig, (first,), lease = one_job("w1")
    rig.pass_time(20.0)  # past the start, when nothing expires
    rig.beat(first, lease)
    rig.tell(events.LivenessLost(worker="w1"))
    rig.pass_time(2.0)
    rig.beat(first, lease)
    rig.pass_time(6.0)
    assert rig.core.state.workers["w1"].state == "active"
    rig.tell(events.LivenessLost(worker="w1"))
    rig.pass_time(6.0)
    assert rig.core.state.workers["w1"].state == "lost"


def test_only_a_lost_workers_played_job_reruns_alone(rig: Rig) -> None:
    first = rig.begin(0, worker={"slots": 1})
    rig.play(first, *rig.poll(first, 1))
    rig.work_off(first)
    rig.core.state.runs["r1"].flow.episode_s = 0.01
    rig.submit(1, 2, 3, key="k1")
    leases = rig.poll(first, 1)
    assert len(leases) == 3  # short episodes come in a batch
    held = tuple(rig.held(each, running=each is leases[0]) for each in leases)
    rig.ask(wire.Heartbeat, worker="w1", session=first, held=held)
    second = rig.register("w2", slots=4)
    keep(rig, 18.0, (second, ()))
    alone = [job.job_id for job in rig.core.state.jobs.values() if job.alone]
    assert alone == [leases[0].job.job_id]
    got = rig.poll(second, 4, wait_s=5.0)
    assert [each.job.job_id for each in got] == alone
    assert rig.poll(second, 4) == []  # nothing beside it
    rig.play(second, *got)
    assert len(rig.poll(second, 4)) == 2


def test_a_busy_worker_is_emptied_for_a_suspect() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    rig.beat(first, lease)
    rig.create("r2")
    rig.submit(0, 1, 2, 3, run="r2", key="x")
    others = rig.poll(second, 2)
    keep(rig, 18.0, (second, tuple(others)))
    assert rig.poll(second, 2) == []  # the rest of r2 waits: the suspect is next
    assert rig.core.state.workers["w2"].reserved is not None
    rig.play(second, others[0])
    assert rig.poll(second, 2) == []
    rig.play(second, others[1])
    assert [each.job.job_id for each in rig.poll(second, 2)] == [lease.job.job_id]


def test_a_worker_emptied_for_a_suspect_claimed_elsewhere_works_again() -> None:
    rig, _, lease = one_job("w1")
    rig.load()
    second, third = rig.register("w2"), rig.register("w3")
    rig.create("r2")
    rig.submit(0, 1, 2, 3, run="r2", key="x")
    others = rig.poll(third, 2)
    rig.pass_time(5.0)
    rig.beat(third, *others)
    (again,) = [each for each in rig.poll(second, 4) if each.job.job_id == lease.job.job_id]
    rig.beat(second, again)
    keep(rig, 18.0, (third, tuple(others)))
    assert rig.poll(third, 2) == []
    assert rig.core.state.workers["w3"].reserved is not None
    rig.beat(rig.register("w1"), lease)  # it had only been frozen
    assert rig.core.state.workers["w3"].reserved is None
    rig.play(third, others[0])
    assert len(rig.poll(third, 1)) == 1


def test_infrastructure_failures_back_off_and_are_counted() -> None:
    rig, (first, second), lease = one_job("w1", "w2")
    rig.report_results(first, result(lease, "failed", error="disk full"))
    rig.pass_time(1.0)
    assert rig.poll(first) == []
    assert len(rig.poll(second)) == 1
    assert rig.core.state.runs["r1"].state.infrastructure_retries == 1
    assert rig.core.state.runs["r1"].ledger.reserved == 1


def test_a_worker_that_keeps_failing_is_benched_and_taken_back() -> None:
    rig, (first,), lease = one_job("w1")
    for _ in range(3):
        rig.report_results(first, result(lease, "failed"))
        rig.pass_time(3.0)
        rig.beat(first)
        got = rig.poll(first)
        if not got:
            break
        (lease,) = got
    assert rig.core.state.workers["w1"].benched_until > rig.now
    (run,) = rig.status().runs
    assert run.waits_for == "workers whose jobs kept failing to be tried again"
    rig.stay(first, 4, 2.0)
    assert len(rig.poll(first, wait_s=3.0)) == 1


def test_a_job_given_back_is_no_failure() -> None:
    rig, (first,), lease = one_job("w1")
    rig.report_results(first, result(lease, "returned"))
    (again,) = rig.poll(first)
    assert again.attempt == 2
    assert rig.core.state.runs["r1"].state.infrastructure_retries == 0


def test_leases_are_adopted_after_a_restart_and_played_once() -> None:
    rig, (first,), lease = one_job("w1")
    rig.load()
    assert rig.beat(first, lease).status == "unknown_worker"
    session = rig.register("w1")
    assert rig.poll(session) == []  # what may be running waits for who claims it
    assert rig.beat(session, lease).cancelled == ()
    rig.pass_time(8.0)
    rig.beat(session, lease)
    assert rig.poll(session) == []
    rig.play(session, lease, value=6.0)
    assert rig.row(SubmitRow, "r1", 0).mean_return == 6.0


def test_what_nobody_claims_after_a_restart_is_leased_under_a_higher_attempt() -> None:
    rig, _, lease = one_job("w1")
    rig.load()
    session = rig.register("w2")
    rig.pass_time(5.0)
    (again,) = rig.poll(session)
    assert again.attempt == 1_000_001 > lease.attempt
    assert again.job == lease.job


def test_a_result_that_outlives_the_coordinator_is_taken() -> None:
    rig, _, lease = one_job("w1")
    rig.load()
    session = rig.register("w1")
    rig.play(session, lease, value=6.0)
    assert rig.row(OutcomeRow, GROUP, 0).outcome.episode_return == 6.0


def test_what_was_never_granted_is_neither_taken_nor_adopted_after_a_restart() -> None:
    """Attack: after a restart of the coordinator, reports or claims an attempt that it never got. Defence:
    a lease's name is a keyed hash of job, attempt and worker."""
    rig, _, lease = one_job("w1")
    rig.load()
    thief = rig.register("w2")
    made_up = [
        msgspec.structs.replace(lease, attempt=attempt, lease_id=name)
        for attempt in (1, 2, 999_999, 1_000_000)
        for name in (
            lease.lease_id,
            f"{lease.job.job_id}#{attempt}",
            f"{lease.job.job_id}#{attempt}#{lease.lease_id.rpartition('#')[2]}",
            lease_id(b"another secret", lease.job.job_id, attempt, "w2"),
        )
    ]
    for forged in made_up:
        rig.report_results(thief, done(forged, value=99.0))
        assert rig.beat(thief, forged).cancelled == (forged.lease_id,)
    assert (OutcomeRow, GROUP, 0) not in rig.rows
    session = rig.register("w1")
    assert rig.beat(session, lease).cancelled == ()
    rig.play(session, lease, value=6.0)
    assert rig.row(OutcomeRow, GROUP, 0).outcome.episode_return == 6.0


def test_an_ungranted_leases_result_accuses_no_run_of_nondeterminism() -> None:
    rig, (first,), lease = one_job("w1")
    other = rig.register("w2")
    rig.play(first, lease, value=6.0)
    rig.report_results(other, done(lease, value=7.0))
    assert rig.core.state.runs["r1"].state.nondeterministic_results == 0


def test_a_result_for_another_job_gives_the_leased_job_back() -> None:
    rig, (first,), lease = one_job("w1")
    wrong = msgspec.structs.replace(result(lease, "done"), job_id=f"{GROUP}/7")
    rig.report_results(first, wrong)
    rig.pass_time(10.0)
    (again,) = rig.poll(first)
    assert again.job == lease.job


def test_a_reregistered_worker_keeps_only_its_claimed_leases(rig: Rig) -> None:
    first = rig.begin(0, 1)
    lease, other = rig.poll(first, 2)
    keep(rig, 16.0, (first, (lease, other)))
    again = rig.register("w1")
    for _ in range(3):
        rig.beat(again, lease)
        rig.pass_time(2.0)
    assert rig.core.state.jobs[lease.job.job_id].lease is not None
    assert rig.core.state.jobs[other.job.job_id].lease is None
    assert rig.report_results(first, done(lease)).status == "unknown_worker"


def test_a_delayed_heartbeat_is_answered_when_a_lease_must_stop() -> None:
    rig, (first,), lease = one_job("w1")
    assert rig.beat(first, lease, wait_s=5.0) is None
    request = rig._requests
    rig.ask(operator.CancelRun, run="r1")
    assert rig.replies[request].cancelled == (lease.lease_id,)


def test_a_job_that_is_played_for_ever_is_taken_away() -> None:
    rig, (first, second), lease = one_job("w1", "w2", job_deadline_s=100.0)
    keep(rig, 900.0, (first, (lease,)), (second, ()))
    assert lease.lease_id in rig.beat(first, lease).cancelled
    assert len(rig.poll(second)) == 1


def test_a_lost_worker_is_forgotten_in_the_end(rig: Rig) -> None:
    rig.register()
    rig.pass_time(rig.settings.lease_ttl_s + 1.0)
    assert [worker.state for worker in rig.status().workers] == ["lost"]
    rig.pass_time(FORGET_S)
    assert rig.status().workers == ()


def test_no_poll_waits_longer_than_the_longest_wait() -> None:
    rig = Rig(max_wait_s=5.0)
    session = rig.begin()
    assert rig.poll(session, 1, wait_s=1000.0) is None
    lease = rig._requests
    assert rig.ask(operator.WaitRun, run="r1", wait_s=1000.0) is None
    assert rig.beat(session, wait_s=1000.0) is None
    rig.pass_time(5.0)
    assert {lease, lease + 1, lease + 2} <= rig.replies.keys()


def test_an_operators_environment_is_described_by_its_workers(rig: Rig) -> None:
    one, other = rig.register("w1", envs=(), undescribed=("my/a", "my/b")), rig.register("w2")
    for env in ("my/a", "my/none"):
        rig.core.handle(events.DescriptionAwaited(env=env), rig.now)
    assert list(rig.core.state.awaited) == ["my/a"]
    assert rig.beat(one).describe == ("my/a",)
    assert rig.beat(other).describe == ()
    again = rig.register("w1", envs=("my/a",), undescribed=("my/b",))
    assert not rig.core.state.awaited
    assert rig.beat(again).describe == ()


def test_a_worker_that_comes_with_another_profile_each_time_leaves_none_behind(rig: Rig) -> None:
    rig.create()
    for k in range(5):
        rig.register("w1", version=f"{k}")
        rig.register("w2", version="0")
    (lane,) = rig.core.state.lanes.values()
    assert len(rig.core.state.profiles) == 2
    assert len(lane.profiles) == 1  # its run is pinned to version 0
    rig.pass_time(10 * rig.settings.lease_ttl_s)
    rig.pass_time(FORGET_S)
    assert rig.core.state.workers == rig.core.state.profiles == lane.profiles == {}
    assert rig.register("w1", version="0")
    assert len(lane.profiles) == 1
