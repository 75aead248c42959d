"""Actions that a stopped hidden job's policy had returned stand: the next attempt continues from there."""

from __future__ import annotations

import pytest
from rigs.core_rig import Rig, done, result, split_of

from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import BlobRef
from evopolicy_coordinator.core.contract.records import BegunRow

HERE = "kernel-of-w1"
BEGUN = BlobRef(digest="b" * 64, size=5000)
LONGER = BlobRef(digest="c" * 64, size=6000)


def playing(rig: Rig, *, n_valid: int = 1) -> tuple[str, wire.Lease]:
    """A worker that plays hidden validation of an open run, whose agent is on another kernel."""
    session = rig.begin(0, run={"n_valid": n_valid})
    rig.play(session, *rig.poll(session))
    (lease,) = rig.poll(session, n=1)
    assert split_of(lease.job) == "validation"
    assert lease.job.begun is None
    return session, lease


def given_back(rig: Rig, session: str, lease: wire.Lease, begun: BlobRef | None, **more: bool) -> None:
    rig.report_results(session, result(lease, "returned", begun=begun, **more))


def the_hidden_one(rig: Rig, session: str) -> wire.Lease:
    """The next lease on it, once the train jobs are done."""
    for _ in range(4):
        for lease in rig.poll(session, n=2):
            if split_of(lease.job) == "validation":
                return lease
            rig.play(session, lease)
    raise AssertionError("it is not leased")


@pytest.mark.parametrize("restart", [False, True])
def test_a_stopped_job_continues_from_its_policys_actions(rig: Rig, restart: bool) -> None:
    session = rig.begin(0, worker={"slots": 1}, run={"n_valid": 1})
    rig.play(session, *rig.poll(session))
    (lease,) = rig.poll(session, n=1)
    for number, begun in enumerate((BEGUN, LONGER)):
        rig.submit(0, key=f"again-{number}")
        assert rig.beat(session, lease).cancelled == (lease.lease_id,)
        given_back(rig, session, lease, begun)
        if restart:
            rig.load()
            session = rig.register(slots=1)
            rig.pass_time(rig.settings.adoption_s)
        lease = the_hidden_one(rig, session)
        assert lease.job.begun == begun
        assert rig.core.state.jobs[lease.job.job_id].names_blob(begun.digest)
    rig.report_results(session, done(lease))
    assert rig.row(BegunRow, "r1/s0/validation", 0).begun is None


def test_a_job_stopped_by_a_permit_waits_for_its_worker(rig: Rig) -> None:
    session, lease = playing(rig)
    other = rig.register("w2")
    rig.create("r2", agent=None)
    assert rig.permit("r2", HERE, wait_s=20.0) is None
    # It is not to be thrown again elsewhere meanwhile.
    assert rig.poll(other) == []
    rig.beat(session, lease)
    assert rig.poll(other) == []
    assert "return the jobs" in rig.status().runs[0].waits_for
    given_back(rig, session, lease, BEGUN)
    assert [each.job.begun for each in rig.poll(other)] == [BEGUN]


def test_a_worker_that_no_longer_names_a_job_holds_nothing(rig: Rig) -> None:
    session, lease = playing(rig)
    other = rig.register("w2")
    rig.create("r2", agent=None)
    rig.permit("r2", HERE, wait_s=20.0)
    rig.beat(session)
    (again,) = rig.poll(other)
    assert (again.job.job_id, again.job.begun) == (lease.job.job_id, None)
    # Too late: it is played already.
    given_back(rig, session, lease, BEGUN)
    assert rig.core.state.jobs[lease.job.job_id].begun is None


def test_a_silent_or_clinging_worker_delays_a_job_only_briefly() -> None:
    for beats in (False, True):
        rig = Rig(job_deadline_s=30.0)
        session, lease = playing(rig)
        other = rig.register("w2")
        rig.create("r2", agent=None)
        rig.permit("r2", HERE, wait_s=20.0)
        waited_s = 0.0
        while not (again := rig.poll(other)):
            if beats:
                rig.beat(session, lease)
            rig.beat(other)
            rig.pass_time(2.0)
            waited_s += 2.0
            assert waited_s < 2000.0
        assert again[0].job.job_id == lease.job.job_id
        assert (waited_s > 100.0) == beats


def test_an_earlier_attempt_does_not_replace_what_a_later_one_handed_back(rig: Rig) -> None:
    session, lease = playing(rig)
    rig.create("r2", agent=None)
    rig.permit("r2", HERE, wait_s=20.0)
    given_back(rig, session, lease, BEGUN)
    given_back(rig, session, lease, LONGER)
    assert rig.core.state.jobs[lease.job.job_id].begun == BEGUN


def test_another_worker_cannot_hand_back_what_it_was_not_given(rig: Rig) -> None:
    _, lease = playing(rig)
    other = rig.register("w2")
    given_back(rig, other, lease, BEGUN)
    assert rig.core.state.jobs[lease.job.job_id].begun is None


@pytest.mark.parametrize("limit", [False, True])
def test_a_long_silent_workers_limit_verdict_is_not_believed(rig: Rig, limit: bool) -> None:
    session, lease = playing(rig)
    rig.pass_time(rig.settings.silence_s + 1.0)
    given_back(rig, session, lease, BEGUN, limit_verdict=limit)
    assert (rig.core.state.jobs[lease.job.job_id].begun is None) == limit


def test_what_a_worker_in_trouble_can_still_tell_stands_too(rig: Rig) -> None:
    session, lease = playing(rig)
    rig.report_results(session, result(lease, "failed", begun=BEGUN))
    rig.pass_time(10.0)
    assert [each.job.begun for each in rig.poll(session)] == [BEGUN]


def test_a_job_that_was_done_when_it_was_stopped_is_done(rig: Rig) -> None:
    session, lease = playing(rig)
    rig.create("r2", agent=None)
    rig.permit("r2", HERE, wait_s=20.0)
    rig.report_results(session, done(lease, failure="act_timeout"))
    assert lease.job.job_id not in rig.core.state.jobs


def test_random_actions_are_not_waited_for() -> None:
    rig = Rig(hidden_isolation="off")
    session = rig.begin(0, worker={"slots": 4}, run={"n_valid": 1})
    rig.play(session, *rig.poll(session))
    rig.create("r2", agent=None)
    rig.close("r1")
    random = next(lease for lease in rig.poll(session, n=4) if lease.job.bundle is None)
    rig.submit(*range(4), run="r2")
    assert rig.core.state.jobs[random.job.job_id].queued
