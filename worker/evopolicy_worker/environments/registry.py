"""The environments that this installation offers; makes them from their suite ids.

An adapter is a module of `families`. The environment's definition names it, and it is imported when one of its
environments is requested. Adapters import no simulator before `make`.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterable

import msgspec
import numpy as np

from evopolicy_common import catalogue
from evopolicy_common.catalogue import Entry, installs
from evopolicy_common.catalogue.worlds import unchanged
from evopolicy_common.errors import ConfigError, WorkerError
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_worker.environments.families import foreign
from evopolicy_worker.environments.interface import settings
from evopolicy_worker.environments.interface.base import Environment
from evopolicy_worker.environments.interface.calls import traced
from evopolicy_worker.environments.interface.fingerprint import versions
from evopolicy_worker.environments.interface.gymnasium_adapter import (
    GymnasiumEnvironment,
    GymnasiumFamily,
    quiet,
)
from evopolicy_worker.environments.interface.worlds import World

_TIMED_STEPS, _TIMED_S = 16, 0.25
"""How long a description measures what a step costs."""

_defined: dict[str, Entry] = {}


def define(definitions: Iterable[Entry]) -> None:
    """Makes environments that do not ship known to this process."""
    _defined.update((each.id, each) for each in definitions)


def defined() -> tuple[Entry, ...]:
    """The definitions that `define` got in this process."""
    return tuple(_defined.values())


def definition(env_id: str) -> list[str]:
    """The definition of an environment that does not ship, as a command-line argument; an empty list for a shipped
    one."""
    return [msgspec.json.encode(_defined[env_id]).decode()] if env_id in _defined else []


def make(env_id: str, *, render: bool = False, accelerations: bool | None = None) -> Environment:
    """A new environment, ready for its first `reset`. The first of a family imports its simulator.

    `accelerations`: faster code for the same episodes; None takes the process environment's setting, which defaults to
    on. Raises ConfigError for an unknown id, and WorkerError when packages are missing.
    """
    entry = _entry(env_id)
    if entry.world:
        base = make(unchanged(env_id), render=render, accelerations=accelerations)
        return World(env_id, entry.title, base)
    if entry.adapter == "toy":
        from evopolicy_worker.environments.families import toy

        kind = toy.MassOnLine if entry.id == "toy/line" else toy.Maze
        return kind(entry, render=render)
    family = family_of(entry)
    if not family.installed():
        raise WorkerError(f"{env_id} needs {family.needs()}")
    if accelerations is None:
        accelerations = settings.accelerations_on()
    return GymnasiumEnvironment(entry, family, render=render, accelerations=accelerations)


def load(env_id: str) -> None:
    """Imports an environment's simulator, if installed, so that processes forked afterwards have it already."""
    entry = _entry(env_id)
    if entry.adapter != "toy" and (family := family_of(entry)).installed():
        settings.apply()
        with quiet():
            family.load()


def describe(env_id: str) -> EnvironmentDescription:
    """The description of an environment. Makes it, and so imports the simulator; one that does not ship is also tried
    out for a few steps. Raises as `make`, and WorkerError when the trial fails.
    """
    try:
        environment = make(env_id)
        if not catalogue.is_shipped(env_id) and isinstance(environment, GymnasiumEnvironment):
            environment.try_out()
        description = measured(environment)
    except WorkerError as error:
        raise type(error)(f"{error}{traced(error.__cause__)}") from error.__cause__
    entry, dropped = _entry(env_id), tuple(foreign.dropped.get(env_id, ()))
    if entry.success in dropped:
        raise WorkerError(
            f"environment {env_id}, step, info[{entry.success!r}]: it is a text; success is true or false"
        )
    strings = {"info_strings": list(entry.info_strings)} if entry.info_strings else {}
    description = msgspec.structs.replace(
        description, definition=description.definition | strings, info_left_out=dropped
    )
    # Not after an exception: it belongs to the call that is running, which its message names.
    environment.close()
    return description


def measured(environment: Environment) -> EnvironmentDescription:
    """The environment's description with the mean time of a few random steps. Plays in it."""
    rng = np.random.default_rng(0)
    spent, n, ended = 0.0, 0, True
    while n < _TIMED_STEPS and spent < _TIMED_S:
        if ended:
            environment.reset(Case(seed=n))
        action = environment.action_codec.sample(rng)
        began = time.perf_counter()
        step = environment.step(action)
        spent, n = spent + time.perf_counter() - began, n + 1
        ended = step.terminated or step.truncated
    return msgspec.structs.replace(environment.description, step_us=round(1e6 * spent / n, 1))


def packages(env_id: str) -> dict[str, str] | None:
    """Versions of the distributions that decide this environment's numbers; None where they are measured in an
    environment that has been made. Imports no simulator."""
    entry = _entry(env_id)
    if entry.adapter == "toy":
        return versions(("numpy",))
    family = family_of(entry)
    return None if family.measures else family.packages(entry)


def remembers(env_id: str) -> bool:
    """Whether its process may keep, from episode to episode, something that a policy can write and read. So may every
    environment that does not ship."""
    if not catalogue.is_shipped(env_id):
        return True
    entry = _entry(env_id)
    return entry.adapter != "toy" and family_of(entry).remembers


def offered() -> list[str]:
    """Suite ids of shipped environments that this installation can play, in catalogue order. Imports no simulator."""
    return [entry.id for entry in catalogue.entries().values() if not missing(entry.id)]


def missing(env_id: str) -> str:
    """The packages to install for an environment here, or the reason why its id is unknown; empty when it can be
    played."""
    try:
        entry = _entry(env_id)
    except ConfigError as error:
        return str(error)
    if entry.adapter == "toy":
        return ""
    family = family_of(entry)
    if family.installed():
        return ""
    row = installs.family_of(env_id)
    if not row or installs.is_here(row):
        return family.needs()
    return f"{family.needs()}; or {installs.advice(env_id)} in an environment of its own"


def check_played(env_ids: Iterable[str]) -> None:
    """Raises ConfigError that names environments which cannot be played here, each with the remedy: eight that are not
    installed and eight that are unknown at most."""
    lacking = {env_id: remedy for env_id in env_ids if (remedy := missing(env_id))}
    known = [f"{env_id} needs {remedy}" for env_id, remedy in lacking.items() if _known(env_id)]
    texts = [remedy for env_id, remedy in lacking.items() if not _known(env_id)]
    if known:
        texts.append(f"not installed: {'; '.join(known[:8])}")
    if texts:
        raise ConfigError("; ".join(texts[:8]))


def _known(env_id: str) -> Entry | None:
    return _defined.get(env_id) or catalogue.known_entry(env_id)


def _entry(env_id: str) -> Entry:
    entry = _known(env_id)
    if entry is None:
        raise ConfigError(
            f"environment {env_id!r} is not installed{catalogue.near(env_id)}; name its file, or install the package"
            " that ships it"
        )
    return entry


def family_of(entry: Entry) -> GymnasiumFamily:
    """The family that makes an environment which does not belong to the toys. Imports its module, no simulator."""
    if entry.adapter == "foreign":
        return foreign.ForeignFamily(entry)
    family: GymnasiumFamily = importlib.import_module(f"{foreign.__package__}.{entry.adapter}").FAMILY
    return family
