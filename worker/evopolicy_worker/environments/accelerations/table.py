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
    gymnasium_ids: tuple[str, ...]
    distributions: tuple[str, ...]
    """Distributions whose installed versions must be in `PROVED`."""
    checks: bool = False
    """Whether its module checks this machine, in `holds`."""

    def serves(self, gymnasium_id: str) -> bool:
        return gymnasium_id in self.gymnasium_ids

    def module(self) -> Any:
        return importlib.import_module(f"{__package__}.{self.name}")

    def fault(self) -> tuple[str, dict[str, str]]:
        """Why it may not be used here, and the installed versions that are not proved; an empty text when it may."""
        installed = {name: _version(name) for name in self.distributions}
        unproved = {name: own for name, own in installed.items() if own not in PROVED[name]}
        if unproved:
            return "not proved with the installed version", unproved
        return "" if not self.checks or self.module().holds() else "not exact on this machine", {}


_MINIGRID = "DoorKey-16x16-v0 FourRooms-v0 KeyCorridorS4R3-v0 ObstructedMaze-1Q-v1"
_HIGHWAY = """
    exit-v0 exit-v1 highway-fast-v0 highway-v0 intersection-multi-agent-v0 intersection-v0 intersection-v1
    intersection-v2 merge-generic-v0 merge-generic-v1 merge-v0 merge-v1 parking-ActionRepeat-v0 parking-parked-v0
    parking-v0 racetrack-large-v0 racetrack-large-v1 racetrack-oval-v0 racetrack-oval-v1 racetrack-v0 racetrack-v1
    roundabout-generic-v0 roundabout-generic-v1 roundabout-v0 roundabout-v1 two-way-v0 u-turn-v0 u-turn-v1
"""
"""All of the family but `lane-keeping-v0`; 128 seeds of each were compared."""


def _road(name: str, *distributions: str) -> Acceleration:
    return Acceleration(f"highway_{name}", tuple(_HIGHWAY.split()), ("highway-env", *distributions))


ACCELERATIONS: tuple[Acceleration, ...] = (
    Acceleration("acrobot_scalars", ("Acrobot-v1",), ("gymnasium", "numpy"), checks=True),
    Acceleration(
        "mujoco_state", ("HalfCheetah-v5", "Pusher-v5", "Reacher-v5"), ("gymnasium", "mujoco", "numpy")
    ),
    Acceleration("car_racing_road", ("CarRacing-v3",), ("gymnasium", "pygame-ce")),
    Acceleration("car_racing_frame", ("CarRacing-v3",), ("gymnasium", "pygame-ce"), checks=True),
    Acceleration("minigrid_view", tuple(f"MiniGrid-{name}" for name in _MINIGRID.split()), ("minigrid",)),
    _road("lanes", "numpy"),
    _road("closest_lane"),
    _road("collisions"),
    _road("vehicles", "numpy"),
    _road("observations", "numpy"),
)
"""In order of application."""


def accelerate(gymnasium_id: str, env: Any) -> list[str]:
    """Applies all usable accelerations that serve this environment to a bare one. Returns their names, in order."""
    applied = [one for one in ACCELERATIONS if one.serves(gymnasium_id) and usable(one)]
    for acceleration in applied:
        acceleration.module().accelerate(env)
    return [one.name for one in applied]


def off() -> dict[str, str]:
    """Why accelerations of installed libraries are not in use here, by their names. Imports simulators."""
    reasons = {}
    for one in ACCELERATIONS:
        why, unproved = one.fault()
        if why and "none" not in unproved.values():
            versions = (f"{name} {own}, proved: {', '.join(PROVED[name])}" for name, own in unproved.items())
            reasons[one.name] = "; ".join(versions) or why
    return reasons


def usable(acceleration: Acceleration) -> bool:
    """Whether the installed versions are proved ones, and the module's own check of this machine passes. Logs a
    warning, once per acceleration, when not."""
    why, unproved = acceleration.fault()
    if why and acceleration.name not in _reported:
        _reported.add(acceleration.name)
        # Imported late: every slot's process imports this module, and structlog would be a fifth of its imports.
        from evopolicy_common.logs import structlog

        about = (
            {"installed": unproved, "proved": {name: PROVED[name] for name in unproved}} if unproved else {}
        )
        structlog.get_logger(__name__).warning(
            f"acceleration is off: {why}", acceleration=acceleration.name, **about
        )
    return not why


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "none"
