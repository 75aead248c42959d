"""Allowed transitions as data: phases of a run, verdicts of a submit, places of a job.

Every change of one of these goes through `check`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Literal, get_args

from evopolicy_common.messages.gateway import SubmitStatus
from evopolicy_coordinator.core.structures import InvariantError

Table = Mapping[str, Collection[str]]
"""State to its allowed successors; a final state has none."""

RUN: Table = {
    "open": ("closed",),  # by its gateway, or by an operator's cancellation
    "closed": ("finished",),
    "finished": (),
}

SUBMIT: Table = {"open": get_args(SubmitStatus), **dict.fromkeys(get_args(SubmitStatus), ())}
"""An open submit gets any verdict, once; `open` is a status of None."""

Place = Literal["new", "queued", "leased", "backing_off", "adopting", "closed"]

JOB: Table = {
    "new": ("queued", "adopting"),  # adopting: it may have been running since before the core was loaded
    "queued": ("leased", "closed"),
    "leased": ("queued", "backing_off", "closed"),
    "backing_off": ("queued", "leased", "closed"),  # leased: adopted from its worker's heartbeat
    "adopting": ("queued", "leased", "closed"),
    "closed": (),
}


def check(table: Table, key: str, before: str, after: str) -> None:
    """Raises InvariantError when `after` may not follow `before`. `key` names the changed record in the error."""
    if after not in table[before]:
        raise InvariantError(f"{key}: {after} cannot follow {before}")
