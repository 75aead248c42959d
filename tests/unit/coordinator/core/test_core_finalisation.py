"""Validation, selection, held-out, the random reference; evaluations; and that each goes on after a restart."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import hypothesis.strategies as st
import msgspec
import pytest
from hypothesis import given, settings
from rigs import core_rig
from rigs.core_rig import Rig, done, split_of

from evopolicy_common.messages import operator
from evopolicy_common.messages.episode import Job
from evopolicy_common.messages.operator import EvaluationStarted, RunProgress
from evopolicy_common.messages.run_settings import PUBLISHED
from evopolicy_coordinator.core.contract.effects import ReadEvaluation
from evopolicy_coordinator.core.contract.records import EvaluationRow, RunRow
from evopolicy_coordinator.server.reason_texts import reason_text


def value_of(job: Job) -> float:
    """Validation prefers the second bundle."""
    if split_of(job) == "validation":
        return 9.0 if job.bundle == "b" * 64 else 1.0
    return 3.0


def two_submits(rig: Rig, session: str) -> None:
    rig.create()
    rig.submit(0, bundle="a" * 64)
    rig.work_off(session, value_of)
    rig.submit(1, bundle="b" * 64, key="k1")
    rig.work_off(session, value_of)
    rig.submit(2, bundle="c" * 64, key="k2")


def test_the_best_on_hidden_validation_is_selected(rig: Rig) -> None:
    session = rig.register()
    two_submits(rig, session)
    rig.work_off(session, value_of)
    rig.finish(session, value_of)
    assert rig.finished().best_submit_index == 1
    assert rig.finished().policy_failures == {"validation": 0, "heldout": 0}


def test_a_run_tells_whether_its_environment_repeats_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = core_rig.describe
    for mark in (True, False):
        marked = functools.partial(honest, deterministic=mark)
        monkeypatch.setattr(core_rig, "describe", marked)
        rig = Rig()
        session = rig.begin(0)
        rig.work_off(session)
        assert rig.finish(session).deterministic is mark


def test_closing_with_a_submit_in_flight_waits_for_it(rig: Rig) -> None:
    session = rig.register()
    two_submits(rig, session)
    rig.close()
    assert rig.submit(0, key="late").status == "run_closed"
    rig.work_off(session, value_of)
    assert [each.status for each in rig.finished().submits] == ["ok", "ok", "ok"]


def test_a_run_without_an_ok_submit_has_its_random_reference(rig: Rig) -> None:
    session = rig.begin()
    finished = rig.finish(session, lambda job: -2.0)
    assert (finished.status, finished.best_submit_index, finished.final_score) == ("no_ok_submit", None, None)
    assert finished.random_heldout_returns == (-2.0,) * 3


def random_seeds(rig: Rig, session: str, run: str) -> list[bytes]:
    """Seeds of a run's random reference, in order of its cases; everything else is played."""
    found: dict[int, bytes] = {}

    def value(job: Job) -> float:
        if split_of(job) == "random":
            found.update((spec.index, spec.policy_seed) for spec in job.episodes)
        return 1.0

    rig.create(run, key=run)
    rig.close(run)
    rig.work_off(session, value)
    return [found[index] for index in sorted(found)]


def test_runs_on_one_split_play_the_same_random_reference(rig: Rig) -> None:
    session = rig.register()
    first = random_seeds(rig, session, "r1")
    assert first == random_seeds(rig, session, "r2")
    assert len(set(first)) == 3


def test_random_actions_outside_a_run_are_the_reference_of_their_split(rig: Rig) -> None:
    session = rig.register(slots=3)
    reference = random_seeds(rig, session, "r1")
    heldout = rig.row(RunRow, "r1").heldout
    rig.evaluate(bundle=None, split="heldout", case_ids=tuple(range(3)), cases=heldout)
    leases = rig.poll(session, 3)
    assert sorted(each.job.episodes[0].policy_seed for each in leases) == sorted(reference)


def test_hidden_jobs_tell_a_policy_nothing_of_the_split_they_are_from(rig: Rig) -> None:
    session = rig.begin(0, 1, worker={"slots": 8}, run={"n_valid": 5})
    train = rig.poll(session, 8)
    rig.play(session, *train)
    rig.close()
    hidden = [each for each in rig.poll(session, 8) if split_of(each.job) == "validation"]
    assert {str(each.job.env_meta) for each in hidden} == {str(train[0].job.env_meta)}
    assert [each.job.episodes[0].episode_index for each in hidden] == [0, 1, 0, 1, 0]
    assert {each.job.limits for each in hidden} == {train[0].job.limits}
    assert {each.job.video for each in hidden} == {False}


