"""What is told of an environment is true of it: spaces, step limit, reward components, `info`."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from environment_checks import IDS

from evopolicy_common import catalogue
from evopolicy_common.catalogue import entries, entry, installs
from evopolicy_common.messages.environment import Case, EnvironmentDescription, SpaceSchema
from evopolicy_common.records.episodes.rendered import Renderer, decode
from evopolicy_worker.environments import Environment, offered
from evopolicy_worker.environments.interface.spaces import bounds

Warm = Callable[[str], Environment]


def test_the_whole_catalogue_is_offered() -> None:
    """All but the families that only another installation, or another Python, can play."""
    here = [
        each for each in entries() if not (family := installs.family_of(each)) or installs.is_here(family)
    ]
    assert here == offered()
    apart = {installs.family_of(each) for each in set(entries()) - set(here)}
    assert apart == {name for name, each in installs.installs().items() if each.pins or not each.fits}


@pytest.mark.parametrize("env_id", IDS)
def test_a_description_survives_the_wire(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    assert (
        msgspec.msgpack.decode(msgspec.msgpack.encode(description), type=EnvironmentDescription)
        == description
    )
    assert msgspec.json.decode(msgspec.json.encode(description), type=EnvironmentDescription) == description
    assert "Infinity" not in json.dumps(msgspec.to_builtins(description))


@pytest.mark.parametrize("env_id", IDS)
def test_a_description_says_what_the_catalogue_says(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    found = entry(env_id)
    assert description.env == env_id
    assert (found.gymnasium_id or env_id) in description.env_version
    assert description.max_episode_steps == found.max_episode_steps
    obs, action = description.obs_space, description.action_space
    symbols = obs["type"] == "Dict" and "mission" in obs["spaces"]
    kinds = {"Box": "state", "Image": "image", "Dict": "symbolic" if symbols else "dict"}
    assert found.observation == kinds[obs["type"]]
    assert found.action == {"Box": "continuous", "Discrete": "discrete"}[action["type"]]


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.system
def test_a_steps_feedback_takes_about_what_the_catalogue_says(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    rng = np.random.default_rng(0)
    recorder = Renderer("arrays", environment.description.obs_storage)
    n, most = 0, 100
    for seed in range(most):
        obs, ended = environment.reset(Case(seed=seed)), False
        while not ended and n < most:
            action = environment.action_codec.sample(rng)
            step = environment.step(action)
            ended = step.terminated or step.truncated
            recorder.append(obs, action, step.reward, step.terminated, step.truncated, step.info)
            obs, n = step.obs, n + 1
    files = decode(recorder.finish()).files
    assert sum(map(len, files.values())) / n == pytest.approx(entry(env_id).step_bytes, rel=0.25)


@pytest.mark.parametrize("env_id", IDS)
def test_observations_are_exactly_what_the_schema_says(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    rng = np.random.default_rng(0)
    obs = environment.reset(Case(seed=0))
    assert_fits(environment.description.obs_space, obs)
    for _ in range(5):
        step = environment.step(environment.action_codec.sample(rng))
        assert_fits(environment.description.obs_space, step.obs)


def assert_fits(schema: SpaceSchema, obs: Any) -> None:
    kind = schema["type"]
    if kind in ("Box", "Image"):
        assert type(obs) is np.ndarray
        assert obs.dtype == np.dtype(schema["dtype"])
        assert list(obs.shape) == schema["shape"]
        assert obs.flags.c_contiguous
        assert obs.flags.owndata
    elif kind == "Discrete":
        assert type(obs) is int
        assert 0 <= obs - schema.get("start", 0) < schema["n"]
    elif kind == "Text":
        assert type(obs) is str
        assert schema["min_length"] <= len(obs) <= schema["max_length"]
    elif kind == "MultiDiscrete":
        assert obs.dtype == np.int64
        assert bool(((obs >= 0) & (obs < np.array(schema["nvec"]))).all())
    elif kind == "MultiBinary":
        assert obs.dtype == np.int8
        assert set(obs.ravel().tolist()) <= {0, 1}
    else:
        assert kind == "Dict"
        assert type(obs) is dict
        assert list(obs) == list(schema["spaces"])
        for key, part in schema["spaces"].items():
            assert_fits(part, obs[key])


@pytest.mark.parametrize("env_id", IDS)
def test_info_is_plain_names_no_seed_and_holds_the_reward_components(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    rng = np.random.default_rng(0)
    environment.reset(Case(seed=0))
    for _ in range(3):
        step = environment.step(environment.action_codec.sample(rng))
        assert type(step.reward) is float
        assert type(step.terminated) is bool
        assert type(step.truncated) is bool
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(step.info)) == step.info
        assert json.loads(json.dumps(step.info)) == step.info
        assert not [key for key in step.info if "seed" in key]
        rewards = step.info.get("rewards", step.info)
        components = [rewards[name] for name in environment.description.reward_components]
        assert set(environment.description.reward_texts) == set(environment.description.reward_components)
        assert all(environment.description.reward_texts.values())
        assert all(type(value) is float for value in components)
        if components and not env_id.startswith("gymnasium/roundabout"):
            assert sum(components) == pytest.approx(step.reward, abs=1e-6)


@pytest.mark.parametrize(
    ("env_id", "action"),
    [
        *((env_id, 6) for env_id in IDS if "MiniGrid" in env_id),
        ("gymnasium/parking-v0", np.zeros(2, dtype=np.float32)),
        ("gymnasium/FetchPush-v4", np.zeros(4, dtype=np.float32)),
        ("gym/acrobot", 1),
        ("gym/continuouscar", np.zeros(1, dtype=np.float32)),
        ("gym/reacher5", np.zeros(2, dtype=np.float32)),
        ("gym/pusher5", np.zeros(7, dtype=np.float32)),
        ("toy/line", np.zeros(1, dtype=np.float32)),
        ("toy/maze", 0),
    ],
)
def test_an_idle_episode_is_truncated_at_the_stated_limit(env_id: str, action: Any, warm: Warm) -> None:
    environment = warm(env_id)
    environment.reset(Case(seed=1))
    for number in range(1, environment.description.max_episode_steps + 1):
        step = environment.step(action)
        assert not step.terminated
        assert step.truncated == (number == environment.description.max_episode_steps)


@pytest.mark.parametrize("env_id", IDS)
def test_random_actions_are_those_of_the_gymnasium_space(env_id: str, warm: Warm) -> None:
    if env_id.startswith("toy/"):
        codec = warm(env_id).action_codec
        assert codec.repair(codec.sample(np.random.default_rng(0)))[1] is False
        return
    import gymnasium

    environment = warm(env_id)
    space: gymnasium.Space[Any] = environment.bare.action_space  # type: ignore[attr-defined]
    space.seed(7)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(7)))
    for _ in range(20):
        expected, action = space.sample(), environment.action_codec.sample(rng)
        assert np.array_equal(expected, action)
        assert space.contains(action) or space.contains(np.int64(action))
        assert environment.action_codec.repair(action)[1] is False


@pytest.mark.parametrize("env_id", IDS)
def test_an_environment_survives_its_repaired_nonsense(env_id: str, warm: Warm) -> None:
    environment = warm(env_id)
    environment.reset(Case(seed=3))
    nonsense: list[Any] = [None, "nonsense", float("nan"), 10**400, [[[]]], {"a": 1}, np.full(3, np.inf)]
    for raw in nonsense:
        action, invalid = environment.action_codec.repair(raw)
        assert invalid
        if environment.description.action_space["type"] == "Box":
            low, high = bounds(environment.description.action_space)
            assert bool(((action >= low) & (action <= high)).all())
        step = environment.step(action)
        assert np.isfinite(step.reward)
        if step.terminated or step.truncated:
            environment.reset(Case(seed=3))


@pytest.mark.parametrize("env_id", IDS)
def test_the_definition_is_the_one_that_ships(env_id: str, warm: Warm) -> None:
    digest = warm(env_id).description.digest()
    assert digest.startswith(catalogue.digests()[env_id]), f"python docs/_site/digests.py {env_id}"
