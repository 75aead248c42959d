"""What a core is told when somebody asks: the event that the shell makes of a message."""

from __future__ import annotations

from typing import Any

from evopolicy_common.messages import operator, worker
from evopolicy_common.messages.worker import Message
from evopolicy_coordinator.core import events

_MADE: dict[type[Message], type[events.Asked[Any]]] = {
    operator.CreateRun: events.RunCreated,
    operator.Evaluate: events.EvaluationRequested,
    worker.Register: events.WorkerRegistered,
}
_USUAL: dict[str, Any] = {"token": "", "protocol": 0, "cases": None}


def asked(kind: type[Message], *, request: events.RequestId, **fields: Any) -> events.Asked[Any]:
    """Somebody sent a message of this kind: `fields` are the message's and those that the shell adds to it."""
    made = _MADE.get(kind, events.Asked)
    own = {name: fields.pop(name) for name in made.__struct_fields__ if name in fields}
    usual = {name: value for name, value in _USUAL.items() if name in kind.__struct_fields__}
    return made(request=request, message=kind(**{**usual, **fields}), **own)
