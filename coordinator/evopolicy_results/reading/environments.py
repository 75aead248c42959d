"""Names of environments, families and suites, and their order: from the catalogue, or as runs tell them."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Hashable, Iterable
from functools import cache
from typing import TypeVar

from evopolicy_common import catalogue
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.terminal import one_line

Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)


def ordered_environments(envs: Iterable[str]) -> list[str]:
    """Distinct environment ids in catalogue order, then unknown ones by name."""
    order = {env: place for place, env in enumerate(catalogue.entries())}
    return sorted(set(envs), key=lambda env: (order.get(env, len(order)), env))


def by_name(name: str) -> tuple[str, str]:
    """A key that sorts entries in every table and figure."""
    return name.casefold(), name


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """The items by their key, both in order of appearance."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


names_in_runs: dict[str, set[tuple[str, str]]] = {}
"""Titles and families that runs tell of environments which do not ship, by id, for this process."""
_MAX_TITLE = 60
_FAMILY = re.compile(r"[a-z0-9_]{1,40}")


def learn_names(records: Iterable[RunRecord]) -> None:
    """Takes from runs, for this process, the titles and families of environments that the catalogue lacks. They are
    shown where all runs of an environment agree."""
    for record in records:
        if record.env not in catalogue.entries() and (record.env_title or record.env_family):
            names = names_in_runs.setdefault(record.env, set())
            if len(names) < 2:
                names.add((record.env_title, record.env_family))


def _name(env: str) -> tuple[str, str]:
    """Title and family; empty where they are unknown."""
    entry = catalogue.entries().get(env)
    if entry is not None:
        return entry.title, entry.family
    names = names_in_runs.get(env, set())
    return next(iter(names)) if len(names) == 1 else ("", "")


@cache
def _shipped_titles() -> frozenset[str]:
    return frozenset(each.title.casefold() for each in catalogue.entries().values())


def title_of(env: str) -> str:
    """Short name for tables; the id itself if neither the catalogue nor the runs that were read have one, or if these
    tell the title of an environment that ships."""
    title = " ".join(one_line(_name(env)[0])[:_MAX_TITLE].split())
    foreign = env not in catalogue.entries()
    return env if not title or (foreign and title.casefold() in _shipped_titles()) else title


def family_of(env: str) -> str:
    """Family key; `other` for an environment of which neither the catalogue nor the runs that were read tell one."""
    family = _name(env)[1]
    return family if _FAMILY.fullmatch(family) else "other"


def family_title(family: str) -> str:
    return catalogue.families().get(family, family.replace("_", " ").capitalize())


def suites_of(environments: Iterable[str]) -> dict[str, list[str]]:
    """Groups `environments` by suite name (the catalogue's first suite with each); unknown ones are in `other`."""
    return grouped(
        ordered_environments(environments),
        lambda env: catalogue.suite_of(env).name if env in catalogue.entries() else "other",
    )


def suite_size(suite: str) -> int:
    """Number of environments in the whole suite; 0 if it has no definition."""
    known = catalogue.suites().get(suite)
    return len(known.environments) if known is not None else 0


def suite_title(suite: str, environments: Collection[str]) -> str:
    """Displayed title of these environments of a suite: `Core16`, `Core16 (3 of 16)`, or the only environment's."""
    known = catalogue.suites().get(suite)
    if known is not None and len(environments) == len(known.environments):
        return known.title
    if len(environments) == 1:
        return title_of(next(iter(environments)))
    return (
        f"{len(environments)} other environments"
        if known is None
        else f"{known.title} ({len(environments)} of {len(known.environments)})"
    )
