"""Audits: who is drawn, who plays it again, who is named, and what a run says of it."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec
import pytest
from core_rig import BUNDLE, ENV, Rig, describe, fingerprint, outcome_of, result
from hypothesis import given, settings
from hypothesis import strategies as st

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import BlobRef
from evopolicy_coordinator.core import audit, events
from evopolicy_coordinator.core.effects import PrepareAudit
from evopolicy_coordinator.core.records import OutcomeRow, WorkerRow

WAIT_S = 100.0


class Fleet:
    """Workers on a rig, each with what it adds to every return that it hands in, and the shell's side of audits."""

    def __init__(self, share: float = 1.0, **adds: float) -> None:
        self.rig = Rig(audit_share=share, audit_wait_s=WAIT_S)
        self.adds = adds
        self.sessions: dict[str, str] = {}
        self.played: list[tuple[str, str]] = []
        """Worker and job, in order."""
        for name in adds:
            self.join(name)

    def join(
        self,
        name: str,
        *,
        cpu: str = "x",
        deterministic: bool = True,
        slots: int = 2,
        machine: str = "",
    ) -> None:
        self.adds.setdefault(name, 0.0)
        session = f"{name}-s{self.rig.request()}"
        reply = self.rig.tell(
            events.WorkerRegistered(
                request=self.rig.request(),
                worker=name,
                session=session,
                slots=slots,
                tiers=("bwrap",),
                environments=(msgspec.structs.replace(describe(ENV), deterministic=deterministic),),
                fingerprint=msgspec.structs.replace(fingerprint(), cpu=cpu),
                machine=machine,
            )
        )
        if not isinstance(reply, wire.Registered):
            raise RefusedError(reply.status, reply.message)
        self.sessions[name] = session

    def hand_in(self, name: str, lease: wire.Lease) -> Any:
        return self.rig.hand_in(self.sessions[name], self.done(name, lease))

    def done(self, name: str, lease: wire.Lease) -> wire.JobResult:
        self.played.append((name, lease.job.job_id))
        episodes = []
        for spec in lease.job.episodes:
            truth = float(spec.replay.digest) if spec.replay is not None else spec.case.seed * 0.5
            outcome = outcome_of(spec.index, truth + self.adds[name])
            recording = BlobRef(digest=f"{spec.index}" * 64, size=9)
            episodes.append(msgspec.structs.replace(outcome, trajectory=recording))
        return result(lease, "done", episodes=tuple(episodes))

    def turn(self, *names: str) -> int:
        """Each of the workers plays what it gets at once; gives the number of jobs."""
        n = 0
        for name in names or tuple(self.sessions):
            if name in self.rig.core.fleet.quarantined:
                continue
            for lease in self.rig.poll(self.sessions[name]) or ():
                self.hand_in(name, lease)
                n += 1
        return n + self.shell()

    def shell(self) -> int:
        """Carry out what audits need of the store."""
        effects, self.rig.audits = self.rig.audits, []
        for effect in effects:
            played = self.rig.row(OutcomeRow, effect.group, effect.index).outcome
            common = {"run": effect.run, "audit": effect.audit}
            if isinstance(effect, PrepareAudit):
                true_return = self._truth(effect.group, effect.index)
                actions = BlobRef(digest=str(true_return), size=1)
                self.rig.tell(events.AuditPrepared(**common, actions=actions))
                continue
            again = [self.rig.row(OutcomeRow, group, 0).outcome for group in effect.replays]
            self.rig.tell(
                events.AuditCompared(
                    **common,
                    replay=len(again),
                    with_player=_difference(played.episode_return, again[-1].episode_return),
                    with_first=_difference(again[0].episode_return, again[-1].episode_return),
                )
            )
        return len(effects)

    def _truth(self, group: str, index: int) -> float:
        row = self.rig.row(OutcomeRow, group, index)
        return row.outcome.episode_return - self.adds[row.worker]

    def train(self, *ids: int, run: str = "r1") -> None:
        """A run with one submit, not closed."""
        self.rig.create(run, n_valid=2, n_held=2)
        self.rig.submit(*ids, run=run)

    def work_off(self) -> None:
        for _ in range(1000):
            if not self.turn():
                return
        raise AssertionError("there is no end to the work")

    def whole_run(self, *ids: int) -> operator.RunFinished:
        """A run from its creation to its end; every worker works."""
        self.train(*(ids or tuple(range(8))))
        self.work_off()
        self.rig.close()
        self.work_off()
        self.rig.pass_time(WAIT_S + 60.0)
        return self.rig.finished()

    @property
    def audits(self) -> list[tuple[str, str]]:
        """Who played what again, and of whom."""
        found = []
        for name, job in self.played:
            group, mark, rest = job.rpartition("/")[0].partition("/audit-")
            if mark:
                index = int(rest.partition(".")[0])
                found.append((name, self.rig.row(OutcomeRow, group, index).worker))
        return found


