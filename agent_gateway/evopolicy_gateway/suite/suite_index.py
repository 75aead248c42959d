"""`suite.json`: the state of each run of a sweep, rewritten atomically after every change; the exit code of their ends.

It is only an index: a run's own `run.json` decides whether the run is finished, and a start updates the index from it.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import INDEX, SCHEMA_VERSION, Index, State, SweepRun
from evopolicy_common.records.summary import utc_text
from evopolicy_common.terminal import say_lines
from evopolicy_gateway.relay.usage import tokens_in
from evopolicy_gateway.run.plan import Plan

_NO_RUN = "its agent failed before its first submit; logs/agent.jsonl and logs/harness.log have the reason"


def load(root: Path, suite: str) -> Index:
    """Reads the index in a sweep's folder, or returns a new one.

    Raises ConfigError for one that is damaged, of another sweep or from a newer version.
    """
    path = root / INDEX
    try:
        index = msgspec.json.decode(path.read_bytes(), type=Index)
    except FileNotFoundError:
        return Index(suite=suite)
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigError(f"{path} cannot be read: {error}; move it away, and it is created again") from error
    if index.schema_version > SCHEMA_VERSION:
        raise ConfigError(f"{path} was written by a newer version of evopolicy; update evopolicy")
    if index.suite != suite:
        raise ConfigError(f"{path} is of suite {index.suite!r}, not {suite!r}; choose another --runs")
    return index


def save(root: Path, index: Index) -> None:
    """Replaces `suite.json`. Raises StorageError when the disk refuses."""
    index.updated_at = utc_text(time.time())
    root.mkdir(parents=True, exist_ok=True)
    write_atomically(root / INDEX, msgspec.json.format(msgspec.json.encode(index), indent=2) + b"\n")


def state_of(record: RunRecord) -> State:
    """A finished run's state in a sweep: an error when its agent never played, else its status."""
    return "error" if record.outcome.agent_never_played else record.outcome.status


def directory_of(run: Plan) -> str:
    """A run's folder, relative to the sweep's."""
    return str(run.folder.root.relative_to(run.runs.absolute()))


def entry_of(plan: Plan, record: RunRecord) -> SweepRun:
    outcome, state, tokens = record.outcome, state_of(record), record.agent.tokens
    use = record.agent.model_use
    requests = {"requests": 0 if use is None else use.requests or 0}
    return msgspec.structs.replace(
        waiting(plan),
        state=state,
        attempt=record.attempt,
        directory=directory_of(plan),
        score=outcome.score,
        random=outcome.random_score,
        n_submits=len(outcome.val_scores or ()),
        budget_used=outcome.budget_used,
        closed_reason=outcome.closed_reason,
        tokens=None if tokens is None else msgspec.to_builtins(tokens) | requests,
        error=outcome.error or (_NO_RUN if state == "error" else None),
        wall_s=record.timing.wall_time_seconds,
        finished_at=record.timing.end_time,
    )


def waiting(plan: Plan) -> SweepRun:
    env, repeat = plan.settings.env, plan.settings.repeat
    return SweepRun(name=plan.name, agent=plan.entry, env=env, repeat=repeat, digest=plan.digest)


def used(index: Index) -> tuple[int, float, int]:
    """Tokens, US dollars and requests of all runs, including earlier attempts."""
    counts = [one for entry in index.runs.values() for one in (entry.tokens, entry.earlier) if one]
    cost = sum(float(one.get("cost") or 0.0) for one in counts)
    return sum(map(tokens_in, counts)), cost, sum(int(one.get("requests") or 0) for one in counts)


def added(one: dict[str, Any] | None, other: dict[str, Any] | None) -> dict[str, Any] | None:
    """The sum of two token counts."""
    if one is None or other is None:
        return one or other
    return {name: (one.get(name) or 0) + (other.get(name) or 0) for name in {**one, **other}}


def usage_line(index: Index) -> str | None:
    """The usage of all runs in one line; None for no tokens."""
    tokens, cost, _ = used(index)
    return f"used in all: {tokens:,} tokens" + (f", {cost:.2f} dollars" if cost else "") if tokens else None


EXIT_CODES = {"error": 1, "cancelled": 5, "agent_failed": 4, "no_ok_submit": 3}
"""Exit codes of a command that plays runs, most severe first; 0 when every run completed."""
_AGENT_FAILED = {"agent_failed": "its agent failed", "silent": "its agent was silent for too long"}


def exit_code(runs: Sequence[Plan], index: Index) -> int:
    """The code of the most severe end, see `EXIT_CODES`. Prints why each incomplete run did not complete on stderr."""
    ends = [(run, index.runs.get(run.name)) for run in runs]
    say_lines((_why(run, entry) for run, entry in ends if _kind(entry) != "completed"), err=True)
    kinds = {_kind(entry) for _, entry in ends}
    return next((code for kind, code in EXIT_CODES.items() if kind in kinds), 0)


def _kind(entry: SweepRun | None) -> str:
    """A key of `EXIT_CODES`, or `completed`."""
    if entry is None:
        return "error"
    if entry.closed_reason in _AGENT_FAILED and entry.state != "cancelled":
        return "agent_failed"
    return entry.state if entry.state in EXIT_CODES or entry.state == "completed" else "error"


def _why(run: Plan, entry: SweepRun | None) -> str:
    if entry is None or entry.state == "pending":
        return f"{run.name}: it was not begun"
    reasons = {
        "agent_failed": _AGENT_FAILED.get(entry.closed_reason),
        "no_ok_submit": "the agent made no submit, or none had a working policy",
        "cancelled": "it was cancelled",
    }
    why = entry.error or reasons.get(_kind(entry), f"it was left {entry.state}")
    return f"{run.name}: {why}" + (f"; see {run.folder.root}" if entry.directory else "")


def next_step(runs: Path) -> str:
    """The suggested next command for the runs in that folder."""
    return f"next: evopolicy report {shlex.quote(str(runs))} --out report"
