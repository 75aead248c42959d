"""highway-env: parking, roundabouts, motorways and crossings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.accelerations import ACCELERATIONS
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily
from evopolicy_worker.environments.interface.info import plain_info
from evopolicy_worker.environments.tasks import highway

if TYPE_CHECKING:
    import gymnasium


_TRAFFIC = {"DISTANCE_WANTED": 10.0, "COMFORT_ACC_MAX": 3.0, "COMFORT_ACC_MIN": -5.0}
"""The library's own values of what an intersection sets for all."""


class HighwayFamily(GymnasiumFamily):
    distributions = ("highway-env",)
    also = ("pandas", "pygame-ce")
    modules = ("gymnasium", "highway_env")
    solved_by = {"parking-v0": "is_success"}

    def rebuilds(self, entry: Entry) -> bool:
        # Those that are accelerated have been seen to repeat.
        return not any(each.serves(str(entry.gymnasium_id)) for each in ACCELERATIONS)

    def begin(self) -> None:
        """An intersection changes how the traffic of all later environments of the process drives."""
        from highway_env.vehicle.behavior import IDMVehicle

        for name, value in _TRAFFIC.items():
            setattr(IDMVehicle, name, value)

    def info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        """The nested `rewards` (unweighted, some of them bools) become numbers."""
        plain = plain_info(info)
        if "rewards" in plain:
            plain["rewards"] = {name: float(value) for name, value in plain["rewards"].items()}
        return plain

    def task_sections(self, entry: Entry, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
        return highway.task_sections(env.unwrapped)


FAMILY = HighwayFamily()
