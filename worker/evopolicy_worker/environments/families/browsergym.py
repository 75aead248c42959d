"""MiniWoB++ as BrowserGym plays it: the same pages with BrowserGym's observations, actions and reward."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from evopolicy_worker.environments.families.miniwob import MiniWoBFamily
from evopolicy_worker.environments.interface.actions import ActionCodec

if TYPE_CHECKING:
    from evopolicy_worker.environments.browser.page_env import PageEnv


class BrowserGymFamily(MiniWoBFamily):
    """Its pages with BrowserGym's spaces."""

    prefix = "browsergym/miniwob."
    suffix = ""

    def environment(self) -> type[PageEnv]:
        from evopolicy_worker.environments.browser.browsergym_env import BrowserGymEnv

        return BrowserGymEnv

    def draw(self, codec: ActionCodec, rng: np.random.Generator, obs: Any) -> str:
        from evopolicy_worker.environments.browser import draws

        return draws.browsergym(obs, rng)


FAMILY = BrowserGymFamily()
