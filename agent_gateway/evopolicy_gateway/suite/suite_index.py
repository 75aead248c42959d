"""`suite.json`: what a sweep has come to, run by run. Rewritten whole and atomically after every change.

It is an index: whether a run is finished its own `run.json` says, and the index is brought in line with it at a start.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.messages.operator import RunEnd
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import INDEX
from evopolicy_common.records.summary import utc_text
from evopolicy_gateway.harnesses.usage import tokens_in
from evopolicy_gateway.run.plan import Plan

SCHEMA_VERSION = 1

_NO_RUN = "its agent failed before its first submit; its logs/agent.jsonl and logs/harness.log tell why"

State = Literal["pending", "running"] | RunEnd
FINISHED: frozenset[str] = frozenset({"completed", "no_ok_submit"})


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One run."""

    name: str
    agent: str
    env: str
    repeat: int
    digest: str
    """Of the settings that it is or was played with."""
    settings: dict[str, Any] = {}
    """Those settings."""
    state: State = "pending"
    attempt: int = 1
    directory: str = ""
    """Relative to the sweep's folder; empty for a run that another host has."""
    run: str = ""
    """The cluster's id."""
    host: str = ""
    score: float | None = None
    random: float | None = None
    n_submits: int = 0
    budget_used: int = 0
    tokens: dict[str, Any] | None = None
    earlier: dict[str, Any] | None = None
    """Tokens of the attempts before this one."""
    closed_reason: str = ""
    """Why its agent stopped, as in `run.json`."""
    error: str | None = None
    wall_s: float = 0.0
    finished_at: str = ""


class Index(msgspec.Struct, kw_only=True):
    """The whole file."""

    schema_version: int = SCHEMA_VERSION
    suite: str
    updated_at: str = ""
    runs: dict[str, Entry] = {}


def load(root: Path, suite: str) -> Index:
    """The index in a sweep's folder; a new one where there is none. ConfigError for one that is another sweep's."""
    path = root / INDEX
    try:
        index = msgspec.json.decode(path.read_bytes(), type=Index)
    except FileNotFoundError:
        return Index(suite=suite)
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigError(f"{path} cannot be read: {error}; move it away to have it made anew") from error
    if index.schema_version > SCHEMA_VERSION:
        raise ConfigError(f"{path} is of a newer version of evopolicy: update this one")
    if index.suite != suite:
        raise ConfigError(f"{path} is of suite {index.suite!r}, not {suite!r}; choose another --runs")
    return index


def save(root: Path, index: Index) -> None:
    """Replaces `suite.json`; StorageError when the disk refuses."""
    index.updated_at = utc_text(time.time())
    root.mkdir(parents=True, exist_ok=True)
    write_atomically(root / INDEX, msgspec.json.format(msgspec.json.encode(index), indent=2) + b"\n")


def state_of(record: RunRecord) -> State:
    """How a sweep takes a finished run: one whose agent never played was no run of that agent."""
    return "error" if record.outcome.agent_never_played else record.outcome.status


def directory_of(run: Plan) -> str:
    """A run's folder as the index tells it."""
    return str(run.folder.root.relative_to(run.runs.absolute()))


def entry_of(plan: Plan, record: RunRecord, **more: Any) -> Entry:
    """What the index tells of a finished run."""
    outcome = record.outcome
    state = state_of(record)
    return Entry(
        name=plan.name,
        agent=plan.entry,
        env=plan.settings.env,
        repeat=plan.settings.repeat,
        state=state,
        attempt=record.attempt,
        directory=directory_of(plan),
        score=outcome.score,
        random=outcome.random_score,
        n_submits=len(outcome.val_scores or ()),
        budget_used=outcome.budget_used,
        closed_reason=outcome.closed_reason,
        tokens=None if record.agent.tokens is None else msgspec.to_builtins(record.agent.tokens),
        error=outcome.error or (_NO_RUN if state == "error" else None),
        wall_s=record.timing.wall_time_seconds,
        finished_at=record.timing.end_time,
        **{"digest": plan.digest, **more},
    )


def waiting(plan: Plan) -> Entry:
    """What the index tells of a run that has not begun."""
    settings = plan.settings
    return Entry(
        name=plan.name, agent=plan.entry, env=settings.env, repeat=settings.repeat, digest=plan.digest
    )


def used(index: Index) -> tuple[int, float]:
    """Tokens and dollars of all runs, with their earlier attempts."""
    told = [one for entry in index.runs.values() for one in (entry.tokens, entry.earlier) if one is not None]
    return sum(map(tokens_in, told)), sum(float(one.get("cost") or 0.0) for one in told)


def added(one: dict[str, Any] | None, other: dict[str, Any] | None) -> dict[str, Any] | None:
    """Tokens of both."""
    if one is None or other is None:
        return one or other
    return {name: (one.get(name) or 0) + (other.get(name) or 0) for name in {**one, **other}}


def told(index: Index) -> str | None:
    """What all runs have used, in a line; None for nothing."""
    tokens, cost = used(index)
    return f"used in all: {tokens:,} tokens" + (f", {cost:.2f} dollars" if cost else "") if tokens else None