def _difference(one: float, other: float) -> str | None:
    return None if one == other else f"step 0: reward {one!r} and {other!r}"


def told(finished: operator.RunFinished) -> Any:
    assert finished.audit is not None
    return finished.audit


# ---- who lied ----


def test_a_forger_among_three_is_named_and_gets_no_more_leases() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
    finished = fleet.whole_run()
    found = told(finished)
    assert list(found.forgers) == ["w2"]
    assert found.in_question
    assert all(finding.forger == "w2" for finding in found.findings)
    assert "w2" in fleet.rig.core.fleet.quarantined
    assert fleet.rig.row(WorkerRow, "w2").state == "quarantined"
    answer = fleet.rig.poll(fleet.sessions["w2"])
    assert isinstance(answer, wire.Refused)
    assert answer.status == "quarantined"
    assert "forged" in answer.message
    assert "w2" in fleet.rig.core.status(fleet.rig.now).quarantined
    assert [log.fields["worker"] for log in fleet.rig.logs if log.event == "forger_named"] == ["w2"]


def test_what_a_forger_holds_when_it_is_named_is_played_by_others() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
    fleet.train(0, 1, 2, 3, 4, 5)
    held = fleet.rig.poll(fleet.sessions["w2"], 1)
    fleet.hand_in("w2", *held)
    kept = fleet.rig.poll(fleet.sessions["w2"], 1)
    while "w2" not in fleet.rig.core.fleet.quarantined:
        assert fleet.turn("w1", "w3")
    late = fleet.rig.hand_in(fleet.sessions["w2"], fleet.done("w2", kept[0]))
    assert isinstance(late, wire.Refused)
    fleet.work_off()
    job = kept[0].job
    row = fleet.rig.row(OutcomeRow, job.job_id.rpartition("/")[0], job.episodes[0].index)
    assert row.worker != "w2"
    settled = fleet.rig.row(OutcomeRow, held[0].job.job_id.rpartition("/")[0], held[0].job.episodes[0].index)
    assert settled.worker == "w2", "what was settled stays"


def test_two_workers_that_disagree_are_both_in_dispute_and_nobody_is_named() -> None:
    fleet = Fleet(w1=0.0, w2=5.0)
    fleet.train(0, 1, 2, 3)
    fleet.work_off()
    assert any("a third is to decide" in text for text in fleet.rig.core.status(fleet.rig.now).disputes)
    fleet.rig.close()
    fleet.work_off()
    fleet.rig.pass_time(WAIT_S)
    found = told(fleet.rig.finished())
    assert found.disputed == found.audited > 0
    assert found.forgers == {}
    assert not fleet.rig.core.fleet.quarantined
    assert {name for finding in found.findings for name in (finding.player, *finding.auditors)} == {
        "w1",
        "w2",
    }
    assert found.in_question


