"""Worlds: their rules follow from the key alone, can be undone, keep the bounds, and are told to nobody."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common import catalogue
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case
from evopolicy_common.worlds.rules import FACTORS, PARAMETERS, PUBLIC, TEXTS, Rules, kinds, text
from evopolicy_worker import environments
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumEnvironment
from evopolicy_worker.environments.interface.worlds import World

KEYS = st.integers(0, 2**128 - 1).map("{:032x}".format)
BOUNDS = st.sampled_from([(-1.0, 1.0), (0.0, 1.0), (-np.inf, np.inf), (0.0, np.inf), (-4.0, 4.0)])
KINDS = ("the direction of the observation", "the scale of the observation")
SHOWN = [0.1, -0.2, -0.3, -15.5, -11.75]
PLAYED = [0, 1, 2, 3]
POLICIES = Path(__file__).parents[3] / "examples" / "policies"


def box(pairs: list[tuple[float, float]], dtype: str = "float64") -> dict[str, Any]:
    low, high = ([float(each) for each in side] for side in zip(*pairs, strict=True))
    return {"type": "Box", "low": low, "high": high, "shape": [len(pairs)], "dtype": dtype}


def undone(change: Any, value: Any) -> Any:
    """What a change of `Rules` was made of."""
    if change is None or isinstance(change, list):
        return value if change is None else change.index(int(value))
    numbers = np.asarray(value)
    found = np.empty_like(numbers)
    found[change.order] = (numbers - change.shift) / change.scale
    return np.asarray(np.clip(found, change.low, change.high), numbers.dtype)


def values(pairs: list[tuple[float, float]]) -> np.ndarray[Any, Any]:
    """One value for each place, all different, within the bounds."""
    return np.array(
        [
            (0.25 + i / 128) * (min(high, 8.0) - max(low, -8.0)) + max(low, -8.0)
            for i, (low, high) in enumerate(pairs)
        ]
    )


@given(key=KEYS, seen=st.lists(BOUNDS, min_size=1, max_size=8), done=st.lists(BOUNDS, min_size=1, max_size=4))
def test_the_rules_of_a_world_are_undone_and_keep_the_bounds(
    key: str, seen: list[tuple[float, float]], done: list[tuple[float, float]]
) -> None:
    possible = kinds(box(seen), box(done))
    if not possible:
        return
    rules = Rules(key, box(seen), box(done))
    obs, action = values(seen), values(done)
    shown, asked = rules.observe(obs), undone(rules.action_change, action)
    assert 1 <= len(rules.kinds) <= 3
    np.testing.assert_allclose(undone(rules.obs_change, shown), obs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rules.act(asked), action, rtol=0, atol=1e-12)
    for pairs, found in ((seen, shown), (done, asked)):
        assert all(low <= value <= high for (low, high), value in zip(pairs, found, strict=True))
    assert not (np.array_equal(shown, obs) and np.array_equal(asked, action))


@given(key=KEYS, n=st.integers(2, 18))
def test_a_world_of_choices_is_a_permutation_of_them(key: str, n: int) -> None:
    space = {"type": "Discrete", "n": n}
    rules = Rules(key, {"type": "Image", "shape": [3, 3, 3], "dtype": "uint8"}, space)
    played = [rules.act(each) for each in range(n)]
    assert sorted(played) == list(range(n))
    assert played != list(range(n))
    assert [undone(rules.action_change, each) for each in played] == list(range(n))


def test_the_rules_of_a_key_never_change() -> None:
    rules = Rules(
        "0123456789abcdef" * 2, box([(-1.0, 1.0)] * 3 + [(-np.inf, np.inf)] * 2), {"type": "Discrete", "n": 4}
    )
    assert rules.kinds == KINDS
    assert rules.observe(np.array([0.1, 0.2, 0.3, 4.0, 5.0])).tolist() == SHOWN
    assert [rules.act(each) for each in range(4)] == PLAYED


@pytest.mark.parametrize("env", ["gym/acrobot", "gymnasium/FetchPush-v4"])
def test_a_policy_that_knows_the_rules_scores_as_in_the_unchanged_environment(env: str) -> None:
    folder = POLICIES / env.replace("/", "_")
    spec = importlib.util.spec_from_file_location("policy", folder / "policy.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    base, world = environments.make(env), environments.make(f"{env}@w1")
    spaces = base.description.obs_space, base.description.action_space
    exact = [
        key
        for key in (f"{n:032x}" for n in range(32))
        if PARAMETERS not in Rules(key, *spaces, base.parameters).kinds
    ]
    meta = {"max_episode_steps": base.description.max_episode_steps}
    returns: dict[str, float] = {}
    for key in ("", *exact[:2]):
        played, rules = (world, Rules(key, *spaces, base.parameters)) if key else (base, None)
        policy = module.Policy(*spaces, meta)
        policy.reset(0)
        obs = played.reset(Case(seed=7, options={"world": key} if key else None))
        total, ended = 0.0, False
        while not ended:
            action = policy.act(obs if rules is None else undone(rules.obs_change, obs))
            repaired, _ = base.action_codec.repair(action)
            step = played.step(repaired if rules is None else undone(rules.action_change, repaired))
            obs, total, ended = step.obs, total + step.reward, step.terminated or step.truncated
        returns[key] = total
    assert len(set(returns.values())) == 1, returns
    base.close()
    world.close()


@pytest.mark.parametrize("env", catalogue.suites()["core16"].environments)
def test_every_world_of_core16_alters_something_and_tells_no_value(env: str) -> None:
    world = environments.make(f"{env}@w2")
    base = environments.make(env)
    assert isinstance(world, World)
    described, usual = world.description, base.description
    possible = kinds(usual.obs_space, usual.action_space, base.parameters)
    assert possible
    assert (described.obs_space, described.action_space) == (usual.obs_space, usual.action_space)
    assert described.task_text == usual.task_text.rstrip() + text(possible, base.parameters) + "\n"
    assert described.digest() != usual.digest()
    first = world.reset(Case(seed=3, options={"world": "c" * 32}))
    again = world.reset(Case(seed=3, options={"world": "c" * 32}))
    np.testing.assert_equal(first, again)
    world.close()
    base.close()


@pytest.mark.parametrize("key", ["", "A" * 32, "0" * 31, 7, None, ["0" * 32]])
def test_a_case_with_a_wrong_key_is_refused_without_the_key(key: Any) -> None:
    world = environments.make("gym/acrobot@w1")
    with pytest.raises(WorkerError, match="32 hexadecimal digits") as refused:
        world.reset(Case(seed=1, options={"world": key}))
    assert str(key) not in str(refused.value) or not key
    world.close()


def test_a_description_is_made_with_the_public_key() -> None:
    world = environments.make("gym/acrobot@w1")
    np.testing.assert_equal(world.reset(Case(seed=1)), world.reset(Case(seed=1, options={"world": PUBLIC})))
    assert set(TEXTS) >= set(kinds(world.description.obs_space, world.description.action_space))
    world.close()


SIMULATED = (
    "gym/acrobot",
    "gym/continuouscar",
    "gym/reacher5",
    "gym/halfcheetah5",
    "gym/ant5",
    "gym/pusher5",
)


def key_with(world: World, parameters: bool, first: int = 0) -> str:
    """The first key of a few whose rules alter the simulator's parameters, or do not."""
    described = world.description
    given = (described.obs_space, described.action_space, tuple(described.definition["parameters"]))
    keys = (f"{each:032x}" for each in range(first, first + 64))
    return next(key for key in keys if (PARAMETERS in Rules(key, *given).kinds) == parameters)


