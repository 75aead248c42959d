"""MO-Gymnasium: environments whose rewards are vectors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.families.mujoco import MujocoFamily
from evopolicy_worker.environments.interface import rewards
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted
from evopolicy_worker.environments.tasks import highway, template


class MoGymnasiumFamily(MujocoFamily):
    distributions = ("mo-gymnasium",)
    also = ("mujoco", "box2d", "highway-env", "pygame", "scipy", "imageio")
    modules = ("gymnasium", "mo_gymnasium")
    extra = "mo-gymnasium"

    def rebuilds(self, entry: Entry) -> bool:
        # Made from Box2D, MuJoCo, highway-env and others, of which some do not repeat.
        return True

    def make(self, entry: Entry, *, render: bool) -> Any:
        """As others. A minecart's mines are drawn while it is made, and its ore in each step, from numpy's global
        generator: it is made for each episode with that generator seeded."""

        usual = partial(super().make, entry, render=render)
        return _MadeFromSeed(usual) if str(entry.gymnasium_id).startswith("minecart") else usual()

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        scalarisation = rewards.Scalarisation.of(entry, env)
        assert scalarisation is not None
        sections = highway.task_sections(env.unwrapped) if "highway" in str(entry.gymnasium_id) else {}
        components = scalarisation.texts(entry.reward_components)
        return sections | {"Reward": template.reward_table(components, vector=True)}


class _MadeFromSeed(Adapted):
    """An environment that is made anew by each `reset`, with numpy's global generator seeded."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make
        self.raw = make()
        self.metadata, self.spec = self.raw.metadata, self.raw.spec
        self.observation_space, self.action_space = self.raw.observation_space, self.raw.action_space
        self._max_episode_steps = self.spec.max_episode_steps if self.spec is not None else None

    @property
    def unwrapped(self) -> Any:
        return self.raw.unwrapped

    def reset(self, *, seed: int, options: Any = None) -> Any:
        self.raw.close()
        np.random.seed(seed)
        self.raw = self._make()
        return self.raw.reset(seed=seed, options=options)

    def render(self) -> Any:
        # The first frame turns each mine by a number of the same generator: an episode that is drawn stays the same
        # one.
        state = np.random.get_state()
        try:
            return super().render()
        finally:
            np.random.set_state(state)


FAMILY = MoGymnasiumFamily()