def test_a_third_worker_that_comes_later_decides() -> None:
    fleet = Fleet(w1=0.0, w2=5.0)
    fleet.train(0, 1, 2, 3)
    fleet.work_off()
    fleet.join("w3")
    fleet.work_off()
    assert list(fleet.rig.core.fleet.quarantined) == ["w2"]


def test_a_forging_auditor_is_named_and_the_player_confirmed() -> None:
    fleet = Fleet(w1=0.0, w2=5.0)
    fleet.train(0)
    while fleet.turn("w1"):
        pass
    fleet.turn("w2")
    fleet.join("w3")
    fleet.work_off()
    fleet.rig.close()
    fleet.work_off()
    found = told(fleet.rig.finished())
    assert found.forgers == {"w2": 0}
    assert found.disputed == 0
    assert not found.in_question
    assert found.findings[0].player == "w1"
    assert found.findings[0].forger == "w2"


def test_three_workers_with_three_results_are_in_dispute_and_nobody_is_named() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=9.0)
    found = told(fleet.whole_run())
    assert found.disputed == found.audited > 0
    assert found.forgers == {}


def test_a_recording_that_is_none_is_in_dispute() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0)
    (lease,) = fleet.rig.poll(fleet.sessions["w1"], 1)
    fleet.hand_in("w1", lease)
    (effect,) = fleet.rig.audits
    fleet.rig.audits = []
    fleet.rig.tell(
        events.AuditPrepared(
            run=effect.run, audit=effect.audit, actions=None, error="it cannot be read", at_fault=True
        )
    )
    fleet.rig.close()
    fleet.work_off()
    assert told(fleet.rig.finished()).disputed == 1


def test_an_operator_takes_a_quarantined_worker_back() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
    fleet.whole_run()
    rig = fleet.rig
    drained = rig.tell(events.WorkerStateSet(request="d", worker="w2", state="draining"))
    assert isinstance(drained, wire.Refused)
    assert isinstance(
        rig.tell(events.WorkerStateSet(request="a", worker="w2", state="active")), operator.Done
    )
    fleet.join("w2")
    assert rig.core.fleet.quarantined == {}


def test_a_run_whose_episodes_a_forger_played_is_in_question_though_another_run_caught_it() -> None:
    fleet = Fleet(share=0.0, w1=0.0, w2=5.0, w3=0.0)
    fleet.train(0, 1, 2, 3, run="r1")
    fleet.work_off()
    fleet.rig.settings = msgspec.structs.replace(fleet.rig.settings, audit_share=1.0)
    fleet.rig.load()
    for name in ("w1", "w2", "w3"):
        fleet.join(name)
    fleet.rig.pass_time(10.0)
    fleet.train(0, 1, 2, 3, 4, 5, run="r2")
    fleet.work_off()
    fleet.rig.close("r1")
    fleet.work_off()
    found = told(fleet.rig.finished("r1"))
    assert found.share == 0.0
    assert found.sampled == 0
    assert found.forgers["w2"] > 0
    assert found.in_question


def test_workers_of_one_machine_have_one_voice() -> None:
    fleet = Fleet()
    for name, machine in (("f1", "bad"), ("f2", "bad"), ("w1", "good"), ("w2", "better")):
        fleet.join(name, machine=machine)
    fleet.adds |= {"f1": 5.0, "f2": 5.0}
    found = told(fleet.whole_run())
    assert set(found.forgers) == {"f1", "f2"}
    assert set(fleet.rig.core.fleet.quarantined) == {"f1", "f2"}
    assert all({player[0], auditor[0]} != {"f"} for auditor, player in fleet.audits)
    with pytest.raises(RefusedError, match="of the same machine"):
        fleet.join("f3", machine="bad")
    fleet.rig.load()
    with pytest.raises(RefusedError, match="forged"):
        fleet.join("f3", machine="bad")
    fleet.join("w1", machine="good")


