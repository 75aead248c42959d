"""MetaWorld: fifty tasks of one robot arm on a table, and suites of ten and of fifty of them.

Their `reset` ignores a seed, and to make one through Gymnasium takes a second. Each task's class is therefore made
once, and draws its objects and its goal from the case's seed, over the task's whole range. In MT10 and MT50 the seed
also chooses the task, which the observation names.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.families.mujoco import MujocoFamily, check_rendering
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted
from evopolicy_worker.environments.tasks import template

_CAMERA = "corner"
_SIDE = 320
"""Height and width of a frame, pixels."""
_GOAL = slice(36, 39)
"""Indices of the goal in an observation."""


class MetaWorldFamily(MujocoFamily):
    distributions = ("metaworld", "mujoco")
    also = ("scipy",)
    modules = ("gymnasium", "mujoco", "metaworld")
    extra = "metaworld"

    def make(self, entry: Entry, *, render: bool) -> Any:
        check_rendering(entry, render=render)
        return _Tasks(_names(entry), render=render)

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        tasks = template.load("metaworld_tasks.toml")
        names = _names(entry)
        if len(names) == 1:
            return {"": tasks[names[0]]}
        rows = ((f"`{39 + k}`", name, tasks[name]) for k, name in enumerate(names))
        head = (
            f"Each episode is one of {len(names)} tasks: the number of the observation that is 1 tells which, the"
            " others are 0."
        )
        return {"": f"{head}\n\n{template.table(('component', 'task', 'what is to be done'), rows)}"}


def _names(entry: Entry) -> list[str]:
    """The tasks of an environment: the one it names, or those of its suite."""
    if "env_name" in entry.kwargs:
        return [str(entry.kwargs["env_name"])]
    from metaworld import env_dict

    return list(env_dict.MT10_V3 if str(entry.gymnasium_id).endswith("MT10") else env_dict.MT50_V3)


class _Tasks(Adapted):
    """One or several tasks as one environment.

    The task of the episode before is kept, any other one is made anew: fifty models at once take gigabytes.
    """

    def __init__(self, names: list[str], *, render: bool) -> None:
        import gymnasium

        self._names = names
        self._render = render
        self._index = 0
        self.raw = _task(names[0], render=render)
        self.action_space = self.raw.action_space
        space = self.raw.sawyer_observation_space
        low, high = space.low.copy(), space.high.copy()
        if len(names) > 1:
            # The goals of other tasks lie elsewhere.
            low[_GOAL], high[_GOAL] = -np.inf, np.inf
            low, high = (np.concatenate([each, np.full(len(names), k)]) for k, each in enumerate((low, high)))
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float64)

    def reset(self, *, seed: int, options: Any = None) -> tuple[Any, dict[str, Any]]:
        index = int(np.random.default_rng(seed).integers(len(self._names))) if len(self._names) > 1 else 0
        if index != self._index:
            self.raw.close()
            self._index, self.raw = index, _task(self._names[index], render=self._render)
        self.raw.seed(seed)
        obs, info = self.raw.reset()
        return self._named(obs), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.raw.step(action)
        return self._named(obs), reward, terminated, truncated, info

    def render(self) -> Any:
        # The camera hangs upside down.
        return np.rot90(super().render(), 2)

    def _named(self, obs: Any) -> Any:
        if len(self._names) == 1:
            return obs
        return np.concatenate([obs, np.arange(len(self._names)) == self._index])


def _task(name: str, *, render: bool) -> Any:
    """A task that draws its start from its own generator, with the goal in its observations."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    mode = {"render_mode": "rgb_array", "camera_name": _CAMERA, "width": _SIDE, "height": _SIDE}
    task = ALL_V3_ENVIRONMENTS[name](**(mode if render else {}))
    # Without a graphics card, shadows take most of a frame's time.
    task.model.vis.quality.shadowsize = 0
    task._freeze_rand_vec = False
    task.seeded_rand_vec = True
    task._set_task_called = True
    task._partially_observable = False
    task.__dict__.pop("sawyer_observation_space", None)
    return task


FAMILY = MetaWorldFamily()
