"""A transformed policy undoes a world's rules as the rules themselves do."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evopolicy_common.catalogue import policy_folder
from evopolicy_common.messages.environment import Case
from evopolicy_common.records.policies.bundles import Bundle, snapshot, unpack
from evopolicy_common.worlds.rules import PARAMETERS, Rules
from evopolicy_common.worlds.transformed import transformed, varied
from evopolicy_worker import environments

POLICIES = Path(__file__).parents[3] / "examples" / "policies"
ENVS = ("gym/acrobot", "gym/continuouscar", "gym/reacher5", "gymnasium/MiniGrid-DoorKey-16x16-v0")


def loaded(bundle: Bundle, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The policy class of a bundle."""
    unpack(bundle, folder)
    for name in {each.path.removesuffix(".py") for each in bundle.files}:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(folder))
    return __import__("policy").Policy


@pytest.mark.parametrize("env", ENVS)
def test_a_transformed_policy_earns_what_the_policy_earns(
    env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = snapshot(policy_folder(POLICIES, env))
    base, world = environments.make(env), environments.make(f"{env}@w1")
    spaces = base.description.obs_space, base.description.action_space
    every = ((f"{n:032x}-{n}") for n in range(64))
    keys = [key for key in every if PARAMETERS not in Rules(key, *spaces, base.parameters).kinds][:3]
    returns = []
    for key in ("", *keys):
        played, found = (base, bundle)
        if key:
            played, found = world, transformed(bundle, Rules(key, *spaces, base.parameters))
        policy = loaded(found, tmp_path / (key or "unchanged"), monkeypatch)(
            *spaces, {"env": env, "max_episode_steps": base.description.max_episode_steps}
        )
        policy.reset(0)
        obs = played.reset(Case(seed=7, options={"world": key} if key else None))
        total, ended = 0.0, False
        while not ended:
            step = played.step(played.action_codec.repair(policy.act(obs))[0])
            obs, total, ended = step.obs, total + step.reward, step.terminated or step.truncated
        returns.append(total)
    # An added constant rounds, and a tie may fall the other way.
    np.testing.assert_allclose(returns, returns[0], rtol=0.02)
    base.close()
    world.close()


def test_variants_multiply_constants_and_the_first_is_the_policy_itself() -> None:
    bundle = snapshot(POLICIES / "gym_halfcheetah5")
    assert varied(bundle, 0) == bundle
    assert varied(bundle, 1) == varied(bundle, 1)
    assert len({varied(bundle, n).digest for n in range(4)}) == 4
    scope: dict[str, Any] = {}
    exec(varied(bundle, 1).files[0].data, scope)
    original: dict[str, Any] = {}
    exec(bundle.files[0].data, original)
    ratio = scope["AMPLITUDE"] / original["AMPLITUDE"]
    np.testing.assert_allclose(ratio, ratio[0])
    assert scope["FREQUENCY"] != original["FREQUENCY"] or ratio[0] != 1
