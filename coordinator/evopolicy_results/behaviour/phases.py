"""Code phases: bands of one edit type over a run's budget, and the events marked on them (paper, case studies)."""

from __future__ import annotations

from collections.abc import Sequence

from evopolicy_results.behaviour.edits import Transition


def phases(transitions: Sequence[Transition]) -> list[tuple[int, int, str]]:
    """Bands (from, to, edit type) over consumed episodes: adjacent transitions of one type form one band.

    A submit's band covers its own episodes. Rollbacks and retests are events, not phases: the phase continues through
    them.
    """
    bands: list[tuple[int, int, str]] = []
    for transition in transitions:
        edit = transition.edit
        if edit in ("rollback", "retest"):
            edit = bands[-1][2] if bands else "first"  # type: ignore[assignment]
        if bands and bands[-1][2] == edit:
            bands[-1] = (bands[-1][0], transition.consumed, edit)
        else:
            bands.append((bands[-1][1] if bands else transition.consumed_before, transition.consumed, edit))
    return bands


def events_of(transition: Transition) -> list[str]:
    """`hit` or `miss`, plus `rollback` or `retest` if the submit is one."""
    outcome = ["hit" if transition.hit else "miss"]
    return outcome + ([transition.edit] if transition.edit in ("rollback", "retest") else [])
