"""Any program as an agent: started in the workspace with the three URLs.

It may also speak the published turn protocol, JSON lines: it is sent `{"type": "prompt", "turn": N, "message": …}` on stdin
and answers each with one object on stdout, until it says stop or exits. `turn`, `text` and `stop` are optional in an answer; an
answer to an earlier turn is passed over. A program that never reads its stdin plays until it exits, whatever it prints.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import orjson

from evopolicy_gateway.harnesses import prompts
from evopolicy_gateway.harnesses.agent_process import AgentProcess
from evopolicy_gateway.harnesses.base import Ending, Harness, Stage

_PIPE_PATIENCE_S = 1.0
_STOP_PATIENCE_S = 10.0
"""How long a program that has said stop may take to exit by itself."""


class CommandHarness(Harness):
    """`command:PROGRAM…`, and the agents that come with this package."""

    def __init__(self, name: str, program: list[str], settings: dict[str, Any] | None = None) -> None:
        self.name = name
        self._program = program
        self.command = program
        self._settings = settings or {}

    async def play(self, stage: Stage) -> Ending:
        process = await stage.start(self._program, talks=True)
        talk = asyncio.create_task(_talk(process, stage))
        try:
            ended = asyncio.create_task(process.ended())
            await asyncio.wait([talk, ended], return_when=asyncio.FIRST_COMPLETED)
            if ended.done():
                # What it said last may still be in the pipe; a child that holds the pipe open is not waited for.
                await asyncio.wait([talk], timeout=_PIPE_PATIENCE_S)
            turns, stopped = talk.result() if talk.done() else (0, False)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(ended), _STOP_PATIENCE_S if stopped else None)
            return self._ending(ended.result() if ended.done() else 0, turns)
        finally:
            talk.cancel()
            await asyncio.gather(talk, return_exceptions=True)
            await process.close()

    def known(self) -> dict[str, Any]:
        return {"settings": self._settings | {"program": self._program}}

    def _ending(self, exit_code: int, turns: int) -> Ending:
        facts = self.known()
        if exit_code == 0:
            return Ending(reason="agent_stopped", turns=turns, facts=facts)
        how = f"exit status {exit_code}" if exit_code > 0 else f"signal {-exit_code}"
        return Ending(
            reason="agent_failed", detail=f"{self._program[0]} ended with {how}", turns=turns, facts=facts
        )


async def _talk(process: AgentProcess, stage: Stage) -> tuple[int, bool]:
    """Turns answered, and whether the program said stop. Ends with the program's stdout."""
    turn = 0
    answered = asyncio.Event()
    answered.set()

    async def prompt() -> None:
        # Apart from reading: a program that prints objects and never reads fills its stdin, and must still be read.
        while True:
            await answered.wait()
            answered.clear()
            await _prompt(process, stage, turn)

    prompting = asyncio.create_task(prompt())
    try:
        async for line in process.lines():
            answer = _answer(line)
            if answer is None or answer.get("turn", turn) != turn:
                continue
            turn += 1
            stage.on_turn(turn, str(answer.get("text", "")))
            if answer.get("stop") is True:
                process.hang_up()
                return turn, True
            answered.set()
    finally:
        prompting.cancel()
        await asyncio.gather(prompting, return_exceptions=True)
    return turn, False


async def _prompt(process: AgentProcess, stage: Stage, turn: int) -> None:
    message = await _message(stage, turn)
    prompt = {"type": "prompt", "turn": turn, "message": message}
    stage.log.note(prompt)
    await process.say(orjson.dumps(prompt))


async def _message(stage: Stage, turn: int) -> str:
    if turn == 0:
        return prompts.FIRST
    try:
        left = (await stage.info())["state"]["remaining_budget"]
    except (OSError, ValueError, KeyError):
        return "Go on. Ask /info for the budget that is left."
    return f"Go on: {left} episodes of the budget are left. Answer with stop set to true if you are done."


def _answer(line: bytes) -> dict[str, Any] | None:
    """The line as a turn's answer; None for what is no JSON object."""
    if not line.lstrip().startswith(b"{"):
        return None
    try:
        return dict(orjson.loads(line))
    except orjson.JSONDecodeError:
        return None
