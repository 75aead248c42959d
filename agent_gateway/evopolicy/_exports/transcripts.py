"""Agents' logs in Harbor's Agent Trajectory Interchange Format (ATIF)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from evopolicy._exports.steps import Step, read_steps
from evopolicy._runs import Run, Runs

ATIF = "ATIF-v1.7"
"""The version of the format that is written."""


def write_atif(runs: Runs, out: Path) -> list[Path]:
    """Writes `<entry>/<env>/<experiment>/trajectory.json` for each run, over existing files."""

    def write(run: Run, steps: list[Step]) -> Path:
        path = out / _name(run) / "trajectory.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(_atif(run, steps), ensure_ascii=True, indent=1), encoding="utf-8")
        return path

    return [*_each(runs, write)]


def _each(runs: Runs, write: Callable[[Run, list[Step]], Path]) -> Iterator[Path]:
    for run in runs:
        yield write(run, read_steps(run.folder / "logs" / "agent.jsonl") or [_nothing()])


def _nothing() -> Step:
    return Step(source="system", texts=["The agent's log holds no messages."])


def _name(run: Run) -> str:
    """The last three parts of its folder: entry, environment, experiment; the id keeps runs of one name apart."""
    return "/".join([*run.folder.absolute().parts[-3:-1], f"{run.folder.name}-{_id(run)[:8]}"])


def _id(run: Run) -> str:
    """22 hexadecimal digits; equal in every export of this run."""
    identity = f"{run.folder.absolute()} {run._record.timing.start_time}"
    return hashlib.sha256(identity.encode("utf-8", "surrogateescape")).hexdigest()[:22]


def _about(run: Run) -> dict[str, Any]:
    """The run as one row, without its folder."""
    return {name: value for name, value in msgspec.to_builtins(run.summary).items() if name != "run"}


def _without_none(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value not in (None, "", [], {})}


def _atif(run: Run, steps: list[Step]) -> dict[str, Any]:
    record = run._record
    tokens = record.agent.tokens
    totals: dict[str, Any] = {"total_steps": len(steps)}
    if tokens is not None:
        totals |= _without_none(
            total_prompt_tokens=tokens.input_noncached + tokens.cache_read + tokens.cache_creation,
            total_completion_tokens=tokens.output,
            total_cached_tokens=tokens.cache_read,
            total_cost_usd=tokens.cost,
        )
    return {
        "schema_version": ATIF,
        "session_id": _id(run),
        "agent": _without_none(
            name=record.agent.harness,
            version=record.agent.cli_version or "unknown",
            model_name=record.agent.model_string or record.model,
        ),
        "steps": [_atif_step(number, step) for number, step in enumerate(steps, 1)],
        "final_metrics": totals,
        "extra": {"evopolicy": _about(run)},
    }


def _atif_step(number: int, step: Step) -> dict[str, Any]:
    results = [
        _without_none(
            source_call_id=None if each.call is None else each.call.id,
            content=each.text,
            extra={"failed": True} if each.failed else None,
        )
        for each in step.results
    ]
    calls = [
        {"tool_call_id": call.id, "function_name": call.name, "arguments": call.arguments}
        for call in step.calls
    ]
    optional = _without_none(
        timestamp=step.at,
        reasoning_content="\n".join(step.reasoning),
        tool_calls=calls,
        observation={"results": results} if results else None,
    )
    return {"step_id": number, "source": step.source, "message": step.text, **optional}
