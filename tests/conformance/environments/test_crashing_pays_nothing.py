"""A policy that fails at once is worth what uniform random actions are worth, also where every step costs.

Were its episode ended instead, it would score −1 where an honest policy scores −100.
"""

from __future__ import annotations

import asyncio

import pytest

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeOutcome, EpisodeSpec, Job
from evopolicy_worker.slots.slot import Slot

STEPS_COST = [
    "toy/maze",
    "gym/acrobot",
    "gym/reacher5",
    "gym/pusher5",
    "gymnasium/parking-v0",
    "gymnasium/FetchPush-v4",
    "gymnasium/FetchPickAndPlace-v4",
]
WAYS = {
    "raises in reset": "def reset(self, i): raise ValueError\n    def act(self, obs): pass",
    "raises in act": "def reset(self, i): pass\n    def act(self, obs): raise ValueError",
    "exits": "def reset(self, i): pass\n    def act(self, obs): __import__('os')._exit(0)",
}


def job(env: str, bundle: str | None) -> Job:
    specs = tuple(
        EpisodeSpec(index=i, episode_index=i, case=Case(seed=500 + i), policy_seed=bytes([i + 1] * 16))
        for i in range(3)
    )
    return Job(job_id=f"{env} {bundle}", env=env, bundle=bundle, episodes=specs)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], tuple[EpisodeOutcome, ...]]:
    """What each way of failing, and honest random play, come to in each environment."""
    scratch = tmp_path_factory.mktemp("crashing")

    async def play() -> dict[tuple[str, str], tuple[EpisodeOutcome, ...]]:
        found = {}
        slot = Slot(None, "bwrap", scratch / "slot")
        await slot.start()
        try:
            for env in STEPS_COST:
                found[env, "random"] = await slot.play_job(job(env, None), None, lambda done, steps: None)
                for way, methods in WAYS.items():
                    bundle = scratch / way.replace(" ", "-")
                    bundle.mkdir(exist_ok=True)
                    (bundle / "policy.py").write_text(
                        f"class Policy:\n    def __init__(self, o, a, m): pass\n    {methods}\n"
                    )
                    found[env, way] = await slot.play_job(
                        job(env, "0" * 64), bundle, lambda done, steps: None
                    )
        finally:
            await slot.close()
        return found

    return asyncio.run(play())


@pytest.mark.parametrize("env", STEPS_COST)
@pytest.mark.parametrize("way", WAYS)
def test_a_policy_that_fails_at_once_scores_what_random_actions_score(
    outcomes: dict[tuple[str, str], tuple[EpisodeOutcome, ...]], env: str, way: str
) -> None:
    failed, random = outcomes[env, way], outcomes[env, "random"]
    assert all(outcome.failure is not None for outcome in failed)
    assert all(outcome.failure is None for outcome in random)
    assert [outcome.length for outcome in failed] == [outcome.length for outcome in random]
    assert [outcome.episode_return for outcome in failed] == [outcome.episode_return for outcome in random]


def test_every_step_of_these_environments_costs(
    outcomes: dict[tuple[str, str], tuple[EpisodeOutcome, ...]],
) -> None:
    # Else they would be the wrong environments to try it on.
    for env in STEPS_COST:
        for outcome in outcomes[env, "random"]:
            assert outcome.episode_return <= 0.0
    assert len(outcomes) == len(STEPS_COST) * (1 + len(WAYS))