def episode(world: World, key: str, steps: int = 25) -> list[Any]:
    rng = np.random.default_rng(0)
    found = [world.reset(Case(seed=5, options={"world": key})).tolist()]
    for _ in range(steps):
        step = world.step(world.action_codec.sample(rng))
        found.append((step.obs.tolist(), step.reward))
        if step.terminated or step.truncated:
            break
    return found


@pytest.mark.parametrize("env", SIMULATED)
def test_parameters_change_the_episode_and_leave_none_behind(env: str) -> None:
    reused, fresh = environments.make(f"{env}@w1"), environments.make(f"{env}@w1")
    assert isinstance(reused, World)
    assert isinstance(fresh, World)
    altered, other, usual = key_with(reused, True), key_with(reused, True, 64), key_with(reused, False)
    first = episode(fresh, altered)
    assert episode(reused, usual) == episode(environments.make(f"{env}@w1"), usual)
    assert episode(reused, other) != first
    assert episode(reused, altered) == first == episode(reused, altered)
    assert episode(reused, usual) == episode(environments.make(f"{env}@w1"), usual)
    reused.close()
    fresh.close()


@pytest.mark.parametrize("env", SIMULATED)
def test_factors_reach_the_simulator_without_accelerations(env: str) -> None:
    base = environments.make(env, accelerations=True)
    assert isinstance(base, GymnasiumEnvironment)
    family, used = base._family, base.accelerations

    def quantities() -> dict[str, list[Any]]:
        found = family.parameters(base.bare)
        return {name: [np.array(getattr(*each), float) for each in some] for name, some in found.items()}

    usual = quantities()
    assert tuple(sorted(usual)) == base.parameters
    factors = {name: 1.25 + i / 4 for i, name in enumerate(base.parameters)}
    base.alter(factors)
    assert base.accelerations == ()
    for name, values in quantities().items():
        for now, before in zip(values, usual[name], strict=True):
            np.testing.assert_allclose(now, before * factors[name], rtol=1e-12)
    base.alter({})
    assert base.accelerations == used
    for name, values in quantities().items():
        for now, before in zip(values, usual[name], strict=True):
            np.testing.assert_array_equal(now, before)
    base.close()


def test_the_definition_covers_the_ranges_and_names_no_factor() -> None:
    world = environments.make("gym/halfcheetah5@w1")
    described = world.description
    assert set(described.definition["parameters"]) == {
        "gravity",
        "mass of the bodies",
        "damping of the joints",
        "strength of the motors",
        "friction of the surfaces",
    }
    assert {tuple(each) for each in described.definition["parameters"].values()} == {
        (min(FACTORS), max(FACTORS))
    }
    assert all(name in described.task_text for name in described.definition["parameters"])
    other = msgspec.structs.replace(described, definition={**described.definition, "parameters": {}})
    assert other.digest() != described.digest()
    assert not any(f"{factor:.2f}" in described.task_text for factor in FACTORS)
    world.close()
