"""MiniWoB++ as BrowserGym plays it: the same pages with BrowserGym's observations, actions and reward."""

from __future__ import annotations

from typing import Any

import numpy as np

from evopolicy_worker.environments.families.miniwob import MiniWoBFamily
from evopolicy_worker.environments.interface.actions import ActionCodec


class BrowserGymFamily(MiniWoBFamily):
    prefix, suffix = "browsergym/miniwob.", ""
    environment = "browsergym_env:BrowserGymEnv"

    def draw(self, codec: ActionCodec, rng: np.random.Generator, obs: Any) -> str:
        from evopolicy_worker.environments.browser import draws

        return draws.browsergym(obs, rng)


FAMILY = BrowserGymFamily()
