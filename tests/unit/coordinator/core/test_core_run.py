"""A run from creation to its end, and what its gateway and operator are told on the way."""

from __future__ import annotations

from rigs.core_rig import Rig, split_of

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages.episode import Job
from evopolicy_common.messages.worker import Refused
from evopolicy_coordinator.core.contract.effects import ReadFinished, ReadResults
from evopolicy_coordinator.core.contract.records import SubmitRow, submit_done


def value(job: Job) -> float:
    """Of an episode of the first run: the later submits are better."""
    split = split_of(job)
    return {"heldout": 7.0, "random": -1.0}.get(split, 2.0 if "/s0/" in job.job_id else 5.0)


def test_a_run_plays_its_submits_validates_selects_and_is_scored(rig: Rig) -> None:
    session = rig.register()
    assert isinstance(rig.create(), operator.RunCreated)
    opened = rig.ask(gateway.OpenRun, run="r1")
    assert isinstance(opened, gateway.RunOpened)
    assert opened.state.remaining_budget == 16

    accepted = rig.submit(0, 1, 1, 7)
    assert accepted == gateway.SubmitAccepted(submit_index=0, first_global_episode=0, remaining_budget=12)
    rig.work_off(session, lambda job: 2.0)
    page = rig.results()
    assert isinstance(page, ReadResults)
    assert page.upto == 4
    row = rig.row(SubmitRow, "r1", 0)
    done = submit_done(row)
    assert done is not None
    assert (done.status, done.n_kept, row.mean_return, row.val_mean) == ("ok", 4, 2.0, None)

    rig.submit(3, key="k1")
    rig.work_off(session, lambda job: 5.0)
    rig.submit(4, key="k2")
    rig.work_off(session, lambda job: 5.0)
    assert rig.ask(operator.WaitRun, run="r1", wait_s=60.0) is None
    waiting = rig._requests
    rig.finish(session, value)
    assert isinstance(rig.replies[waiting], ReadFinished)
    finished = rig.finished()
    assert finished.status == "completed"
    assert finished.best_submit_index == 2  # a tie goes to the later submit
    assert finished.val_scores == {0: 2.0, 1: 5.0, 2: 5.0}
    assert finished.heldout_returns == (7.0, 7.0, 7.0)
    assert finished.random_heldout_returns == (-1.0, -1.0, -1.0)
    assert (finished.final_score, finished.budget_used) == (7.0, 6)
    assert not rig.core.state.groups
    assert not rig.core.state.jobs


def test_a_request_of_an_unknown_run_is_refused(rig: Rig) -> None:
    for answer in (rig.submit(0), rig.results(), rig.close(), rig.ask(gateway.StateRequest, run="r1")):
        assert isinstance(answer, Refused)
        assert answer.status == "unknown_run"


def test_a_gateway_that_knows_more_submits_is_told_so(rig: Rig) -> None:
    """As of a coordinator on a backup from before these submits."""
    session = rig.register()
    rig.create()
    for ask in (
        lambda: rig.submit(0, key="k1", after=1),
        lambda: rig.ask(gateway.CloseRun, run="r1", reason="agent_stopped", after=1),
    ):
        answer = ask()
        assert isinstance(answer, Refused)
        assert answer.status == "unknown_submit"
    assert rig.submit(0, key="k0") == gateway.SubmitAccepted(
        submit_index=0, first_global_episode=0, remaining_budget=15
    )
    rig.work_off(session, lambda job: 1.0)
    assert rig.ask(gateway.CloseRun, run="r1", reason="agent_stopped", after=1) == gateway.RunClosed()
