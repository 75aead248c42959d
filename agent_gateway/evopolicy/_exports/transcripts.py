"""Agents' logs in Harbor's Agent Trajectory Interchange Format (ATIF), and as logs of Inspect. Neither tool is
needed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from evopolicy._exports.steps import LogStep, read_steps
from evopolicy._exports.tables import time_of
from evopolicy._runs import Run, Runs
from evopolicy_common.records import secrets

ATIF = "ATIF-v1.7"
"""The version of the format that is written."""
INSPECT = 2
"""The version of Inspect's log format that is written, as JSON."""
_MAX_NAME = 100
"""Characters of an environment's name in a file's name."""
_MAX_ERROR = 500
"""Characters of a failed call's result that Inspect shows as its error; the whole result is the message's content."""


def write_atif(runs: Runs, out: Path) -> list[Path]:
    """Writes `<entry>/<env>/<experiment>/trajectory.json` for each run, over existing files."""
    return _written(runs, _atif, lambda run: out / _name(run) / "trajectory.json")


def write_inspect(runs: Runs, out: Path) -> list[Path]:
    """Writes a log with one sample for each run, over existing files."""

    def path(run: Run) -> Path:
        # Inspect lists the JSON files whose names begin with a time, and shows the next parts as task and id.
        begun = time_of(run._record.timing.start_time).strftime("%Y-%m-%dT%H-%M-%S+00-00")
        task = re.sub(r"[^A-Za-z0-9]+", "-", run.summary.env[:_MAX_NAME])
        return out / f"{begun}_{task}_{_id(run)}.json"

    return _written(runs, _inspect, path)


def _written(
    runs: Runs, made: Callable[[Run, list[LogStep]], dict[str, Any]], path_of: Callable[[Run], Path]
) -> list[Path]:
    paths = [path_of(run) for run in runs]
    nothing = LogStep(source="system", texts=["The agent's log holds no messages."])
    for run, path in zip(runs, paths, strict=True):
        steps = read_steps(run.folder / "logs" / "agent.jsonl") or [nothing]
        path.parent.mkdir(parents=True, exist_ok=True)
        data = json.dumps(made(run, steps), ensure_ascii=True, indent=1).encode()
        path.write_bytes(secrets.redacted(data, secrets.read_passed(run.folder)))
    return paths


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


def _without_none(**values: object) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value not in (None, "", [], {})}


def _atif(run: Run, steps: list[LogStep]) -> dict[str, Any]:
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


def _atif_step(number: int, step: LogStep) -> dict[str, Any]:
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


def _inspect(run: Run, steps: list[LogStep]) -> dict[str, Any]:
    record, summary, harness = run._record, run.summary, run._record.agent.harness
    model = record.agent.model_string or record.model
    begun, ended = (time_of(text).isoformat() for text in (record.timing.start_time, record.timing.end_time))
    messages = [message for step in steps for message in _inspect_messages(step, model)]
    last = next((each for each in reversed(messages) if each["role"] == "assistant"), None)
    usage = {}
    if (tokens := record.agent.tokens) is not None:
        read, written = tokens.cache_read, tokens.cache_creation
        usage[model] = _without_none(
            input_tokens=tokens.input_noncached,
            output_tokens=tokens.output,
            total_tokens=tokens.input_noncached + read + written + tokens.output,
            input_tokens_cache_read=read,
            input_tokens_cache_write=written,
            reasoning_tokens=tokens.reasoning,
            total_cost=tokens.cost,
        )
    scores = {"heldout": summary.score, "random": summary.random_score}
    known = {name: value for name, value in scores.items() if value is not None}
    choices = [] if last is None else [{"message": last, "stop_reason": "stop"}]
    sample = {
        "id": summary.env,
        "epoch": record.repeat + 1,
        "input": next((step.text for step in steps if step.source == "user"), ""),
        "target": "",
        "messages": messages,
        "output": {"model": model, "choices": choices},
        "scores": {name: {"value": value} for name, value in known.items()},
        "metadata": _about(run),
        "model_usage": usage,
        "started_at": begun,
        "completed_at": ended,
        "total_time": record.timing.wall_time_seconds,
        "uuid": _id(run),
    }
    state = summary.status if summary.status in ("cancelled", "error") else "success"
    reason = f"run.json: {summary.closed_reason or summary.status}"
    return {
        "version": INSPECT,
        "status": state,
        "eval": {
            **dict.fromkeys(("eval_id", "run_id", "task_id"), _id(run)),
            "created": begun,
            "task": f"evopolicy/{summary.env}",
            "task_args": {"budget": summary.budget},
            "dataset": {"name": summary.env, "samples": 1, "sample_ids": [summary.env]},
            "model": model,
            "config": {},
            "packages": {"evopolicy": record.versions.harness},
            "metadata": {"entry": summary.entry, "harness": harness, "exp_id": record.exp_id},
        },
        "plan": {"steps": [{"solver": harness, "params": {}}]},
        "results": {
            "total_samples": 1,
            "completed_samples": 1,
            "scores": [
                {"name": name, "scorer": name, "metrics": {"mean": {"name": "mean", "value": value}}}
                for name, value in known.items()
            ],
        },
        "stats": {"started_at": begun, "completed_at": ended, "model_usage": usage},
        "samples": [sample],
    } | ({"error": {"message": reason, "traceback": "", "traceback_ansi": ""}} if state == "error" else {})


def _inspect_messages(step: LogStep, model: str) -> Iterator[dict[str, Any]]:
    if step.source == "user":
        yield {"role": "user", "content": step.text}
    elif step.source == "agent":
        reasoning = [{"type": "reasoning", "reasoning": text} for text in step.reasoning]
        calls = [
            {"id": call.id, "function": call.name, "arguments": call.arguments, "type": "function"}
            for call in step.calls
        ]
        yield _without_none(tool_calls=calls) | {
            "role": "assistant",
            "content": [*reasoning, {"type": "text", "text": step.text}] if reasoning else step.text,
            "model": model,
        }
    elif step.texts:
        yield {"role": "system", "content": step.text}
    for each in step.results:
        call = {} if each.call is None else {"tool_call_id": each.call.id, "function": each.call.name}
        error = {"error": {"type": "unknown", "message": each.text[:_MAX_ERROR]}} if each.failed else {}
        yield {"role": "tool", "content": each.text} | call | error
