"""Structures with invariants of their own, independent of runs, workers and jobs: deadlines, ledgers, polls."""

from __future__ import annotations

from typing import TypeVar

K = TypeVar("K")
N = TypeVar("N")
T = TypeVar("T")


class InvariantError(AssertionError):
    """The core's state is inconsistent: a bug."""


def pop_entry(index: dict[K, dict[N, T]], key: K, name: N) -> T | None:
    """Removes and returns the entry under a key and a name; None when it is missing. Drops an empty key."""
    there = index.get(key)
    taken = None if there is None else there.pop(name, None)
    if there is not None and not there:
        del index[key]
    return taken
