"""The suite catalogue: which environments there are, what each is called, and how suites group them.

Static data without any simulator, so every room may read it. What needs the simulator (spaces, task text) is described
by a worker: see `messages.EnvironmentDescription`.
"""

from __future__ import annotations

import difflib
import fnmatch
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import Literal

import msgspec

from evopolicy_common.errors import ConfigError

Demand = Literal["synthesis", "tuning"]
ObservationKind = Literal["state", "image", "symbolic", "dict"]
ActionKind = Literal["discrete", "continuous"]


class Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One environment of the catalogue."""

    id: str
    """Suite id: what users, runs and cases name it by, such as `gym/acrobot`."""
    gymnasium_id: str | None = None
    """What `gymnasium.make` takes; None for environments of our own (`toy/…`)."""
    family: str
    """Key of the family the environment's scores are averaged in, such as `gym_box2d`."""
    title: str
    """Short name for tables, such as `Acrobot`."""
    max_episode_steps: int
    """Upper bound on an episode's length, in steps."""
    published_steps: int | None = None
    """Where the published software cuts an episode, and what it tells as the limit; None: as here. It takes 1,000 where
    Gymnasium has no limit registered, though all but one of these environments end earlier by themselves."""
    step_bytes: int
    """About what a step takes of a run directory in a train episode's feedback, without video; as measured."""
    observation: ObservationKind
    """What an observation is: a vector, a picture, a grid of symbols, or a dictionary of arrays."""
    action: ActionKind
    demand: Demand | None = None
    """Task-demand group of the paper's mechanism section; None when the paper does not place it."""

    def feedback_bytes(self, episodes: int) -> int:
        """What the feedback of so many train episodes takes of a run directory when all are as long as can be."""
        return episodes * self.max_episode_steps * self.step_bytes


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A named list of environments with the numbers that runs of it use."""

    name: str
    title: str
    environments: tuple[str, ...]
    budget: int
    """Train episodes a run may spend."""
    min_episodes_per_submit: int
    max_episodes_per_submit: int
    n_train: int
    n_validation: int
    n_heldout: int


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    families: dict[str, str]
    environment: tuple[Entry, ...]
    suite: tuple[Suite, ...]


@cache
def _load() -> _File:
    text = files(__package__).joinpath("catalogue.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(text), _File)


def entries() -> dict[str, Entry]:
    """All environments by suite id, in catalogue order."""
    return {entry.id: entry for entry in _load().environment}


def suites() -> dict[str, Suite]:
    """All suites by name."""
    return {suite.name: suite for suite in _load().suite}


def families() -> dict[str, str]:
    """Family key to its title, in the order of the paper's tables."""
    return dict(_load().families)


def entry(env_id: str) -> Entry:
    """The catalogue's entry of `env_id`; ConfigError naming what is near when there is none."""
    found = entries().get(env_id)
    if found is None:
        raise ConfigError(f"no environment {env_id!r} in the catalogue{_near(env_id)}")
    return found


def suite_of(env_id: str) -> Suite:
    """The first suite that holds `env_id`: its numbers are the defaults of a run on it."""
    entry(env_id)
    return next(suite for suite in suites().values() if env_id in suite.environments)


def resolve(patterns: Iterable[str]) -> list[str]:
    """Suite ids named by `patterns`, in catalogue order without repeats.

    A pattern is a suite name (`core16`), a suite id (`gym/acrobot`), or a glob over suite ids
    (`gymnasium/MiniGrid-*`). ConfigError for one that names nothing.
    """
    wanted: set[str] = set()
    for pattern in patterns:
        if pattern in suites():
            wanted.update(suites()[pattern].environments)
            continue
        hits = [env_id for env_id in entries() if fnmatch.fnmatchcase(env_id, pattern)]
        if not hits:
            raise ConfigError(f"no environment or suite matches {pattern!r}{_near(pattern)}")
        wanted.update(hits)
    return [env_id for env_id in entries() if env_id in wanted]


def _near(name: str) -> str:
    known = [*entries(), *suites()]
    lowered = {item.lower(): item for item in known}
    close = [lowered[hit] for hit in difflib.get_close_matches(name.lower(), list(lowered), n=3, cutoff=0.5)]
    if not close:
        tail = name.lower().rsplit("/", 1)[-1].strip("*")
        close = [item for item in known if tail and (tail in item.lower())][:3]
    if close:
        return f"; near: {', '.join(close)}"
    return f"; suites: {', '.join(suites())}"
