"""Which accelerations there are, of which environments, and the versions of the libraries they were proved on.

This module imports no simulator, and an acceleration's own module is imported only when its versions fit.
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
    "numpy": ("2.4.6",),
    "pygame-ce": ("2.5.8",),
}
"""Versions with which the exhaustive comparison was run and found no difference, by distribution.

That was 128 seeds of each environment, half with random actions and half with a competent driver, whole episodes of
MiniGrid (349,956 steps) and roundabout (991); of parking the first 200 steps (17,618 in all); of CarRacing the first 100 steps of 128 seeds, whole
episodes of 24 more, and 4,000 pictures of a car put anywhere at any angle, speed and moment.
"""


_told: set[str] = set()
"""Accelerations that a warning was given about."""


@dataclass(frozen=True)
class Acceleration:
    """One replacement: a module of this package whose `accelerate(env)` changes that bare Gymnasium environment."""

    name: str
    """The module's name."""
    gymnasium_ids: tuple[str, ...]
    distributions: tuple[str, ...]
    """Whose versions must be among the proved ones."""

    def serves(self, gymnasium_id: str) -> bool:
        return gymnasium_id in self.gymnasium_ids

    def holds(self) -> bool:
        """What the module itself has to check of this machine, if anything; a warning, once, when it does not hold."""
        check = getattr(self._module(), "holds", None)
        if check is None or check():
            return True
        if self.name not in _told:
            _told.add(self.name)
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
_HIGHWAY = ("parking-v0", "roundabout-v0")

ACCELERATIONS: tuple[Acceleration, ...] = (
    Acceleration("car_racing_road", ("CarRacing-v3",), ("gymnasium", "pygame-ce")),
    Acceleration("car_racing_frame", ("CarRacing-v3",), ("gymnasium", "pygame-ce")),
    Acceleration("minigrid_view", _MINIGRID, ("minigrid",)),
    Acceleration("highway_lanes", _HIGHWAY, ("highway-env", "numpy")),
    Acceleration("highway_closest_lane", _HIGHWAY, ("highway-env",)),
    Acceleration("highway_collisions", _HIGHWAY, ("highway-env",)),
    Acceleration("highway_vehicles", _HIGHWAY, ("highway-env", "numpy")),
    Acceleration("highway_observations", _HIGHWAY, ("highway-env", "numpy")),
)
"""In the order of application."""


def accelerate(gymnasium_id: str, env: Any) -> list[str]:
    """Apply to a bare environment all accelerations that serve it and are usable; their names, in order."""
    applied = []
    for acceleration in ACCELERATIONS:
        if acceleration.serves(gymnasium_id) and usable(acceleration) and acceleration.holds():
            acceleration.apply(env)
            applied.append(acceleration.name)
    return applied


def usable(acceleration: Acceleration) -> bool:
    """Whether the installed versions are proved ones; a warning, once per acceleration, when they are not."""
    installed = {name: _version(name) for name in acceleration.distributions}
    unproved = {name: found for name, found in installed.items() if found not in PROVED[name]}
    if unproved and acceleration.name not in _told:
        _told.add(acceleration.name)
        _warn(
            "not proved with the installed version",
            acceleration=acceleration.name,
            installed=unproved,
            proved={name: PROVED[name] for name in unproved},
        )
    return not unproved


def _warn(why: str, **about: Any) -> None:
    # Every slot's process imports this module, and the logger is a fifth of what it would import.
    import structlog

    structlog.get_logger(__name__).warning(f"acceleration is off: {why}", **about)


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "none"
