"""One turn of a CLI: one start of its program, fed with a prompt and read to its end.

How the turn ended is in the reader afterwards: `done`, or `failure` with why not. A program that says nothing for too long,
does not exit once it is done, or passes a cap is ended here with everything below it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import orjson

from evopolicy_gateway.agent_supervisor.agent_process import AgentProcess
from evopolicy_gateway.harnesses.base import Stage
from evopolicy_gateway.harnesses.dialect import Dialect, TurnReader
from evopolicy_gateway.harnesses.turn_failure import TurnFailure, turn_failure_of
from evopolicy_gateway.operator.child_messages import AgentDoing
from evopolicy_gateway.run import processes

DONE_TIMEOUT_S = 30.0
"""What a program gets to exit after it has said that its turn is done."""
_PIPE_TIMEOUT_S = 1.0
_KILL_GRACE_S = 3.0

Capped = Callable[[TurnReader], str | None]
"""Why the turn must end now for what it used; None when it may go on."""


async def play_turn(
    stage: Stage,
    dialect: Dialect,
    program: list[str],
    prompt: str,
    reader: TurnReader,
    silence_s: float,
    capped: Capped,
) -> None:
    """Plays it to its end; AgentError when the program cannot be started."""
    stage.log.last_errors.clear()
    process = await stage.start(program, talks=dialect.prompt_on_stdin)
    reading = asyncio.create_task(_read(stage, process, reader, silence_s, capped))
    feeding = asyncio.create_task(_feed(process, prompt)) if dialect.prompt_on_stdin else None
    ended = asyncio.create_task(process.ended())
    try:
        await asyncio.wait([reading, ended], return_when=asyncio.FIRST_COMPLETED)
        if reading.done():
            # Its output is at its end: it exits by itself, unless the reading was broken off.
            await asyncio.wait([ended], timeout=0.0 if reading.result() else DONE_TIMEOUT_S)
        if not ended.done():
            await asyncio.to_thread(processes.end_descendants, _KILL_GRACE_S, waited=stage.started)
        code = await ended
        # What it said last may still be in the pipe; a child that holds the pipe open is not waited for.
        await asyncio.wait([reading], timeout=_PIPE_TIMEOUT_S)
    finally:
        for task in (reading, feeding, ended):
            if task is not None:
                task.cancel()
        await asyncio.gather(*(task for task in (reading, feeding, ended) if task), return_exceptions=True)
        await process.close()
    if not dialect.tells_end and code == 0 and reader.failure is None:
        reader.done = True
    if not reader.done and reader.failure is None:
        reader.failure = _crash(program[0], code, list(stage.log.last_errors))


async def _read(
    stage: Stage, process: AgentProcess, reader: TurnReader, silence_s: float, capped: Capped
) -> bool:
    """Reads the stream to its end; True when the program has to be ended for it."""
    lines = process.lines()
    while True:
        timeout_s = DONE_TIMEOUT_S if reader.done else silence_s
        try:
            async with asyncio.timeout(timeout_s):
                line = await anext(lines)
        except StopAsyncIteration:
            return False
        except TimeoutError:
            if not reader.done:
                why = f"the agent's program said nothing for {silence_s:g} s"
                reader.failure = TurnFailure(kind="passing", message=why)
            return True
        if not line.lstrip().startswith(b"{"):
            continue
        try:
            event = orjson.loads(line)
        except orjson.JSONDecodeError:
            continue
        before = reader.action
        reader.read(event)
        if reader.action != before:
            stage.on_doing(AgentDoing(action=stage.log.redact.text(reader.action)))
        if (why_capped := capped(reader)) is not None:
            reader.done = False
            reader.failure = TurnFailure(kind="cap", message=why_capped)
            return True


async def _feed(process: AgentProcess, prompt: str) -> None:
    await process.say(prompt.encode())
    process.hang_up()


def _crash(program: str, code: int, errors: list[str]) -> TurnFailure:
    """A program that ended without having said how its turn did."""
    how = f"exit status {code}" if code >= 0 else f"signal {-code}"
    last = " | ".join(line for line in errors[-3:] if line)
    told = turn_failure_of(last) if last else None
    message = f"{program} ended with {how} in the middle of its turn" + (f": {last}" if last else "")
    if told is None:
        return TurnFailure(kind="passing", message=message)
    return TurnFailure(kind=told.kind, message=message[:1000], provider=told.provider, wait_s=told.wait_s)
