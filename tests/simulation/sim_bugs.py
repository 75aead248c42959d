"""Bugs to plant in the production core or in the simulated shell, one at a time (`sim_bugs.toml`): each changes a
few words in one function's source.

A test plants each bug and requires that some seed fails; this shows that the simulation detects errors.
"""

from __future__ import annotations

import inspect
import pkgutil
import textwrap
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evopolicy_coordinator.core import machine


@dataclass(frozen=True)
class Bug:
    """One change: in function `name` of `owner`, `old` becomes `new`."""

    title: str
    owner: Any
    name: str
    old: str
    new: str
    seed: int = 0
    """The first that detects it, to try before the others. After a change of the core it may be another one."""


@contextmanager
def planted(bug: Bug) -> Iterator[None]:
    """Context manager: the bug is in the core while the context is open."""
    function = getattr(bug.owner, bug.name)
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(bug.old) >= 1, f"{bug.title}: {bug.old!r} is not in {bug.name}"
    made: dict[str, Any] = {}
    exec(
        compile(source.replace(bug.old, bug.new), f"<planted: {bug.title}>", "exec"),
        function.__globals__,
        made,
    )
    tables: tuple[dict[Any, Any], ...] = (machine.EVENTS, machine.NEWS, machine.TIMERS)
    before = [dict(table) for table in tables]
    planted_one = made[bug.name]
    setattr(bug.owner, bug.name, planted_one)
    for table in tables:
        for key, rule in table.items():
            table[key] = (
                tuple(planted_one if each is function else each for each in rule)
                if isinstance(rule, tuple)
                else planted_one
                if rule is function
                else rule
            )
    try:
        yield
    finally:
        setattr(bug.owner, bug.name, function)
        for table, old in zip(tables, before, strict=True):
            table.update(old)


_ROWS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
BUGS = tuple(
    Bug(title=title, **{**row, "owner": pkgutil.resolve_name(row["owner"])}) for title, row in _ROWS.items()
)