def test_two_workers_of_one_machine_audit_nothing() -> None:
    fleet = Fleet()
    fleet.join("f1", machine="bad")
    fleet.join("f2", machine="bad")
    found = told(fleet.whole_run(0, 1))
    assert found.not_audited == {audit.ONE_MACHINE: found.sampled}


def test_a_machine_cannot_play_under_the_name_of_anothers_worker() -> None:
    fleet = Fleet()
    fleet.join("w1", machine="good")
    with pytest.raises(RefusedError, match="another machine"):
        fleet.join("w1", machine="bad")
    fleet.join("w1", machine="good")


# ---- who plays what again ----


def test_nobody_audits_himself_and_every_list_of_a_run_is_audited() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    found = told(fleet.whole_run(0, 1, 2, 3))
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
    assert job.record == "full"
    assert job.episodes[0].replay is not None
    assert job.episodes[0].case.seed == 0


def test_a_lone_worker_is_not_waited_for() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    fleet.work_off()
    fleet.rig.close()
    fleet.rig.pass_time(20.0)
    fleet.work_off()
    found = told(fleet.rig.finished())
    assert found.not_audited == {audit.ONE_WORKER: found.sampled}
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

    waits = rig.tell(events.RunWaited(request="w", run="r1", wait_s=0.0))
    assert "audits" in waits.waits_for
    beat_for(WAIT_S - 10.0)
    assert "r1" in rig.core.runs
    beat_for(20.0)
    assert told(rig.finished()).not_audited == {audit.TOO_LATE: 2 + 2 + 2 + 2}


def test_a_lone_worker_after_a_restart_is_given_time_to_find_company() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    fleet.work_off()
    fleet.rig.close()
    fleet.work_off()
    fleet.rig.load()
    fleet.join("w1")
    assert "r1" in fleet.rig.core.runs
    fleet.join("w2")
    fleet.rig.pass_time(5.0)
    fleet.work_off()
    fleet.rig.pass_time(20.0)
    assert told(fleet.rig.finished()).not_audited == {}


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
    assert list(told(fleet.rig.finished()).not_audited) == [audit.OTHERS_DIFFER]


def test_an_environment_that_does_not_repeat_itself_is_not_audited() -> None:
    fleet = Fleet()
    fleet.join("w1", deterministic=False)
    fleet.join("w2", deterministic=False)
    found = told(fleet.whole_run(0, 1))
    assert found.not_audited == {audit.NOT_REPEATABLE: found.sampled}
    assert fleet.audits == []


def test_a_cancelled_run_plays_no_more_audits() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0, 1)
    fleet.turn("w1")
    fleet.rig.tell(events.RunCancelled(request="c", run="r1"))
    assert told(fleet.rig.finished()).not_audited == {audit.CANCELLED: 2}
    assert not fleet.rig.core.groups


# ---- never in the way ----


def test_train_jobs_go_before_audits_and_stop_them() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0, 1)
    fleet.turn("w1")
    fleet.join("w2", slots=2)
    taken = fleet.rig.poll(fleet.sessions["w2"], 1)
    while taken and "audit" not in taken[0].job.job_id:
        fleet.hand_in("w2", *taken)
        taken = fleet.rig.poll(fleet.sessions["w2"], 1)
    assert taken, "an audit is what there is to do"
    (more,) = fleet.rig.poll(fleet.sessions["w2"], 1)
    assert "audit" in more.job.job_id
    fleet.rig.submit(2, 3, key="second")
    reply = fleet.rig.beat(fleet.sessions["w2"], *taken, more)
    assert set(reply.cancelled) == {taken[0].lease_id, more.lease_id}
    for lease in (*taken, more):
        fleet.rig.hand_in(fleet.sessions["w2"], result(lease, "returned"))
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
            if name not in fleet.rig.core.fleet.quarantined:
                fleet.join(name)
        fleet.rig.pass_time(5.0)
        fleet.work_off()
        fleet.rig.close()
        fleet.work_off()
        fleet.rig.pass_time(WAIT_S)
        found = told(fleet.rig.finished())
        assert list(found.forgers) == ["w2"], stop_after
        assert found.audited + sum(found.not_audited.values()) == found.sampled == 4 + 2 + 2 + 2