def test_progress_tells_an_operator_which_phase_a_run_is_in(rig: Rig) -> None:
    session = rig.begin(worker={"slots": 8})
    seen = []

    def look() -> None:
        progress = rig.ask(operator.WaitRun, run="r1", wait_s=0.0)
        assert isinstance(progress, RunProgress)
        seen.append((progress.phase, progress.done, progress.total))

    look()
    rig.submit(0)
    rig.play(session, *rig.poll(session, 8))
    rig.close()
    look()
    leases = rig.poll(session, 8)
    rig.play(session, *(each for each in leases if split_of(each.job) == "validation"))
    look()
    rig.play(session, *rig.poll(session, 8))
    look()
    assert seen == [("open", 0, 16), ("validation", 0, 2), ("heldout", 0, 3), ("random", 0, 3)]


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=1, max_size=6))
def test_a_restart_at_any_step_changes_nothing_of_the_result(stops: list[int]) -> None:
    def play(restarts: set[int]) -> object:
        rig = Rig()
        session = rig.register(slots=2)
        rig.create()
        plan = [((0, 1, 1), "a" * 64, "k0"), ((2,), "b" * 64, "k1"), ((3, 4), "c" * 64, "k2")]
        step = 0
        for ids, bundle, key in [*plan, ((), "", "close")]:
            if key == "close":
                rig.close()
            else:
                rig.submit(*ids, bundle=bundle, key=key)
            idle = 0
            while idle < 30:
                step += 1
                if step in restarts:
                    rig.load()
                    session = rig.register(slots=2)
                    if key != "close":
                        rig.submit(*ids, bundle=bundle, key=key)
                rig.pass_time(1.0)
                rig.beat(session)
                leases = rig.poll(session, 2)
                idle = 0 if leases else idle + 1
                values = ((each, float(len(each.job.job_id)) + value_of(each.job)) for each in leases)
                rig.report_results(session, *itertools.starmap(done, values))
        ended = rig.finished()
        return ended.best_submit_index, ended.val_scores, ended.heldout_returns, ended.budget_used

    assert play(set(stops)) == play(set())


def page(rig: Rig, cursor: int, wait_s: float = 0.0) -> ReadEvaluation:
    answer = rig.ask(operator.EvaluationPoll, evaluation="e", cursor=cursor, wait_s=wait_s)
    assert isinstance(answer, ReadEvaluation)
    return answer


def test_an_evaluation_plays_cases_outside_any_run(rig: Rig) -> None:
    assert rig.evaluate() == EvaluationStarted(evaluation="e", episodes=2)
    assert rig.evaluate() == EvaluationStarted(evaluation="e", episodes=2)
    assert "a worker that offers" in reason_text(page(rig, 0).waits_for)
    session = rig.register()
    rig.load()
    session = rig.register()
    rig.pass_time(5.0)
    first, second = rig.poll(session)
    assert first.job.episodes[0].policy_seed != second.job.episodes[0].policy_seed
    rig.play(session, first)
    assert (page(rig, 0).upto, page(rig, 0).finished, page(rig, 0).total) == (1, False, 2)
    rig.play(session, second)
    assert (page(rig, 1).upto, page(rig, 1).finished) == (2, True)
    assert rig.row(EvaluationRow, "e").finished
    rig.load()
    assert page(rig, 0).finished
    assert rig.evaluate() == EvaluationStarted(evaluation="e")
    assert not rig.core.state.groups


def test_an_unknown_evaluation_is_refused(rig: Rig) -> None:
    answer = rig.ask(operator.EvaluationPoll, evaluation="none", cursor=0, wait_s=0.0)
    assert answer.status == "unknown_evaluation"


def test_a_run_that_cannot_be_is_refused(rig: Rig) -> None:
    zeros: list[dict[str, Any]] = [{name: 0} for name in ("budget", "least", "n_valid", "n_held")]
    for wrong in (*zeros, {"least": 5, "most": 4}, {"least": 17, "most": 20}):
        answer = rig.create("r9", **wrong)
        assert answer.status == "bad_settings", wrong
    assert not rig.rows


@pytest.mark.parametrize("again", [False, True])
def test_the_same_key_gives_the_same_run(rig: Rig, again: bool) -> None:
    first = rig.create("r1", key="same")
    if again:
        rig.load()
    assert rig.create("r2", key="same") == first


