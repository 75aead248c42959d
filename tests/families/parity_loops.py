"""Bare loops, as each library's documentation has them, beside episodes of this software. Two programs for two
processes, so that nothing of ours is loaded where a library is played: `python parity_loops.py ours FAMILY FILE` plays
a sample and writes it with its actions; `python parity_loops.py bare FILE [ID…]` plays the same actions again, and
prints one JSON object, id to the first difference."""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import pickle
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

TABLE = tomllib.loads((Path(__file__).parent / "parity.toml").read_text("utf-8"))
Given = dict[str, Any]
"""What a bare loop is told of an episode: `id`, `kwargs`, `seed`, `actions`, `family`, `modules`."""
Played = Iterator[tuple[Any, Any, bool, bool]]
"""Observation, reward, terminated, truncated; the first with reward None."""


def drawn(family: str, ids: list[str]) -> list[str]:
    """A tenth of a family's ids, two at least, drawn by its name, and those that are known to differ."""
    named = [each for each in ids if each in TABLE["differs"]]
    by_hash = sorted(ids, key=lambda each: hashlib.sha256(f"parity {family} {each}".encode()).digest())
    return list(dict.fromkeys([*by_hash[: max(2, math.ceil(len(ids) / 10))], *named]))


def ours(family: str) -> list[dict[str, Any]]:
    """An episode of each environment of the sample: what a bare loop is told, and what was seen."""
    from evopolicy_common import catalogue
    from evopolicy_common.catalogue import installs
    from evopolicy_common.messages.environment import Case
    from evopolicy_worker.environments import make

    found = []
    row = TABLE["family"].get(family, {})
    for env_id in drawn(family, list(catalogue.suites()[family].environments)):
        entry, environment = catalogue.entry(env_id), make(env_id)
        seed = int.from_bytes(hashlib.sha256(f"parity {env_id}".encode()).digest()[:4], "big") >> 1
        rng, actions, seen = (
            np.random.default_rng(seed),
            [],
            [(environment.reset(Case(seed=seed)), None, False, False)],
        )
        for _ in range(row.get("steps", 200)):
            actions.append(environment.action_codec.sample(rng))
            step = environment.step(actions[-1])
            seen.append((step.obs, step.reward, step.terminated, step.truncated))
            if step.terminated or step.truncated:
                break
        weights = list(environment.description.reward_weights.values())
        environment.close()
        told = {
            "id": entry.gymnasium_id,
            "kwargs": entry.kwargs,
            "seed": seed,
            "actions": actions,
            "family": family,
            "modules": row.get("modules", installs.installs()[installs.family_of(env_id)].modules),
        }
        found.append({"env": env_id, "told": told, "seen": seen, "weights": weights})
    return found


def gymnasium_loop(told: Given) -> Played:
    import gymnasium

    for name in told["modules"]:
        gymnasium.register_envs(importlib.import_module(name))
    env = gymnasium.make(told["id"], **told["kwargs"])
    yield env.reset(seed=told["seed"])[0], None, False, False
    for action in told["actions"]:
        obs, reward, terminated, truncated, _ = env.step(action)
        yield obs, reward, terminated, truncated
    env.close()


def nle_loop(told: Given) -> Played:
    """NLE seeds the game's two generators by a method of its own, before `reset`. Its third argument keeps the game
    from seeding itself again in the middle, and `fix_moon_phase` from looking at the clock."""
    import gymnasium
    import minihack  # noqa: F401
    import nle  # noqa: F401

    env = gymnasium.make(told["id"], fix_moon_phase=True, **told["kwargs"])
    env.unwrapped.seed(told["seed"] + 1, told["seed"] + 1, False)  # type: ignore[attr-defined]
    yield env.reset()[0], None, False, False
    for action in told["actions"]:
        obs, reward, terminated, truncated, _ = env.step(action)
        yield obs, reward, terminated, truncated


def dm_control_loop(told: Given) -> Played:
    from dm_control import suite

    domain, task, _ = told["id"].partition("/")[2].split("-")
    env = suite.load(domain, task, task_kwargs={"random": told["seed"]})
    yield env.reset().observation, None, False, False
    for action in told["actions"]:
        at = env.step(action)
        yield at.observation, at.reward, at.last() and at.discount == 0, at.last() and at.discount != 0


