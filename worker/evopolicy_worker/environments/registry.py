"""Which environments this installation offers, and how each is made from its suite id.

An adapter is a module of this package, named by the environment's definition and imported when one of its environments is asked
for; adapters import no simulator before `make`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import cast

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import ConfigError, WorkerError
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_worker.environments import settings
from evopolicy_worker.environments.base import Environment
from evopolicy_worker.environments.foreign import ForeignFamily
from evopolicy_worker.environments.gymnasium_adapter import GymnasiumEnvironment, GymnasiumFamily, quiet

_defined: dict[str, Entry] = {}


def define(definitions: Iterable[Entry]) -> None:
    """Environments that do not ship, which this process knows from now on."""
    _defined.update((each.id, each) for each in definitions)


def definition(env_id: str) -> list[str]:
    """The definition of an environment that does not ship, as an argument for another process; none for one that does."""
    found = _defined.get(env_id)
    return [] if found is None else [msgspec.json.encode(found).decode()]


def make(env_id: str, *, render: bool = False, accelerations: bool | None = None) -> Environment:
    """A new environment, ready for its first `reset`. The first of a family imports its simulator.

    `accelerations`: faster ways to the same episode; None is what the process environment says, on by default.
    ConfigError for an id that is not known here; WorkerError for one whose packages are not installed.
    """
    found = _entry(env_id)
    if found.adapter == "toy":
        from evopolicy_worker.environments import toy

        return toy.make(found, render=render)
    family = _family(found)
    if not family.installed():
        raise WorkerError(f"{env_id} needs {family.needs()}")
    if accelerations is None:
        accelerations = settings.accelerations_on()
    return GymnasiumEnvironment(found, family, render=render, accelerations=accelerations)


def load(env_id: str) -> None:
    """Import what an environment is made with, where it is installed; processes forked afterwards have it already."""
    found = _entry(env_id)
    if found.adapter != "toy" and (family := _family(found)).installed():
        settings.apply()
        with quiet():
            family.load()


def describe(env_id: str) -> EnvironmentDescription:
    """What is told of an environment. Makes one, so it imports the simulator; of one that does not ship it plays a few steps,
    to see that it keeps its word. Raises as `make`.
    """
    environment = make(env_id)
    try:
        if not catalogue.is_shipped(env_id) and isinstance(environment, GymnasiumEnvironment):
            environment.try_out()
        return environment.description
    finally:
        environment.close()


def offered() -> list[str]:
    """Suite ids of shipped environments that this installation can play, in catalogue order; no simulator is imported to find
    out."""
    return [found.id for found in catalogue.entries().values() if offers(found.id)]


def offers(env_id: str) -> bool:
    """Whether this installation has the packages of an environment."""
    return not missing(env_id)


def missing(env_id: str) -> str:
    """What is to be installed for an environment to be played here; empty for nothing."""
    try:
        found = _entry(env_id)
    except ConfigError as error:
        return str(error)
    if found.adapter == "toy":
        return ""
    family = _family(found)
    return "" if family.installed() else family.needs()


def _entry(env_id: str) -> Entry:
    found = _defined.get(env_id) or catalogue.known(env_id)
    if found is None:
        raise ConfigError(
            f"no environment {env_id!r} here{catalogue.near(env_id)}; name its file, or install the package that ships it"
        )
    return found


def _family(found: Entry) -> GymnasiumFamily:
    if found.adapter == "foreign":
        return ForeignFamily(found.gymnasium_id or "")
    return cast(
        GymnasiumFamily, importlib.import_module(f"evopolicy_worker.environments.{found.adapter}").FAMILY
    )
