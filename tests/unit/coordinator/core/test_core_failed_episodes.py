"""`failed_episodes` = "end-submit": submits, selection and score of runs whose policies fail, as in the published
software v0.1.0."""

from __future__ import annotations

import random
from typing import Any

import pytest
from rigs.core_rig import Rig, done, split_of

from evopolicy_common.messages.episode import FailureCategory, Job
from evopolicy_common.messages.run_settings import PUBLISHED
from evopolicy_coordinator.core.contract.records import SubmitRow

PROFILE = {**PUBLISHED, "profile": "published"}
FAILURE: FailureCategory = "act_error"


def play_off(rig: Rig, session: str, result: Any) -> None:
    """Let one worker play all there is; `result` gives each job's return and whether its policy fails."""
    while leases := rig.poll(session, n=4):
        for lease in leases:
            value, fails = result(lease.job)
            rig.report_results(session, done(lease, value, FAILURE if fails else None))


def one_submit(failing: str, **settings: Any) -> Rig:
    """A run of one submit whose policy fails in the episodes of one split."""
    rig = Rig()
    session = rig.register()
    rig.create(failed_episodes="end-submit", budget=2, **settings)
    rig.submit(0, 1)
    play_off(rig, session, lambda job: (1.0, split_of(job) == failing))
    rig.close()
    play_off(rig, session, lambda job: (1.0, split_of(job) == failing))
    return rig


def test_a_submit_with_a_failed_episode_is_charged_and_not_eligible() -> None:
    rig = one_submit("train")
    (submit,) = rig.finished().submits
    assert (submit.status, submit.mean_return, submit.val_mean) == ("rollout_timeout", None, None)
    assert (rig.finished().status, rig.finished().budget_used) == ("no_ok_submit", 2)
    row = rig.row(SubmitRow, "r1", 0)
    assert (row.n_kept, row.failure and row.failure.category) == (2, FAILURE)
    assert "2 of 2 episodes, first in number 0" in (row.failure.message if row.failure else "")


def test_a_failed_validation_episode_excludes_the_checkpoint() -> None:
    finished = one_submit("validation").finished()
    assert (finished.status, finished.best_submit_index, finished.val_scores) == ("no_ok_submit", None, {})
    assert finished.submits[0].status == "ok"
    assert finished.validation_ineligible == (0,)


def test_a_failed_heldout_episode_leaves_the_run_without_a_score() -> None:
    finished = one_submit("heldout").finished()
    assert (finished.status, finished.final_score) == ("error", None)
    assert "3 of 3 held-out episodes" in (finished.error or "")


def test_an_excluded_checkpoint_stays_excluded_after_a_restart(rig: Rig) -> None:
    session = rig.begin(0, 1, run={"failed_episodes": "end-submit", "budget": 2, "n_held": 9})
    play_off(rig, session, lambda job: (1.0, False))
    rig.close()
    while rig.row(SubmitRow, "r1", 0).ineligible is False:
        for lease in rig.poll(session, 8):
            failure = FAILURE if split_of(lease.job) == "validation" else None
            rig.report_results(session, done(lease, 1.0, failure))
    session = rig.restarted(slots=2)
    play_off(rig, session, lambda job: (1.0, False))
    assert rig.finished().status == "no_ok_submit"


def published_selection(
    validation: dict[int, list[float]], failed_train: set[int], failed_validation: set[int]
) -> tuple[int | None, dict[int, float]]:
    """The rule of the published software v0.1.0: a failed episode in training or validation excludes the checkpoint; of
    the others, the highest validation mean wins, each with its index times 1e-12 added."""
    scores = {
        index: sum(returns) / len(returns)
        for index, returns in validation.items()
        if index not in failed_train and index not in failed_validation
    }
    best, highest = None, float("-inf")
    for index in sorted(scores):
        key = scores[index] + index * 1e-12
        if key >= highest:
            best, highest = index, key
    return best, scores


@pytest.mark.parametrize("seed", range(15))
def test_selection_in_an_invented_run_is_that_of_the_published_rule(seed: int) -> None:
    draw = random.Random(seed)
    n = draw.randint(3, 8)
    # Few values, so that ties are frequent, and some that differ by less than the rule can tell.
    means = [draw.choice([-2.0, -1.0, -1.0 + 3e-13, 4.0, 4.0 + 6e-13]) for _ in range(n)]
    failed_train = {index for index in range(n) if draw.random() < 0.25}
    failed_validation = {index for index in range(n) if draw.random() < 0.25}

    def result(job: Job) -> tuple[float, bool]:
        if job.bundle is None:
            return 0.0, False
        index, split = int(job.bundle[0], 16), split_of(job)
        value = means[index] if split == "validation" else 1.0
        first = job.episodes[0].index == 0
        return value, first and index in {"train": failed_train, "validation": failed_validation}.get(
            split, ()
        )

    rig = Rig()
    session = rig.register()
    rig.create(budget=n, least=1, most=1, **PROFILE)
    for index in range(n):
        rig.submit(index, key=f"k{index}", bundle=f"{index:x}" * 64)
        play_off(rig, session, result)
    rig.close()
    play_off(rig, session, result)
    finished = rig.finished()
    validation = {index: [means[index]] * 2 for index in range(n)}
    best, scores = published_selection(validation, failed_train, failed_validation)
    assert (finished.best_submit_index, finished.val_scores) == (best, scores)
    assert finished.status == ("no_ok_submit" if best is None else "completed")
