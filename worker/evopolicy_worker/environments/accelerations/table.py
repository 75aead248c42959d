"""The table of accelerations: the environments that each serves, and the library versions on which they were proved.

This module imports no simulator. It imports an acceleration's own module only when the installed versions fit.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

PROVED: Mapping[str, tuple[str, ...]] = {
    "gymnasium": ("1.4.0",),
    "highway-env": ("1.12.1",),
    "minigrid": ("3.2.0",),
    "mujoco": ("3.10.0",),
    "numpy": ("2.4.6",),
    "pygame-ce": ("2.5.8",),
}
"""Versions for which the exhaustive comparison found no difference, by distribution.

It played 128 seeds of each environment, half with random actions and half with a competent driver: whole
episodes of Acrobot (37,692 steps), HalfCheetah (128,000), Pusher (12,800), Reacher (6,400), MiniGrid (349,956)
and roundabout (991), the first 100 steps of CarRacing, the first 20 of parking, and the first 6 of HighwayEnv's others.
For CarRacing it also played whole episodes of 24 more seeds, and rendered 4,000 pictures of a car at random
positions, angles, speeds and times.
"""


_reported: set[str] = set()
"""Accelerations that a warning was logged about."""


@dataclass(frozen=True)
class Acceleration:
    """One replacement: a module of this package whose `accelerate(env)` changes that bare Gymnasium environment."""

    name: str
    """The module's name."""
    gymnasium_ids: tuple[str, ...]
    distributions: tuple[str, ...]
    """Distributions whose installed versions must be in `PROVED`."""
    checks: bool = False
    """Whether its module checks this machine, in `holds`."""

    def serves(self, gymnasium_id: str) -> bool:
        return gymnasium_id in self.gymnasium_ids

    def holds(self) -> bool:
        """Whether the module's own check of this machine passes, if it has one. Logs a warning once when it does
        not."""
        if not self.checks or self._module().holds():
            return True
        if self.name not in _reported:
            _reported.add(self.name)
            _warn("not exact on this machine", acceleration=self.name)
        return False

    def apply(self, env: Any) -> None:
        self._module().accelerate(env)

    def _module(self) -> Any:
        return importlib.import_module(f"{__package__}.{self.name}")


_MINIGRID = (
    "MiniGrid-DoorKey-16x16-v0",
    "MiniGrid-FourRooms-v0",
    "MiniGrid-KeyCorridorS4R3-v0",
    "MiniGrid-ObstructedMaze-1Q-v1",
)
_HIGHWAY = (
    *(
        f"{name}-v{version}"
        for name in (
            *("exit", "merge", "merge-generic", "racetrack", "racetrack-large", "racetrack-oval"),
            *("roundabout", "roundabout-generic", "u-turn"),
        )
        for version in (0, 1)
    ),
    *("highway-fast-v0", "highway-v0", "intersection-v0", "intersection-v1", "intersection-v2"),
    *(
        "intersection-multi-agent-v0",
        "parking-ActionRepeat-v0",
        "parking-parked-v0",
        "parking-v0",
        "two-way-v0",
    ),
)
"""All of the family but `lane-keeping-v0`; 128 seeds of each were compared."""

_MUJOCO = ("HalfCheetah-v5", "Pusher-v5", "Reacher-v5")

ACCELERATIONS: tuple[Acceleration, ...] = (
    Acceleration("acrobot_scalars", ("Acrobot-v1",), ("gymnasium", "numpy"), checks=True),
    Acceleration("mujoco_state", _MUJOCO, ("gymnasium", "mujoco", "numpy")),
    Acceleration("car_racing_road", ("CarRacing-v3",), ("gymnasium", "pygame-ce")),
    Acceleration("car_racing_frame", ("CarRacing-v3",), ("gymnasium", "pygame-ce"), checks=True),
    Acceleration("minigrid_view", _MINIGRID, ("minigrid",)),
    Acceleration("highway_lanes", _HIGHWAY, ("highway-env", "numpy")),
    Acceleration("highway_closest_lane", _HIGHWAY, ("highway-env",)),
    Acceleration("highway_collisions", _HIGHWAY, ("highway-env",)),
    Acceleration("highway_vehicles", _HIGHWAY, ("highway-env", "numpy")),
    Acceleration("highway_observations", _HIGHWAY, ("highway-env", "numpy")),
)
"""In order of application."""


def accelerate(gymnasium_id: str, env: Any) -> list[str]:
    """Applies all usable accelerations that serve this environment to a bare one. Returns their names, in order."""
    applied = []
    for acceleration in ACCELERATIONS:
        if acceleration.serves(gymnasium_id) and usable(acceleration) and acceleration.holds():
            acceleration.apply(env)
            applied.append(acceleration.name)
    return applied


def off() -> dict[str, str]:
    """Why accelerations of installed libraries are not in use here, by their names. Imports simulators."""
    found = {}
    for one in ACCELERATIONS:
        unproved = _unproved(one)
        if unproved and "none" not in unproved.values():
            proved = (f"{name} {own}, proved: {', '.join(PROVED[name])}" for name, own in unproved.items())
            found[one.name] = "; ".join(proved)
        elif not unproved and not one.holds():
            found[one.name] = "not exact on this machine"
    return found


def _unproved(acceleration: Acceleration) -> dict[str, str]:
    installed = {name: _version(name) for name in acceleration.distributions}
    return {name: found for name, found in installed.items() if found not in PROVED[name]}


def usable(acceleration: Acceleration) -> bool:
    """Whether the installed versions are proved ones. Logs a warning, once per acceleration, when they are not."""
    unproved = _unproved(acceleration)
    if unproved and acceleration.name not in _reported:
        _reported.add(acceleration.name)
        _warn(
            "not proved with the installed version",
            acceleration=acceleration.name,
            installed=unproved,
            proved={name: PROVED[name] for name in unproved},
        )
    return not unproved


def _warn(why: str, **about: Any) -> None:
    # Imported late: every slot's process imports this module, and structlog would be a fifth of its imports.
    from evopolicy_common.logs import structlog

    structlog.get_logger(__name__).warning(f"acceleration is off: {why}", **about)


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "none"
