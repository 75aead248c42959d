"""The lines that a parent and its children exchange are bounded, whatever an agent's CLI has said."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest

from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import AnyEvent, CloseRun

LONG: dict[str, Any] = {"x" * 1000: {"input": list(range(400_000))}}


def filled(kind: type[child_messages.Event]) -> child_messages.Event:
    """An event of that kind with as much in every field as an agent could have put there."""
    required: dict[str, Any] = {}
    for field in msgspec.structs.fields(kind):
        if field.type in (str, str | None):
            required[field.encode_name] = "long" * 2_000_000
        elif "dict" in str(field.type):
            # Only maps of anything come from agents.
            required[field.encode_name] = LONG if "Any" in str(field.type) else {"name": "value"}
        elif isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            required[field.encode_name] = {"limits": {}} if "limits" in field.type.__struct_fields__ else {}
        elif field.required:
            required[field.encode_name] = [1] if "tuple" in str(field.type) else 1
    return msgspec.convert(required | {"event": kind.__struct_config__.tag}, kind)


@pytest.mark.parametrize("kind", get_args(AnyEvent))
def test_no_event_is_longer_than_its_reader_takes(kind: type[child_messages.Event]) -> None:
    line = child_messages.line(filled(kind))
    assert len(line) <= child_messages.MAX_LINE_BYTES
    assert isinstance(child_messages.event_of(line), kind)


def test_an_agents_facts_are_passed_on_unless_too_large() -> None:
    assert b'"turns":3' in child_messages.line(CloseRun(reason="agent_stopped", agent={"turns": 3}))
    assert b'"agent":{"left_out":' in child_messages.line(CloseRun(reason="agent_stopped", agent=LONG))
