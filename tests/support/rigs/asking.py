"""Events for a core, as the shell makes them of messages."""

from __future__ import annotations

from typing import Any

from evopolicy_common.messages import operator, worker
from evopolicy_common.messages.worker import Message
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.records import EvaluationRow, RunRow

_USUAL: dict[str, Any] = {"token": "", "protocol": 0, "cases": None}
_RENAMED = {"sandbox_tier": "tier"}


def asked(kind: type[Message], *, request: events.RequestId, **fields: Any) -> events.Requested[Any]:
    """Somebody sent a message of this kind: `fields` are the message's and those that the shell adds to it."""
    if kind is operator.CreateRun:
        return _with_row(kind, RunRow, events.RunRequested, request, fields)
    if kind is operator.Evaluate:
        return _with_row(kind, EvaluationRow, events.EvaluationRequested, request, fields)
    made = events.WorkerRegistered if kind is worker.Register else events.Requested
    own = {name: fields.pop(name) for name in made.__struct_fields__ if name in fields}
    return made(request=request, message=_message(kind, fields), **own)


def _with_row(
    kind: type[Message],
    row: type[RunRow | EvaluationRow],
    made: Any,
    request: events.RequestId,
    fields: dict[str, Any],
) -> Any:
    stimulus = fields.pop("stimulus_id", "")
    kept = {_RENAMED.get(name, name): value for name, value in fields.items()}
    meta = {
        name: value for name, value in fields.items() if name in kind.__struct_fields__ and name != "cases"
    }
    return made(request=request, stimulus_id=stimulus, message=_message(kind, meta), row=row(**kept))


def _message(kind: type[Message], fields: dict[str, Any]) -> Message:
    usual = {name: value for name, value in _USUAL.items() if name in kind.__struct_fields__}
    return kind(**{**usual, **fields})
