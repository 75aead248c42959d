"""The catalogue: the environments that ship with this software, their names, and their suites; and the environments
that files and installed packages add.

It is data without any simulator, so that every room may read it. A worker describes what needs the simulator (spaces,
task text): see `messages.EnvironmentDescription`. `catalogue.toml` has Core16 and the toys; each file of
`families/*.toml` has one family, one row per environment.
"""

from __future__ import annotations

import difflib
import fnmatch
import itertools
import re
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.catalogue import worlds
from evopolicy_common.catalogue.definition import MAX_STEPS as MAX_STEPS
from evopolicy_common.catalogue.definition import USUAL_STEPS as USUAL_STEPS
from evopolicy_common.catalogue.definition import Entry as Entry
from evopolicy_common.catalogue.definition import Wrapper as Wrapper
from evopolicy_common.catalogue.definition import folder_name as folder_name
from evopolicy_common.catalogue.definition import policy_folder as policy_folder
from evopolicy_common.catalogue.definition import read_file
from evopolicy_common.catalogue.definition import valid_id as valid_id
from evopolicy_common.errors import ConfigError

ENTRY_POINTS = "evopolicy.environments"
"""Entry point group of packages that offer environments: `name = "package:FILE.toml"`, an environment file in it."""


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A named list of environments with the default numbers of their runs."""

    name: str
    title: str
    environments: tuple[str, ...]
    """Ids; in a file also names of suites, each of which stands for its environments."""
    budget: int = 128
    """Train episodes that a run may spend."""
    min_episodes_per_submit: int = 1
    max_episodes_per_submit: int = 128
    n_train: int = 64
    n_validation: int = 16
    n_heldout: int = 32


OTHER = Suite(name="other", title="Other", environments=())
"""The suite of environments that belong to no other suite."""


class _Shipped(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    families: dict[str, str]
    environment: tuple[Entry, ...]
    suite: tuple[Suite, ...]
    collection: tuple[Suite, ...]
    """Suites below those of families: an environment's own numbers are those of the first suite that has it."""


