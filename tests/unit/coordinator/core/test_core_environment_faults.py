"""An environment that keeps ending the same job is given up, and its run ends with an error; nothing waits for it for
ever.

Attacks, each with its defence:
- hangs, raises, exits, leaks memory, changes its spaces, gives rewards that are not finite: the call has a
  time limit and the process a memory limit (`--env-timeout`, `--env-memory`); the process is replaced, the
  operator gets environment, call, and remedy, and no agent is charged; a run whose episode it ends every time
  ends with an error after 15 minutes.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from rigs.core_rig import Rig, done, result, split_of

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.contract.records import EvaluationRow, SubmitRow
from evopolicy_coordinator.core.leasing.jobs import FAULTS_MAX

WHY = "environment toy/line, step 7: it has not returned for 300 s"


def failing(
    rig: Rig, *sessions: str, where: str, ends: Callable[[], bool], most_s: float = 5000.0, busy: str = ""
) -> list[wire.Job]:
    """Lets workers play, whose environment ends each job of that list (any if empty); gives its attempts. A busy worker
    is there."""
    attempts: list[wire.Job] = []
    until = rig.now + most_s
    while rig.now < until and not ends():
        for session in sessions:
            for lease in rig.poll(session, n=1):
                if where in ("", split_of(lease.job)):
                    attempts.append(lease.job)
                    fault = result(lease, "failed", error=WHY, environment_fault=True)
                    rig.report_results(session, fault)
                else:
                    rig.report_results(session, done(lease))
            rig.beat(session)
        if busy:
            rig.beat(busy)
        rig.pass_time(2.0)
    return attempts


@pytest.mark.parametrize("where", ["train", "validation", "heldout", "random"])
def test_an_environment_that_ends_every_attempt_ends_the_run_with_an_error(rig: Rig, where: str) -> None:
    session = rig.begin(0, 1, worker={"slots": 1}, run={"n_valid": 1, "n_held": 1})
    if where != "train":
        failing(rig, session, where="none", ends=lambda: rig.core.state.runs["r1"].open is None)
        rig.close()
    begun = rig.now
    attempts = failing(rig, session, where=where, ends=lambda: "r1" not in rig.core.state.runs)
    told = [job.environment_faults for job in attempts if job.job_id == attempts[0].job_id]
    assert told == list(range(len(told)))
    assert len(told) >= FAULTS_MAX
    assert rig.now - begun >= rig.settings.environment_wait_s
    ended = rig.finished()
    assert ended.status == "error"
    assert ended.error is not None
    assert ended.error.startswith(WHY)
    assert (ended.final_score, ended.best_submit_index) == (None, None)
    assert ended.budget_used == (0 if where == "train" else 2)
    assert rig.core.state.jobs == {}


def test_an_environment_that_fails_now_and_then_is_not_given_up(rig: Rig) -> None:
    session = rig.begin(0, worker={"slots": 1}, run={"n_valid": 1})
    # Fast failures, as of a full disk, end no run as long as they may pass.
    early = rig.settings.environment_wait_s - 100.0
    attempts = failing(rig, session, where="train", ends=lambda: False, most_s=early)
    assert len(attempts) > FAULTS_MAX
    failing(rig, session, where="none", ends=lambda: rig.core.state.runs["r1"].open is None)
    assert rig.row(SubmitRow, "r1", 0).status == "ok"


@pytest.mark.parametrize("machine", ["", "rack-1"])
def test_one_machine_alone_ends_no_run_that_another_can_play(rig: Rig, machine: str) -> None:
    """Attack: a worker reports again and again that the environment failed, so that a run ends. Defence: a
    run ends so only when two machines report it, if two can play it."""
    liars = [rig.register(name, machine=machine and "liar") for name in ("w1", "w2")[: 2 if machine else 1]]
    honest = rig.register("w3", machine=machine)
    rig.create(n_valid=1)
    rig.submit(0)
    attempts = failing(rig, *liars, where="train", ends=lambda: False, busy=honest)
    assert len(attempts) > FAULTS_MAX
    assert "r1" in rig.core.state.runs
    failing(rig, honest, where="none", ends=lambda: rig.core.state.runs["r1"].open is None)
    assert rig.row(SubmitRow, "r1", 0).status == "ok"


def test_an_evaluation_of_an_environment_that_fails_ends_with_the_reason(rig: Rig) -> None:
    session = rig.register()
    rig.evaluate(bundle=None)
    failing(rig, session, where="", ends=lambda: not rig.core.state.evaluations)
    assert rig.row(EvaluationRow, "e").error.startswith(WHY)
