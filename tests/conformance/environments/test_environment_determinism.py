"""The same case and the same actions give the same episode, bit for bit, wherever and after whatever it is played."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import pytest
from environment_checks import IDS, SEED, STEPS, elsewhere, play

from evopolicy_common.catalogue import entry
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import Environment, make
from evopolicy_worker.environments.families.box2d import Box2DFamily

Warm = Callable[[str], Environment]


def fresh_episode(env_id: str) -> list[str]:
    environment = make(env_id)
    try:
        return play(environment)
    finally:
        environment.close()


@pytest.fixture(scope="session")
def played() -> dict[str, list[str]]:
    """Episodes of all ids, played in one other process, each after those of all ids behind it in the catalogue."""
    return elsewhere("play")


@pytest.mark.parametrize("env_id", IDS)
def test_a_reused_environment_plays_the_same_episode_as_a_fresh_one(env_id: str, warm: Warm) -> None:
    fresh = fresh_episode(env_id)
    environment = warm(env_id)
    assert environment.description.deterministic
    for earlier in (3, 4):
        play(environment, seed=earlier)
    assert play(environment) == fresh
    assert play(environment) == fresh
    play(environment, seed=5, steps=3)  # abandoned in the middle
    assert play(environment) == fresh


@pytest.mark.parametrize("env_id", IDS)
def test_another_process_plays_the_same_episode(env_id: str, played: dict[str, list[str]]) -> None:
    assert fresh_episode(env_id) == played[env_id]


@pytest.mark.parametrize("env_id", IDS)
def test_other_seeds_give_other_episodes(env_id: str, warm: Warm) -> None:
    first = {play(warm(env_id), seed=seed, steps=2)[0] for seed in range(4)}
    assert len(first) > 1 or len({tuple(play(warm(env_id), seed=seed, steps=20)) for seed in range(4)}) > 1


def test_the_check_notices_a_walker_that_is_not_rebuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    fresh = fresh_episode("gym/bipedal")
    monkeypatch.setattr(Box2DFamily, "rebuilds", lambda self, entry: False)
    environment = make("gym/bipedal")
    for earlier in range(5):
        play(environment, seed=earlier)
    assert play(environment) != fresh
    environment.close()


@pytest.mark.parametrize("env_id", [env_id for env_id in IDS if not env_id.startswith("toy/")])
def test_the_adapter_plays_as_the_bare_environment_does(env_id: str, warm: Warm) -> None:
    import gymnasium

    environment = warm(env_id)
    environment.reset(Case(seed=SEED))  # imports and registers what the bare one needs
    with pytest.warns(DeprecationWarning, match="out of date") if "roundabout" in env_id else nullcontext():
        bare = gymnasium.make(str(entry(env_id).gymnasium_id), disable_env_checker=True)
    rng = np.random.default_rng(SEED)
    np.testing.assert_equal(environment.reset(Case(seed=SEED)), bare.reset(seed=SEED)[0])
    for _ in range(STEPS.get(env_id, 80)):
        action = environment.action_codec.sample(rng)
        obs, reward, terminated, truncated, _ = bare.step(action)
        step = environment.step(action)
        np.testing.assert_equal(step.obs, obs)
        assert (step.reward, step.terminated, step.truncated) == (float(reward), terminated, truncated)
        if terminated or truncated:
            break
    bare.close()


@pytest.mark.parametrize("env_id", IDS)
def test_observations_are_not_written_again_by_later_steps(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    rng = np.random.default_rng(1)
    kept = [environment.reset(Case(seed=1))]
    copies = copy.deepcopy(kept)
    for _ in range(3):
        kept.append(environment.step(environment.action_codec.sample(rng)).obs)
        copies.append(copy.deepcopy(kept[-1]))
    environment.reset(Case(seed=2))
    np.testing.assert_equal(kept, copies)
