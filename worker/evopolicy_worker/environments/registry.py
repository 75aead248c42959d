"""Which environments this installation offers, and how each is made from its suite id.

A family is a module of this package, found by a pattern over suite ids and imported when one of its environments is
asked for; family modules import no simulator before `make`.
"""

from __future__ import annotations

import fnmatch
import importlib
from typing import cast

from evopolicy_common.catalogue import Entry, entries, entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_worker.environments import settings
from evopolicy_worker.environments.base import Environment
from evopolicy_worker.environments.gymnasium_adapter import GymnasiumEnvironment, GymnasiumFamily

_FAMILIES: tuple[tuple[str, str], ...] = (
    ("toy/*", "toy"),
    ("gym/acrobot", "classic"),
    ("gym/continuouscar", "classic"),
    ("gym/bipedal", "box2d"),
    ("gym/racing", "box2d"),
    ("gym/*5", "mujoco"),
    ("gymnasium/MiniGrid-*", "minigrid"),
    ("gymnasium/parking-*", "highway"),
    ("gymnasium/roundabout-*", "highway"),
    ("gymnasium/Fetch*", "robotics"),
)
"""Pattern over suite ids, and the family's module; the first that matches counts."""


def make(env_id: str, *, render: bool = False, accelerations: bool | None = None) -> Environment:
    """A new environment, ready for its first `reset`. The first of a family imports its simulator.

    `accelerations`: faster ways to the same episode; None is what the process environment says, on by default.
    ConfigError for an id that the catalogue does not have; WorkerError for one whose packages are not installed.
    """
    found = entry(env_id)
    module = _module(found)
    if module == "toy":
        from evopolicy_worker.environments import toy

        return toy.make(found, render=render)
    family = _family(module)
    if not family.installed():
        raise WorkerError(
            f"{env_id} needs {' and '.join(family.distributions)}: install the extra `evopolicy[worker]`"
        )
    if accelerations is None:
        accelerations = settings.accelerations_on()
    return GymnasiumEnvironment(found, family, render=render, accelerations=accelerations)


def describe(env_id: str) -> EnvironmentDescription:
    """What is told of an environment. Makes one, so it imports the simulator. Raises as `make`."""
    environment = make(env_id)
    try:
        return environment.description
    finally:
        environment.close()


def offered() -> list[str]:
    """Suite ids that this installation can play, in catalogue order; no simulator is imported to find out."""
    return [found.id for found in entries().values() if _offers(found)]


def _offers(found: Entry) -> bool:
    try:
        module = _module(found)
    except WorkerError:
        return False
    return module == "toy" or _family(module).installed()


def _module(found: Entry) -> str:
    for pattern, module in _FAMILIES:
        if fnmatch.fnmatchcase(found.id, pattern):
            return module
    raise WorkerError(f"no adapter for {found.id}: add its family to the worker's environments")


def _family(module: str) -> GymnasiumFamily:
    return cast(GymnasiumFamily, importlib.import_module(f"evopolicy_worker.environments.{module}").FAMILY)
