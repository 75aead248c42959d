"""The lines that a parent and its children exchange are bounded, whatever an agent's CLI has said."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
from program_runs import run_python

from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import AnyEvent, CloseGateway

LONG: dict[str, Any] = {"x" * 1000: {"input": list(range(400_000))}}


def filled(kind: type[child_messages.FromChild]) -> child_messages.FromChild:
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
def test_no_event_is_longer_than_its_reader_takes(kind: type[child_messages.FromChild]) -> None:
    line = child_messages.line(filled(kind))
    assert len(line) <= child_messages.MAX_LINE_BYTES
    assert isinstance(child_messages.event_of(line), kind)


def test_an_agents_facts_are_passed_on_unless_too_large() -> None:
    assert b'"turns":3' in child_messages.line(CloseGateway(reason="agent_stopped", agent={"turns": 3}))
    assert b'"agent":{"left_out":' in child_messages.line(CloseGateway(reason="agent_stopped", agent=LONG))


OPERATOR = """
import asyncio, sys
from pathlib import Path
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes import trees as processes
from evopolicy_gateway.processes.child_messages import Child

async def main():
    processes.become_subreaper()
    stop = asyncio.Event()

    async def seek():
        while not stop.is_set():
            await child_messages.end_orphans()

    seeking = asyncio.create_task(seek())
    program = [sys.executable, "-c", "import sys; sys.stdin.read(); sys.exit(7)"]
    started = await asyncio.gather(*(Child.start(program, Path(sys.argv[1]), talks=True) for _ in range(30)))
    stop.set()
    await seeking
    for child in started:
        child._process.stdin.close()
    print([await child.ended() for child in started].count(7))

asyncio.run(main())
"""


def test_a_child_that_is_just_being_started_is_no_orphan(tmp_path: Path) -> None:
    done = run_python(OPERATOR, tmp_path / "log")
    assert done.stdout == "30\n", done.stderr
