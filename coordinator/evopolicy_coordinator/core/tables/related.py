"""Families: runs and evaluations that share a hidden case are related; with `strict` all are.

Rule: a family is known while a run, an evaluation, a permit or a lease belongs to it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

from evopolicy_common.messages.environment import Case
from evopolicy_coordinator.core.tables.model import CaseKey, Family


class Families:
    """Finds related families."""

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._known: dict[frozenset[CaseKey], Family] = {}
        self._of_case: dict[CaseKey, dict[Family, None]] = {}

    def join(self, env: str, cases: Iterable[Case]) -> Family:
        """Returns the family with these hidden cases and adds one to its users."""
        keys: frozenset[CaseKey] = frozenset()
        if not self._strict:
            keys = frozenset(
                (env, case.seed, json.dumps(case.options or None, sort_keys=True)) for case in cases
            )
        family = self._known.get(keys)
        if family is None:
            family = self._known[keys] = Family(keys)
            family.relatives[family] = None
            for key in keys:
                there = self._of_case.setdefault(key, {})
                for other in there:
                    other.relatives[family] = None
                    family.relatives[other] = None
                there[family] = None
        family.users += 1
        return family

    def known(self) -> Iterable[Family]:
        """Returns all families in use."""
        return self._known.values()

    def leave(self, family: Family | None) -> None:
        """Remove one user of a family; the last one removes the family."""
        if family is None:
            return
        family.users -= 1
        if family.users:
            return
        del self._known[family.cases]
        for other in family.relatives:
            if other is not family:
                del other.relatives[family]
        for key in family.cases:
            del self._of_case[key][family]
            if not self._of_case[key]:
                del self._of_case[key]
