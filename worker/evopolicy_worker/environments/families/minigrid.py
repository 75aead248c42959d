"""MiniGrid and BabyAI: grid worlds seen through a 7 × 7 egocentric window."""

from __future__ import annotations

import string
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily

if TYPE_CHECKING:
    import gymnasium

_MISSION_CHARACTERS = 512


class MiniGridFamily(GymnasiumFamily):
    distributions = ("minigrid",)
    modules = ("gymnasium", "minigrid")

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        """As others; the mission space of BabyAI allows none of its own missions, so it is declared anew."""
        env = super().make(entry, render=render)
        if str(entry.gymnasium_id).startswith("BabyAI-"):
            from gymnasium import spaces

            space: Any = env.unwrapped.observation_space
            characters = string.ascii_letters + string.digits + string.punctuation + " "
            space.spaces["mission"] = spaces.Text(_MISSION_CHARACTERS, charset=characters)
        return env

    def task_sections(self, entry: Entry, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
        grid: Any = env.unwrapped
        return {
            "Start": f"The grid is {grid.width} × {grid.height} cells, with walls around it that are part of it."
        }


FAMILY = MiniGridFamily()
