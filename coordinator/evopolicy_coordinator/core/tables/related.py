"""Case sets: runs and evaluations that share a hidden case are related; with `strict` all are.

Rule: a case set is known while a run, an evaluation, a permit or a lease belongs to it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

from evopolicy_common.messages.environment import Case
from evopolicy_coordinator.core.structures import take
from evopolicy_coordinator.core.tables.model import CaseKey, CaseSet


class CaseSets:
    """Finds related case sets."""

    def __init__(self, *, strict: bool) -> None:
        self._strict = strict
        self._known: dict[frozenset[CaseKey], CaseSet] = {}
        self._of_case: dict[CaseKey, dict[CaseSet, None]] = {}

    def join(self, env: str, cases: Iterable[Case]) -> CaseSet:
        """Returns the case set with these hidden cases and adds one to its users."""
        keys: frozenset[CaseKey] = frozenset()
        if not self._strict:
            keys = frozenset(
                (env, case.seed, json.dumps(case.options or None, sort_keys=True)) for case in cases
            )
        case_set = self._known.get(keys)
        if case_set is None:
            case_set = self._known[keys] = CaseSet(keys)
            case_set.relatives[case_set] = None
            for key in keys:
                there = self._of_case.setdefault(key, {})
                for other in there:
                    other.relatives[case_set] = None
                    case_set.relatives[other] = None
                there[case_set] = None
        case_set.users += 1
        return case_set

    def known(self) -> Iterable[CaseSet]:
        """Returns all case sets in use."""
        return self._known.values()

    def leave(self, case_set: CaseSet | None) -> None:
        """Remove one user of a case set; the last one removes the case set."""
        if case_set is None:
            return
        case_set.users -= 1
        if case_set.users:
            return
        del self._known[case_set.cases]
        for other in case_set.relatives:
            if other is not case_set:
                del other.relatives[case_set]
        for key in case_set.cases:
            take(self._of_case, key, case_set)