class _Family(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file of `families/`. An id is `prefix` plus a key, Gymnasium's id unless the row differs."""

    family: str
    title: str
    adapter: str
    environments: dict[str, dict[str, Any]]
    prefix: str = "gymnasium/"
    defaults: dict[str, Any] = {}
    """Defaults of `Entry` fields for all rows."""
    breadth: tuple[str, ...] = ()
    """One or two of its keys, for the suite `breadth`. The family itself is a suite of its own name."""

    def entries(self) -> Iterable[Entry]:
        shared = {"family": self.family, "adapter": self.adapter, **self.defaults}
        for name, row in self.environments.items():
            yield msgspec.convert(
                {"id": f"{self.prefix}{name}", "gymnasium_id": name, "title": name, **shared, **row}, Entry
            )


class _Loaded(msgspec.Struct, frozen=True):
    entries: dict[str, Entry]
    suites: dict[str, Suite]
    families: dict[str, str]
    prefixes: frozenset[str]


@cache
def _load() -> _Loaded:
    here = files(__package__)
    shipped = msgspec.convert(tomllib.loads((here / "catalogue.toml").read_text("utf-8")), _Shipped)
    rows = {entry.id: entry for entry in shipped.environment}
    grouped = {suite.name: suite for suite in shipped.suite}
    titles = dict(shipped.families)
    breadth: list[str] = []
    places = [item for item in (here / "families").iterdir() if item.name.endswith(".toml")]
    for place in sorted(places, key=lambda item: item.name):
        family = msgspec.convert(tomllib.loads(place.read_text("utf-8")), _Family)
        own = {entry.id: entry for entry in family.entries()}
        titles.setdefault(family.family, family.title)
        grouped[family.family] = Suite(name=family.family, title=family.title, environments=tuple(own))
        breadth += (f"{family.prefix}{name}" for name in family.breadth)
        rows |= {env_id: row for env_id, row in own.items() if env_id not in rows}
    broad = Suite(name="breadth", title="Breadth", environments=tuple(breadth))
    grouped |= {suite.name: suite for suite in (broad, *shipped.collection)}
    for name, suite in grouped.items():
        parts = [grouped[each].environments if each in grouped else (each,) for each in suite.environments]
        members = tuple(itertools.chain.from_iterable(parts))
        grouped[name] = msgspec.structs.replace(suite, environments=members)
    core16 = grouped["core16"]
    loaded: dict[str, Entry] = {}
    for env_id, row in rows.items():
        loaded[env_id] = row
        for n, world in enumerate(worlds.ids(env_id) if env_id in core16.environments else (), 1):
            loaded[world] = msgspec.structs.replace(
                row, id=world, title=f"{row.label}, world {n}", published_steps=None, demand=None, world=n
            )
    with_worlds = tuple(name for each in core16.environments for name in (each, *worlds.ids(each)))
    grouped["core16-worlds"] = msgspec.structs.replace(
        core16, name="core16-worlds", title="Core16 and its worlds", environments=with_worlds
    )
    return _Loaded(loaded, grouped, titles, frozenset(env_id.partition("/")[0] for env_id in loaded))


@cache
def digests() -> dict[str, str]:
    """By id, the first digits of the digest of the definition that ships (`EnvironmentDescription.digest`)."""
    text = files(__package__).joinpath("digests.json").read_text("utf-8")
    return msgspec.json.decode(text, type=dict[str, str])


_pinned: dict[str, str] = {}
"""By id, the digest given in this process as `ID@DIGEST`."""


def pinned(env_id: str) -> str:
    """The first digits of the definition's digest given in this process for an environment; empty for none."""
    return _pinned.get(env_id, "")


_added: dict[str, tuple[Entry, str]] = {}
"""By id, the environments of files given in this process, with the file's path."""


def entries() -> dict[str, Entry]:
    """All environments that ship, by suite id, in catalogue order."""
    return dict(_load().entries)


def suites() -> dict[str, Suite]:
    """All suites by name."""
    return dict(_load().suites)


def families() -> dict[str, str]:
    """Family key to its title, in the order of the paper's tables."""
    return dict(_load().families)


def is_shipped(env_id: str) -> bool:
    """Whether this software ships the environment."""
    return env_id in _load().entries


@cache
def plugins() -> dict[str, tuple[Entry, str]]:
    """By id, the environments of installed packages, with the file's path. Raises ConfigError."""
    offered: dict[str, tuple[Entry, str]] = {}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        package, _, name = point.value.partition(":")
        top, *inner = package.split(".")
        spec = find_spec(top)
        places = (spec.submodule_search_locations or ()) if spec is not None else ()
        paths = [Path(place, *inner, name.strip()) for place in places]
        path = next((each for each in paths if each.is_file()), None)
        if path is None or path.suffix != ".toml":
            raise ConfigError(
                f"entry point {point.name} = {point.value!r} of {ENTRY_POINTS} names no environment file in the"
                ' package: use the form "package:FILE.toml", and ship the file as package data'
            )
        offered |= {entry.id: (entry, str(path)) for entry in _checked(read_file(path), path)}
    return offered


def add(path: Path) -> list[str]:
    """Adds an environment file to this process and returns its ids. Raises ConfigError for errors in it."""
    given = {entry.id: (entry, str(path.absolute())) for entry in _checked(read_file(path), path)}
    _added.update(given)
    return list(given)


def _checked(defined: tuple[Entry, ...], path: Path) -> tuple[Entry, ...]:
    for each in defined:
        prefix = each.id.partition("/")[0]
        if is_shipped(each.id) or ("/" in each.id and prefix in _load().prefixes):
            raise ConfigError(
                f"environment file {path}, environment {each.id}: ids that begin with {prefix}/ ship with evopolicy;"
                " give yours a prefix of its own"
            )
    return defined


def source_of(env_id: str) -> str:
    """The value of a worker's `--env` for the environment: the file that defines it, or else its id."""
    return _added[env_id][1] if env_id in _added else env_id


def known_entry(env_id: str) -> Entry | None:
    """The entry of an environment, without asking a worker; None if it is unknown here."""
    if env_id in _load().entries:
        return _load().entries[env_id]
    if env_id in _added:
        return _added[env_id][0]
    if not is_foreign(env_id):
        return None
    if ":" in env_id and "/" not in env_id:
        return Entry(id=env_id, gymnasium_id=env_id)
    return plugins().get(env_id, (None, ""))[0]


def is_foreign(env_id: str) -> bool:
    """Whether an id can belong to an environment that does not ship: `module:Id`, or an id with a prefix of its own."""
    prefix, slash, _ = env_id.partition("/")
    own = ":" in prefix or (bool(slash) and prefix not in _load().prefixes)
    return own and valid_id(env_id) and "@" not in env_id


def entry(env_id: str) -> Entry:
    """The entry of `env_id`, with its id alone if foreign. Raises ConfigError with similar names."""
    if row := known_entry(env_id) or (Entry(id=env_id) if is_foreign(env_id) else None):
        return row
    raise ConfigError(f"no environment {env_id!r} in the catalogue{near(env_id)}")


def suite_of(env_id: str) -> Suite:
    """The first suite with `env_id`: its numbers are a run's defaults. Raises ConfigError as `entry` does."""
    entry(env_id)
    return next((suite for suite in suites().values() if env_id in suite.environments), OTHER)


def resolve(patterns: Iterable[str]) -> list[str]:
    """Suite ids named by `patterns`, distinct: shipped ones in catalogue order, then the others in the given order.

    A pattern is a suite name (`core16`), a suite id (`gym/acrobot`), a glob over suite ids (`gymnasium/MiniGrid-*`), an
    environment file (`lander.toml`), or the id of an environment that does not ship: `module:Id`, or one with a prefix
    of its own. A glob names worlds only if it has an `@` (`gym/*@w1`). Raises ConfigError for one that matches nothing.
    """
    wanted: dict[str, None] = {}
    for given in patterns:
        pattern, at, digest = given.partition("@")
        if given in _load().entries or worlds.unchanged(given) != given:
            pattern, at = given, ""
        if at:
            if not re.fullmatch("[0-9a-f]{8,64}", digest) or not (is_shipped(pattern) or is_foreign(pattern)):
                raise ConfigError(
                    f"{given!r}: an environment in one definition is named ID@DIGEST, as `evopolicy envs` shows it"
                )
            _pinned[pattern] = digest
        if pattern in suites():
            wanted.update(dict.fromkeys(suites()[pattern].environments))
        elif pattern.endswith(".toml"):
            wanted.update(dict.fromkeys(add(Path(pattern))))
        elif hits := [
            env_id
            for env_id, row in _load().entries.items()
            if fnmatch.fnmatchcase(env_id, pattern) and ("@" in pattern or not row.world)
        ]:
            wanted.update(dict.fromkeys(hits))
        elif pattern in _added or is_foreign(pattern):
            wanted[pattern] = None
        elif foreign := [env_id for env_id in (*_added, *plugins()) if fnmatch.fnmatchcase(env_id, pattern)]:
            wanted.update(dict.fromkeys(foreign))
        else:
            raise ConfigError(f"no environment or suite matches {pattern!r}{near(pattern)}")
    shipped = [env_id for env_id in _load().entries if env_id in wanted]
    return shipped + [each for each in wanted if not is_shipped(each)]


def near(name: str, others: Iterable[str] = ()) -> str:
    """Names similar to `name`, as a suffix for an error text; `others`: ids besides the catalogue's."""
    known_ids = [*_load().entries, *others, *suites()]
    lowered = {item.lower(): item for item in known_ids}
    close = [lowered[hit] for hit in difflib.get_close_matches(name.lower(), list(lowered), n=3, cutoff=0.5)]
    if not close:
        tail = re.split("[/:]", name.lower())[-1].strip("*")
        close = [item for item in known_ids if tail and (tail in item.lower())][:3]
    if close:
        return f"; near: {', '.join(close)}"
    return f"; suites: {', '.join(suites())}"


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """A policy's mean return and its 95 % interval over the cases."""

    mean: float
    low: float | None = None
    high: float | None = None
    """Both None if at most one case has another return than the others."""


class Anchor(msgspec.Struct, frozen=True, kw_only=True):
    """The ends of an environment's scale."""

    random: Measured
    best: Measured
    cases: int
    """How many cases both played."""
    policy: str
    """Folder of the best policy, in the repository."""

    def normalised(self, score: float) -> float:
        """The score with random actions at 0 and the best policy at 1; not clipped."""
        return (score - self.random.mean) / self.width

    @property
    def width(self) -> float:
        """Return between both ends, above 0."""
        return self.best.mean - self.random.mean


@cache
def anchors() -> dict[str, Anchor]:
    """All anchors by id."""
    text = files(__package__).joinpath("anchors.json").read_text("utf-8")
    return msgspec.json.decode(text, type=dict[str, Anchor])


def anchor(env_id: str) -> Anchor | None:
    """The anchor of an environment, None if unknown; a world has that of the environment that it alters."""
    return anchors().get(worlds.unchanged(env_id))
