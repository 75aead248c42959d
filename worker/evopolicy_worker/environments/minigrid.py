"""MiniGrid: grid worlds seen through a 7 × 7 egocentric window."""

from __future__ import annotations

from evopolicy_worker.environments.gymnasium_adapter import GymnasiumFamily


class MiniGridFamily(GymnasiumFamily):
    """Doors, keys and rooms."""

    distributions = ("minigrid",)
    modules = ("gymnasium", "minigrid")


FAMILY = MiniGridFamily()
