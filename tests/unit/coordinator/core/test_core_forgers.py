"""Workers that are named forgers, those that are not, and the consequences."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.audit_fleet import WAIT_S, Fleet, audit_state

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.records import OutcomeRow, WorkerRow
from evopolicy_coordinator.core.runs import audits


def test_a_forger_among_three_is_named_and_gets_no_more_leases() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
    finished = fleet.whole_run()
    found = audit_state(finished)
    assert list(found.forgers) == ["w2"]
    assert found.in_question
    assert all(finding.forger == "w2" for finding in found.findings)
    assert "w2" in fleet.rig.core.state.quarantined
    assert fleet.rig.row(WorkerRow, "w2").state == "quarantined"
    answer = fleet.rig.poll(fleet.sessions["w2"])
    assert isinstance(answer, wire.Refused)
    assert answer.status == "quarantined"
    assert "forged" in answer.message
    assert "w2" in fleet.rig.status().quarantined
    assert [log.fields["worker"] for log in fleet.rig.logs if log.event == "forger_named"] == ["w2"]


def test_what_a_forger_holds_when_it_is_named_is_played_by_others() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
    fleet.train(0, 1, 2, 3, 4, 5)
    held = fleet.rig.poll(fleet.sessions["w2"], 1)
    fleet.report_results("w2", *held)
    kept = fleet.rig.poll(fleet.sessions["w2"], 1)
    while "w2" not in fleet.rig.core.state.quarantined:
        assert fleet.turn("w1", "w3")
    late = fleet.rig.report_results(fleet.sessions["w2"], fleet.done("w2", kept[0]))
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
    assert any("a third is to decide" in text for text in fleet.rig.status().disputes)
    found = audit_state(fleet.end(WAIT_S))
    assert found.disputed == found.audited > 0
    assert found.forgers == {}
    assert not fleet.rig.core.state.quarantined
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
    assert list(fleet.rig.core.state.quarantined) == ["w2"]


def test_a_forging_auditor_is_named_and_the_player_confirmed() -> None:
    fleet = Fleet(w1=0.0, w2=5.0)
    fleet.train(0)
    while fleet.turn("w1"):
        pass
    fleet.turn("w2")
    fleet.join("w3")
    fleet.work_off()
    found = audit_state(fleet.end())
    assert found.forgers == {"w2": 0}
    assert found.disputed == 0
    assert not found.in_question
    assert found.findings[0].player == "w1"
    assert found.findings[0].forger == "w2"


def test_three_workers_with_three_results_are_in_dispute_and_nobody_is_named() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=9.0)
    found = audit_state(fleet.whole_run())
    assert found.disputed == found.audited > 0
    assert found.forgers == {}


def test_a_recording_that_is_none_is_in_dispute() -> None:
    fleet = Fleet(w1=0.0, w2=0.0)
    fleet.train(0)
    (lease,) = fleet.rig.poll(fleet.sessions["w1"], 1)
    fleet.report_results("w1", lease)
    (effect,) = fleet.rig.audits
    fleet.rig.audits = []
    fleet.rig.tell(
        events.AuditPrepared(
            run=effect.run, audit=effect.audit, actions=None, error="it cannot be read", at_fault=True
        )
    )
    assert audit_state(fleet.end()).disputed == 1


def test_an_operator_takes_a_quarantined_worker_back() -> None:
    fleet = Fleet(w1=0.0, w2=5.0, w3=0.0)
    fleet.whole_run()
    rig = fleet.rig
    drained = rig.ask(operator.SetWorker, worker="w2", state="draining")
    assert isinstance(drained, wire.Refused)
    assert isinstance(rig.ask(operator.SetWorker, worker="w2", state="active"), operator.Done)
    fleet.join("w2")
    assert rig.core.state.quarantined == {}


def test_a_forger_caught_elsewhere_puts_its_other_runs_in_question() -> None:
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
    found = audit_state(fleet.rig.finished("r1"))
    assert found.share == 0.0
    assert found.sampled == 0
    assert found.forgers["w2"] > 0
    assert found.in_question


def test_workers_of_one_machine_have_one_voice() -> None:
    fleet = Fleet()
    for name, machine in (("f1", "bad"), ("f2", "bad"), ("w1", "good"), ("w2", "better")):
        fleet.join(name, machine=machine)
    fleet.adds |= {"f1": 5.0, "f2": 5.0}
    found = audit_state(fleet.whole_run())
    assert set(found.forgers) == {"f1", "f2"}
    assert set(fleet.rig.core.state.quarantined) == {"f1", "f2"}
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
    found = audit_state(fleet.whole_run(0, 1))
    assert found.not_audited == {audits.ONE_MACHINE: found.sampled}


def test_a_machine_cannot_play_under_the_name_of_anothers_worker() -> None:
    fleet = Fleet()
    fleet.join("w1", machine="good")
    with pytest.raises(RefusedError, match="another machine"):
        fleet.join("w1", machine="bad")
    fleet.join("w1", machine="good")


@settings(max_examples=60, deadline=None)
@given(
    n_honest=st.integers(0, 4),
    forges=st.booleans(),
    share=st.sampled_from([0.0, 0.2, 1.0]),
    order=st.permutations(range(5)),
    episodes=st.integers(1, 8),
)
def test_a_forger_among_three_is_named_and_no_honest_worker(
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
    assert set(fleet.rig.core.state.quarantined) <= {"wf"}
    assert finished.status == "completed"
    assert finished.budget_used == episodes
    if found is not None:
        assert found.audited + sum(found.not_audited.values()) == found.sampled
        assert found.agreed + found.disputed == found.audited
    played = {name for name, job in fleet.played}
    if share == 1.0 and n_honest >= 2 and "wf" in played:
        assert named == {"wf"}
