"""One turn of a CLI: one start of its program, with a prompt on its input, read to its end.

The reader then holds how the turn ended: `done`, or `failure` with the reason. This module ends a program, with all its
descendants, that is silent for too long, does not exit after its turn, or exceeds a cap.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import orjson

from evopolicy_gateway.harnesses.coding_agents.dialect import Dialect, TurnReader
from evopolicy_gateway.harnesses.coding_agents.turn_failure import TurnFailure, with_last_errors
from evopolicy_gateway.harnesses.interface.base import Stage
from evopolicy_gateway.processes import trees as processes
from evopolicy_gateway.processes.agent_process import AgentProcess
from evopolicy_gateway.processes.child_messages import AgentDoing

DONE_TIMEOUT_S = 30.0
"""Time that a program has to exit after it reported the end of its turn, seconds."""
_PIPE_TIMEOUT_S = 1.0
_KILL_GRACE_S = 3.0

Capped = Callable[[TurnReader], str | None]
"""Returns why the turn must end now because of its usage; None if it may continue."""


async def play_turn(
    stage: Stage,
    dialect: Dialect,
    program: list[str],
    prompt: str,
    reader: TurnReader,
    capped: Capped,
) -> None:
    """Runs one turn to its end. Raises AgentError when the program cannot be started."""
    stage.log.last_errors.clear()
    process = await stage.start(program, talks=dialect.prompt_on_stdin)
    reading = asyncio.create_task(_read(stage, process, reader, dialect.config.silence_s, capped))
    feeding = asyncio.create_task(_feed(process, dialect.stdin(prompt))) if dialect.prompt_on_stdin else None
    ended = asyncio.create_task(process.ended())
    try:
        await asyncio.wait([reading, ended], return_when=asyncio.FIRST_COMPLETED)
        if reading.done():
            # Its output has ended: it exits by itself, unless the reading was aborted.
            await asyncio.wait([ended], timeout=0.0 if reading.result() else DONE_TIMEOUT_S)
        if not ended.done():
            await asyncio.to_thread(processes.end_descendants, _KILL_GRACE_S, waited=stage.started)
        code = await ended
        # The pipe may still hold the last lines; do not wait for a child that keeps it open.
        await asyncio.wait([reading], timeout=_PIPE_TIMEOUT_S)
    finally:
        tasks = [task for task in (reading, feeding, ended) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await process.close()
    if not dialect.tells_end and code == 0 and reader.failure is None:
        reader.done = True
    if not reader.done and reader.failure is None:
        how = f"exit status {code}" if code >= 0 else f"signal {-code}"
        why = f"{program[0]} ended with {how} in the middle of its turn"
        reader.failure = with_last_errors(why, list(stage.log.last_errors))


async def _read(
    stage: Stage, process: AgentProcess, reader: TurnReader, silence_s: float, capped: Capped
) -> bool:
    """Reads the stream to its end; returns True when the program has to be ended."""
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
                why = f"the agent's program had no output for {silence_s:g} s"
                reader.failure = TurnFailure(kind="passing", message=why)
            return True
        if not line.lstrip().startswith(b"{"):
            continue
        try:
            event = orjson.loads(line)
        except orjson.JSONDecodeError:
            continue
        before = reader.action
        reader.read_event(event)
        if reader.action != before:
            stage.on_doing(AgentDoing(action=stage.log.redact.text(reader.action)))
        if (why_capped := capped(reader)) is not None:
            reader.done = False
            reader.failure = TurnFailure(kind="cap", message=why_capped)
            return True


async def _feed(process: AgentProcess, prompt: str) -> None:
    await process.say(prompt.encode())
    process.hang_up()