def crafter_loop(told: Given) -> Played:
    import crafter

    env = crafter.Env(seed=told["seed"])
    yield env.reset(), None, False, False
    for action in told["actions"]:
        obs, reward, _, info = env.step(action)
        yield obs, reward, not info["discount"], False


def retro_loop(told: Given) -> Played:
    import stable_retro

    env = stable_retro.make(told["id"])
    yield env.reset(seed=told["seed"])[0], None, False, False
    for action in told["actions"]:
        obs, reward, terminated, truncated, _ = env.step(action)
        yield obs, reward, terminated, truncated


def metaworld_loop(told: Given) -> Played:
    """A task's class with random starts of its own generator, and the goal in its observations."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    env = ALL_V3_ENVIRONMENTS[told["kwargs"]["env_name"]]()
    env._freeze_rand_vec, env.seeded_rand_vec, env._set_task_called = False, True, True
    env._partially_observable = False
    # It was computed with a hidden goal, and observations are cut to it.
    del env.sawyer_observation_space
    env.seed(told["seed"])
    yield env.reset()[0], None, False, False
    for action in told["actions"]:
        obs, reward, terminated, truncated, _ = env.step(action)
        yield obs, reward, terminated, truncated


LOOPS: dict[str, Callable[[Given], Played]] = {
    "gymnasium": gymnasium_loop,
    "nle": nle_loop,
    "dm_control": dm_control_loop,
    "crafter": crafter_loop,
    "retro": retro_loop,
    "metaworld": metaworld_loop,
}


def difference(one: Any, other: Any, where: str = "observation") -> str:
    """Where two values differ, dtypes included; empty where they do not."""
    if isinstance(one, dict):
        if one.keys() != set(other.keys()):
            return f"{where}: keys {sorted(one)} beside {sorted(other)}"
        return next(filter(None, (difference(one[key], other[key], f"{where}.{key}") for key in one)), "")
    if isinstance(one, (tuple, list)):
        if len(one) != len(other):
            return f"{where}: {len(one)} parts beside {len(other)}"
        return next(
            filter(
                None,
                (difference(a, b, f"{where}[{k}]") for k, (a, b) in enumerate(zip(one, other, strict=True))),
            ),
            "",
        )
    if isinstance(one, np.ndarray):
        bare = np.asarray(other)
        if one.dtype != bare.dtype or one.shape != bare.shape:
            return f"{where}: {one.dtype} {one.shape} beside {bare.dtype} {bare.shape}"
        same = np.array_equal(one, bare, equal_nan=one.dtype.kind == "f")
        return "" if same else f"{where}: {int(np.sum(one != bare))} of {one.size} numbers"
    return "" if one == other else f"{where}: {one!r} beside {other!r}"


def compared(played: dict[str, Any], loop: Callable[[Given], Played]) -> str:
    """The first difference between an episode of ours and a bare loop's with the same actions."""
    for k, (mine, bare) in enumerate(zip(played["seen"], loop(played["told"]), strict=True)):
        obs, reward, *ended = bare
        if reward is not None and played["weights"]:
            reward = sum(w * float(part) for w, part in zip(played["weights"], reward, strict=True))
        found = difference(mine[0], obs) or difference(
            mine[1], None if reward is None else float(reward), "reward"
        )
        found = found or difference(list(mine[2:]), [bool(each) for each in ended], "ends")
        if found:
            return f"step {k}, {found}"
    return ""


def main(mode: str, *rest: str) -> None:
    if mode == "ours":
        family, file = rest
        Path(file).write_bytes(pickle.dumps(ours(family)))
        return
    found = {}
    file, *alone = rest
    for played in pickle.loads(Path(file).read_bytes()):
        if alone and played["env"] not in alone:
            continue
        row = TABLE["family"].get(played["told"]["family"], {})
        found[played["env"]] = compared(played, LOOPS[row.get("loop", "gymnasium")])
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
