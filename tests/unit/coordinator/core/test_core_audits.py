"""Audits: who is drawn, who plays it again, and what a run says of it."""

from __future__ import annotations

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs.audit_fleet import WAIT_S, Fleet, audit_state
from rigs.core_rig import BUNDLE, outcome_of, result

from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.leasing.leases import lease_id
from evopolicy_coordinator.core.runs import audits

# ---- who plays what again ----


def test_nobody_audits_himself_and_every_list_of_a_run_is_audited() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    found = audit_state(fleet.whole_run(0, 1, 2, 3))
    assert found.agreed == found.sampled == 4 + 2 + 2 + 2
    assert not found.in_question
    assert all(auditor != player for auditor, player in fleet.audits)


def test_an_auditor_gets_the_recorded_actions_and_no_policy() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0)
    while fleet.turn("w1"):
        pass
    leases = fleet.rig.poll(fleet.sessions["w2"], 4)
    (job,) = [lease.job for lease in leases if "train/audit" in lease.job.job_id]
    assert job.bundle is None
    assert (job.record, job.render) == ("full", False)  # compared number by number, and no agent reads it
    assert job.episodes[0].replay is not None
    assert job.episodes[0].case.seed == 0


def test_a_lone_worker_is_not_waited_for() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    fleet.work_off()
    fleet.rig.close()
    fleet.rig.pass_time(20.0)
    fleet.work_off()
    found = audit_state(fleet.rig.finished())
    assert found.not_audited == {audits.ONE_WORKER: found.sampled}
    assert not found.in_question


def test_a_run_waits_for_a_busy_second_worker_up_to_its_bound() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0, 1)
    rig = fleet.rig
    while fleet.turn("w1"):
        pass
    rig.close()
    while fleet.turn("w1"):
        pass

    def beat_for(seconds: float) -> None:
        for _ in range(int(seconds)):
            rig.pass_time(1.0)
            rig.beat(fleet.sessions["w2"])

    waits = rig.ask(operator.WaitRun, run="r1", wait_s=0.0)
    assert "audits" in waits.waits_for
    beat_for(WAIT_S - 10.0)
    assert "r1" in rig.core.state.runs
    beat_for(20.0)
    assert audit_state(rig.finished()).not_audited == {audits.TOO_LATE: 2 + 2 + 2 + 2}


def test_a_lone_worker_after_a_restart_is_given_time_to_find_company() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    fleet.work_off()
    fleet.rig.close()
    fleet.work_off()
    fleet.rig.load()
    fleet.join("w1")
    assert "r1" in fleet.rig.core.state.runs
    fleet.join("w2")
    fleet.rig.pass_time(5.0)
    fleet.work_off()
    fleet.rig.pass_time(20.0)
    assert audit_state(fleet.rig.finished()).not_audited == {}


@pytest.mark.parametrize("other", ["versions", "processor"])
def test_workers_that_may_honestly_come_to_other_bits_do_not_audit(other: str) -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    if other == "processor":
        fleet.join("w2", cpu="y")
    else:
        fleet.sessions["w2"] = fleet.rig.register("w2", version="2")
        fleet.adds["w2"] = 0.0
    fleet.work_off()
    fleet.rig.close()
    fleet.work_off()
    fleet.rig.pass_time(30.0)
    assert list(audit_state(fleet.rig.finished()).not_audited) == [audits.OTHERS_DIFFER]


def test_an_environment_that_does_not_repeat_itself_is_not_audited() -> None:
    fleet = Fleet()
    fleet.join("w1", deterministic=False)
    fleet.join("w2", deterministic=False)
    found = audit_state(fleet.whole_run(0, 1))
    assert found.not_audited == {audits.NOT_REPEATABLE: found.sampled}
    assert fleet.audits == []


def test_a_cancelled_run_plays_no_more_audits() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0, 1)
    fleet.turn("w1")
    fleet.rig.ask(operator.CancelRun, run="r1")
    assert audit_state(fleet.rig.finished()).not_audited == {audits.CANCELLED: 2}
    assert not fleet.rig.core.state.groups


# ---- never in the way ----


