"""A sweep's folder: the names of its files that several rooms use, and the content of its index."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from evopolicy_common.messages.operator import RunEnd

INDEX = "suite.json"
"""State of the sweep, run by run."""
PAUSED = "paused"
"""While this file exists, no host that shares the folder starts another run of the sweep."""

SCHEMA_VERSION = 1
"""Of the index."""

State = Literal["pending", "running"] | RunEnd
FINISHED: frozenset[str] = frozenset({"completed", "no_ok_submit"})


class SweepRun(msgspec.Struct, frozen=True, kw_only=True):
    """One run."""

    name: str
    agent: str
    env: str
    repeat: int
    digest: str
    """Digest of `settings`."""
    settings: dict[str, Any] = {}
    """The settings that it is or was played with."""
    state: State = "pending"
    attempt: int = 1
    directory: str = ""
    """Relative to the sweep's folder; empty for a run on another host."""
    run: str = ""
    """The cluster's id."""
    host: str = ""
    score: float | None = None
    random: float | None = None
    n_submits: int = 0
    budget_used: int = 0
    tokens: dict[str, Any] | None = None
    earlier: dict[str, Any] | None = None
    """Tokens of the earlier attempts."""
    closed_reason: str = ""
    """Why its agent stopped, as in `run.json`."""
    error: str | None = None
    wall_s: float = 0.0
    finished_at: str = ""


class Index(msgspec.Struct, kw_only=True):
    schema_version: int = SCHEMA_VERSION
    suite: str
    updated_at: str = ""
    runs: dict[str, SweepRun] = {}