def test_a_player_cannot_claim_the_audit_of_its_own_episode_after_a_restart() -> None:
    fleet = Fleet(w1=0.0)
    fleet.train(0)
    fleet.turn("w1")
    (job,) = [job for job in fleet.rig.core.jobs.values() if job.group.kind == "audit"]
    fleet.rig.load()
    fleet.join("w1")
    claimed = wire.HeldLease(lease_id=f"{job.job_id}#1", job_id=job.job_id, attempt=1, running=True)
    reply = fleet.rig.tell(
        events.HeartbeatReceived(
            request="beat", worker="w1", session=fleet.sessions["w1"], held=(claimed,), wait_s=0.0
        )
    )
    assert reply.cancelled == (claimed.lease_id,)
    forged = wire.JobResult(
        lease_id=claimed.lease_id, job_id=job.job_id, attempt=1, kind="done", episodes=(outcome_of(0),)
    )
    fleet.rig.hand_in(fleet.sessions["w1"], forged)
    assert job.job_id in fleet.rig.core.jobs, "it is still to be played"


# ---- the draw ----


@given(st.integers(0, 10**6), st.floats(0, 1), st.floats(0, 1))
def test_what_is_drawn_by_a_share_is_drawn_by_a_larger_one(index: int, one: float, other: float) -> None:
    small, large = sorted((one, other))
    if audit.drawn(b"s" * 32, "r/s0/train", index, small):
        assert audit.drawn(b"s" * 32, "r/s0/train", index, large)
    assert audit.drawn(b"s" * 32, "r/s0/train", index, 1.0)
    assert not audit.drawn(b"s" * 32, "r/s0/train", index, 0.0)


def test_a_share_is_about_that_share_and_another_in_another_run() -> None:
    def draw(secret: bytes) -> list[bool]:
        return [audit.drawn(secret, "r/s0/train", index, 0.05) for index in range(20_000)]

    one, other = (draw(hashlib.sha256(text).digest()) for text in (b"one", b"other"))
    assert 800 < sum(one) < 1200
    assert one != other


@settings(max_examples=60, deadline=None)
@given(
    n_honest=st.integers(0, 4),
    forges=st.booleans(),
    share=st.sampled_from([0.0, 0.2, 1.0]),
    order=st.permutations(range(5)),
    episodes=st.integers(1, 8),
)
def test_no_honest_worker_is_ever_named_and_a_forger_among_three_always_is(
    n_honest: int, forges: bool, share: float, order: list[int], episodes: int
) -> None:
    adds = {f"w{place}": 0.0 for place in order[:n_honest]}
    if forges or not adds:
        adds["wf"] = 5.0
    fleet = Fleet(share=share, **adds)
    finished = fleet.whole_run(*range(episodes))
    found = finished.audit
    named = set() if found is None else set(found.forgers)
    assert named <= {"wf"}
    assert set(fleet.rig.core.fleet.quarantined) <= {"wf"}
    assert finished.status == "completed"
    assert finished.budget_used == episodes
    if found is not None:
        assert found.audited + sum(found.not_audited.values()) == found.sampled
        assert found.agreed + found.disputed == found.audited
    played = {name for name, job in fleet.played}
    if share == 1.0 and n_honest >= 2 and "wf" in played:
        assert named == {"wf"}


def test_the_bundle_is_not_needed_for_an_audit() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0)
    fleet.turn("w1")
    (job,) = [job for job in fleet.rig.core.jobs.values() if job.group.kind == "audit"]
    assert job.names_blob("0.0")
    assert not job.names_blob(BUNDLE)
