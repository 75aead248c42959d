"""Actions that a stopped hidden job's policy had returned stand: the next attempt continues from there."""

from __future__ import annotations

import pytest
from rigs.core_rig import Rig, done, result, split_of

from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import BlobRef
from evopolicy_coordinator.core.contract.records import BegunRow

BEGUN = BlobRef(digest="b" * 64, size=5000)
LONGER = BlobRef(digest="c" * 64, size=6000)


def playing(rig: Rig) -> tuple[str, wire.Lease]:
    """A worker that plays hidden validation of a closed run."""
    session = rig.begin(0, run={"n_valid": 1})
    rig.play(session, *rig.poll(session))
    rig.close("r1")
    lease = the_hidden_one(rig, session)
    assert split_of(lease.job) == "validation"
    assert lease.job.begun is None
    return session, lease


def given_back(rig: Rig, session: str, lease: wire.Lease, begun: BlobRef | None, **more: bool) -> None:
    rig.report_results(session, result(lease, "returned", begun=begun, **more))


def the_hidden_one(rig: Rig, session: str) -> wire.Lease:
    """The next lease on it, once the random reference is played."""
    for _ in range(4):
        for lease in rig.poll(session, n=2):
            if split_of(lease.job) == "validation":
                return lease
            rig.play(session, lease)
    raise AssertionError("it is not leased")


@pytest.mark.parametrize("restart", [False, True])
def test_a_stopped_job_continues_from_its_policys_actions(rig: Rig, restart: bool) -> None:
    session, lease = playing(rig)
    for begun in (BEGUN, LONGER):
        given_back(rig, session, lease, begun)
        if restart:
            session = rig.restarted(slots=2)
        lease = the_hidden_one(rig, session)
        assert lease.job.begun == begun
        assert rig.core.state.jobs[lease.job.job_id].names_blob(begun.digest)
    rig.report_results(session, done(lease))
    assert rig.row(BegunRow, "r1/s0/validation", 0).begun is None


def test_an_earlier_attempt_does_not_replace_what_a_later_one_handed_back(rig: Rig) -> None:
    session, lease = playing(rig)
    given_back(rig, session, lease, BEGUN)
    again = the_hidden_one(rig, session)
    given_back(rig, session, lease, LONGER)
    assert again.job.begun == BEGUN
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
    assert the_hidden_one(rig, session).job.begun == BEGUN