def test_train_jobs_go_before_audits_and_stop_them() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    fleet.turn("w1")
    fleet.join("w2", slots=2)
    taken = fleet.rig.poll(fleet.sessions["w2"], 1)
    while taken and "audit" not in taken[0].job.job_id:
        fleet.report_results("w2", *taken)
        taken = fleet.rig.poll(fleet.sessions["w2"], 1)
    assert taken, "an audit is what there is to do"
    (more,) = fleet.rig.poll(fleet.sessions["w2"], 1)
    assert "audit" in more.job.job_id
    fleet.rig.submit(2, 3, key="second")
    reply = fleet.rig.beat(fleet.sessions["w2"], *taken, more)
    assert set(reply.cancelled) == {taken[0].lease_id, more.lease_id}
    for lease in (*taken, more):
        fleet.rig.report_results(fleet.sessions["w2"], result(lease, "returned"))
    got = fleet.rig.poll(fleet.sessions["w2"], 2)
    assert ["train" in lease.job.job_id and "audit" not in lease.job.job_id for lease in got] == [True, True]


# ---- restarts ----


def test_a_restart_at_any_point_changes_nothing_of_the_audits() -> None:
    for stop_after in range(12):
        fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
        fleet.train(0, 1, 2, 3)
        for _ in range(stop_after):
            fleet.turn()
        fleet.rig.audits = []
        fleet.rig.load()
        fleet.sessions.clear()
        for name in ("w1", "w2", "w3"):
            if name not in fleet.rig.core.state.quarantined:
                fleet.join(name)
        fleet.rig.pass_time(5.0)
        fleet.work_off()
        fleet.rig.close()
        fleet.work_off()
        fleet.rig.pass_time(WAIT_S)
        found = audit_state(fleet.rig.finished())
        assert list(found.forgers) == ["w2"], stop_after
        assert found.audited + sum(found.not_audited.values()) == found.sampled == 4 + 2 + 2 + 2


def test_no_restart_lets_a_player_audit_its_own_episode() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0)
    fleet.turn("w1")
    (job,) = [job for job in fleet.rig.core.state.jobs.values() if job.group.kind == "audit"]
    fleet.rig.load()
    fleet.join("w1")
    name = lease_id(job.group.flow.secret, job.job_id, 1, "w1")
    claimed = wire.HeldLease(lease_id=name, job_id=job.job_id, attempt=1, running=True)
    reply = fleet.rig.ask(
        wire.Heartbeat, worker="w1", session=fleet.sessions["w1"], held=(claimed,), wait_s=0.0
    )
    assert reply.cancelled == (claimed.lease_id,)
    forged = wire.JobResult(
        lease_id=claimed.lease_id, job_id=job.job_id, attempt=1, kind="done", episodes=(outcome_of(0),)
    )
    fleet.rig.report_results(fleet.sessions["w1"], forged)
    assert job.job_id in fleet.rig.core.state.jobs, "it is still to be played"


# ---- the draw ----


@given(st.integers(0, 10**6), st.floats(0, 1), st.floats(0, 1))
def test_what_is_drawn_by_a_share_is_drawn_by_a_larger_one(index: int, one: float, other: float) -> None:
    small, large = sorted((one, other))
    if audits.drawn(b"s" * 32, "r/s0/train", index, small):
        assert audits.drawn(b"s" * 32, "r/s0/train", index, large)
    assert audits.drawn(b"s" * 32, "r/s0/train", index, 1.0)
    assert not audits.drawn(b"s" * 32, "r/s0/train", index, 0.0)


def test_a_share_is_about_that_share_and_another_in_another_run() -> None:
    def draw(secret: bytes) -> list[bool]:
        return [audits.drawn(secret, "r/s0/train", index, 0.05) for index in range(20_000)]

    one, other = (draw(hashlib.sha256(text).digest()) for text in (b"one", b"other"))
    assert 800 < sum(one) < 1200
    assert one != other


def test_the_bundle_is_not_needed_for_an_audit() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0)
    fleet.turn("w1")
    (job,) = [job for job in fleet.rig.core.state.jobs.values() if job.group.kind == "audit"]
    assert job.names_blob("0.0")
    assert not job.names_blob(BUNDLE)
