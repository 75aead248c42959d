"""highway-env: parking and roundabout."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evopolicy_worker.environments.gymnasium_adapter import GymnasiumFamily
from evopolicy_worker.environments.info import plain_info


class HighwayFamily(GymnasiumFamily):
    """Traffic, and a car to be parked."""

    distributions = ("highway-env",)
    modules = ("gymnasium", "highway_env")
    components = {
        "roundabout-v0": ("collision_reward", "high_speed_reward", "lane_change_reward", "on_road_reward"),
    }

    def info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        """The nested `rewards` (unweighted, some of them bools) become numbers under their own names."""
        plain = plain_info(info)
        plain.update({name: float(value) for name, value in plain.pop("rewards", {}).items()})
        return plain


FAMILY = HighwayFamily()
