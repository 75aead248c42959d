"""What may follow what, as data: the phases of a run, the verdicts of a submit, the places of a job, the states of an audit.

Whoever changes one of these goes through `check`; `invariants` reads the same tables.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Literal, get_args

from evopolicy_common.messages.gateway import SubmitStatus

from .structures.trace import InvariantError

Table = Mapping[str, Collection[str]]
"""State to those that may follow it; nothing follows a state with none."""

RUN: Table = {
    "open": ("closed",),  # by its gateway, or an operator who cancels it
    "closed": ("finished",),
    "finished": (),
}

SUBMIT: Table = {"open": get_args(SubmitStatus), **dict.fromkeys(get_args(SubmitStatus), ())}
"""Any verdict may follow, once; `open` is a status of None."""

AUDIT: Table = {
    "open": ("agreed", "disputed", "not_audited"),
    "agreed": (),
    "disputed": (),
    "not_audited": (),
}

Place = Literal["new", "queued", "leased", "parting", "backing_off", "adopting", "closed"]

JOB: Table = {
    "new": ("queued", "adopting"),  # adopting: it may be running somewhere since before the core was loaded
    "queued": ("queued", "leased", "closed"),  # queued again: at another priority
    "leased": ("queued", "parting", "backing_off", "closed"),
    "parting": (
        "queued",
        "leased",
        "closed",
    ),  # its lease was stopped; it waits for what its worker hands back
    "backing_off": ("queued", "leased", "closed"),  # leased: adopted from its worker's heartbeat
    "adopting": ("queued", "leased", "closed"),
    "closed": (),
}


def goes_on(table: Table, state: str) -> bool:
    """Whether anything may follow `state`."""
    return bool(table[state])


def check(table: Table, key: str, before: str, after: str) -> None:
    """InvariantError when `after` may not follow `before`. `key` names what changes."""
    if after not in table[before]:
        raise InvariantError(f"{key}: {after} cannot follow {before}")