def test_an_unspent_run_that_must_spend_is_an_error(rig: Rig) -> None:
    session = rig.begin(0, 1, run={"budget": 4, "finish": "budget"})
    rig.work_off(session)
    rig.submit(0, key="k1")
    rig.close()
    leases = rig.poll(session, n=4)
    assert {split_of(lease.job) for lease in leases} <= {"train", "validation"}
    rig.report_results(session, *(done(lease) for lease in leases))
    assert not rig.poll(session, n=4)
    finished = rig.finished()
    assert (finished.status, finished.final_score, finished.random_heldout_returns) == ("error", None, ())
    assert finished.error is not None
    assert "1 of its 4 episodes left" in finished.error
    assert finished.budget_used == 3
    assert not rig.core.state.groups


@pytest.mark.parametrize("left", [0, 2])
def test_a_run_that_has_spent_what_it_can_is_scored(rig: Rig, left: int) -> None:
    session = rig.begin(0, 1, 2, run={"budget": 3 + left, "least": 3, "finish": "budget"})
    rig.work_off(session)
    assert rig.finish(session).status == "completed"


def test_every_episode_of_a_run_is_cut_where_its_policy_is_told(rig: Rig) -> None:
    session = rig.begin(0, run={"max_steps": 7})
    kinds = {}
    for closing in (False, True):
        if closing:
            rig.close()
        while leases := rig.poll(session, n=4):
            for lease in leases:
                kinds[split_of(lease.job)] = (lease.job.max_steps, lease.job.env_meta["max_episode_steps"])
            rig.report_results(session, *(done(lease) for lease in leases))
    assert len(kinds) >= 3
    assert set(kinds.values()) == {(7, 7)}
    rig.create("r2")
    rig.submit(0, run="r2", key="k2")
    (lease,) = [lease for lease in rig.poll(session, n=4) if split_of(lease.job) == "train"]
    assert (lease.job.max_steps, lease.job.env_meta["max_episode_steps"]) == (0, 10)


@pytest.mark.parametrize("reload", [False, True])
def test_held_out_success_is_in_the_result_after_a_restart(rig: Rig, reload: bool) -> None:
    session = rig.begin(0)
    rig.play(session, *rig.poll(session))
    rig.close()
    for _ in range(100):
        leases = rig.poll(session, n=1)
        if not leases:
            break
        result = done(leases[0])
        if split_of(leases[0].job) == "heldout":
            (episode,) = result.episodes
            solved = msgspec.structs.replace(episode, success=episode.index != 1)
            result = msgspec.structs.replace(result, episodes=(solved,))
        rig.report_results(session, result)
        if reload and split_of(leases[0].job) == "heldout" and result.episodes[0].index == 1:
            rig.load()
            session = rig.register()
            rig.pass_time(5.0)
    finished = rig.finished()
    assert (len(finished.heldout_returns), finished.heldout_successes) == (3, (True, False, True))


@pytest.mark.parametrize("settings_", [{"policy_scope": "submit"}, {**PUBLISHED, "profile": "published"}])
def test_arguments_tell_a_policy_hidden_cases_in_published_profiles_only(
    rig: Rig, settings_: dict[str, str]
) -> None:
    session = rig.register()
    rig.create(budget=4, n_valid=5, n_held=7, **settings_)
    seen: dict[str, list[Job]] = {}

    def value(job: Job) -> float:
        seen.setdefault(split_of(job), []).append(job)
        return 1.0

    rig.submit(3, 1)
    rig.work_off(session, value)
    rig.submit(2, 0, key="k1")
    rig.work_off(session, value)
    rig.finish(session, value)
    (first, _), hidden = seen["train"], [*seen["validation"], *seen["heldout"]]
    assert (first.env_meta["remaining_budget_after"], first.env_meta["n_episodes_this_submit"]) == (2, 2)
    indices = [[spec.episode_index for spec in job.episodes] for job in hidden]
    budgets = {(job.env_meta["submit_index"], job.env_meta["remaining_budget_after"]) for job in hidden}
    assert {job.env_meta["n_episodes_this_submit"] for job in hidden} == {2}
    if "profile" in settings_:
        assert indices == [[*range(5)], [*range(5)], [*range(7)]]
        assert budgets == {(0, 0), (1, 0)}
    else:
        assert {tuple(each) for each in indices} == {(0, 1), (0,)}
        assert budgets == {(0, 2), (1, 0)}
