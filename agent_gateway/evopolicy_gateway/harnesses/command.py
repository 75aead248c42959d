"""Any program as an agent: started in the workspace with the published variables.

It may also use the published turn protocol, JSON lines: it receives `{"type": "prompt", "turn": N, "message": …}` on
stdin and answers each with one object on stdout, until it sends stop or exits. Once the budget is spent, it gets no
more prompts, and its stdin is closed. `turn`, `text` and `stop` are optional in an answer; an answer that names an
earlier turn is ignored. A program that never reads its stdin runs until it exits, with any output. An inactive
program is ended (`clock.Activity`).
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import orjson

from evopolicy_common.errors import ConfigError, raised_as
from evopolicy_gateway.agents import replay
from evopolicy_gateway.harnesses.interface.base import Harness, Stage
from evopolicy_gateway.processes.agent_process import AgentProcess
from evopolicy_gateway.processes.child_messages import AgentEnded
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.workspace import prompts

_PIPE_TIMEOUT_S = 1.0
_POLL_S = 0.5
_STOP_TIMEOUT_S = 10.0
"""Time that a program has to exit after it sent stop, seconds."""
IDLE_TURNS = 10
"""After this many answers in a row without a submit in between, prompts are delayed."""
_IDLE_PAUSE_S = 10.0
"""The delay, seconds: a program that only answers then uses no processor time, and is detected as inactive."""


class CommandHarness(Harness):
    """`command:PROGRAM…`, and the agents of this package."""

    def __init__(
        self,
        name: str,
        program: list[str],
        settings: dict[str, object] | None = None,
        hint: str = "",
        continues: bool = False,
    ) -> None:
        """`hint`: a possible mistake in the command, shown if the program fails."""
        self.name = name
        self.continues = continues
        self._program = program
        self.command = program
        self._settings = settings or {}
        self._hint = hint

    async def run_agent(self, stage: Stage) -> AgentEnded:
        process = await stage.start(self._program, talks=True)
        talk = _Talk(process, stage)
        talking = asyncio.create_task(talk.go_on())
        ended = asyncio.create_task(process.ended())
        silence = asyncio.Future[str]() if stage.activity is None else stage.activity.silence()
        silent = asyncio.ensure_future(silence)
        tasks: list[asyncio.Future[Any]] = [talking, ended, silent]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if talking.done() and not talk.stopped:
                await asyncio.wait([ended, silent], return_when=asyncio.FIRST_COMPLETED)
            if silent.done() and not (ended.done() or talk.stopped):
                facts, why = self.known_facts(), silent.result()
                return AgentEnded(reason="silent", detail=why, turns=talk.turn, facts=facts)
            # The pipe may still hold the last lines; do not wait for a child that keeps it open.
            await asyncio.wait([talking], timeout=_PIPE_TIMEOUT_S)
            await asyncio.wait([ended], timeout=_STOP_TIMEOUT_S if talk.stopped else None)
            return self._ending(ended.result() if ended.done() else 0, talk.turn)
        finally:
            for task in (talking, silent):
                task.cancel()
            await asyncio.gather(talking, silent, return_exceptions=True)
            await process.close()

    def known_facts(self) -> dict[str, Any]:
        return {"settings": self._settings | {"program": self._program}}

    def _ending(self, exit_code: int, turns: int) -> AgentEnded:
        facts = self.known_facts()
        if exit_code == 0:
            return AgentEnded(reason="agent_stopped", turns=turns, facts=facts)
        how = f"exit status {exit_code}" if exit_code > 0 else f"signal {-exit_code}"
        detail = f"{self._program[0]} ended with {how}" + (f"; {self._hint}" if self._hint else "")
        return AgentEnded(reason="agent_failed", detail=detail, turns=turns, facts=facts)


class ReplayHarness(CommandHarness):
    """`replay:DIR`: the policies of a folder."""

    def __init__(self, program: list[str], folder: Path) -> None:
        super().__init__("replay", program, {"folder": str(folder)})
        self._folder = folder

    def check(self, env: str) -> None:
        folder = replay.folder_for(self._folder, env)
        with raised_as(ConfigError, f"--agent replay: cannot read {folder}", OSError):
            policies = replay.policies_in(folder)
        if not policies:
            raise ConfigError(
                f"--agent replay: {folder} holds no policy; name a folder with policy.py in it, or with folders that"
                " have one, such as a run's checkpoints"
            )


class RemoteHarness(Harness):
    """`remote`: an agent that someone else starts, in a container or on another host; this harness only waits.

    We control neither the agent nor what it may see and reach. It ends when the budget is spent, when its time is up,
    or when the operator runs `evopolicy finish RUN_DIRECTORY`.
    """

    name = "remote"
    resumable = True

    async def run_agent(self, stage: Stage) -> AgentEnded:
        finish = RunFolder(stage.workspace.parent).finish
        while not finish.exists() and not stage.over.is_set():
            await stage.sleep(_POLL_S)
        return AgentEnded(reason="agent_stopped", facts={"settings": {"started_by": "the operator"}})


class _Talk:
    def __init__(self, process: AgentProcess, stage: Stage) -> None:
        self.turn = 0
        self.stopped = False
        self._process = process
        self._stage = stage
        self._answered = asyncio.Event()
        self._idle = 0
        """Answers in a row without a submit in between."""

    async def go_on(self) -> None:
        """Exchanges turns until the program sends stop, or its stdout ends."""
        # A task of its own: a program that never reads its stdin fills it, and its output must still be read.
        prompting = asyncio.create_task(self._prompt())
        activity = self._stage.activity
        submits = 0
        try:
            async for line in self._process.lines():
                answer = _answer(line)
                if answer is None:
                    continue
                self.stopped = answer.get("stop") is True
                named = answer.get("turn")
                # Programs that count from one are accepted.
                if isinstance(named, int) and named < self.turn and not self.stopped:
                    continue
                self.turn += 1
                if activity is not None:
                    self._idle = self._idle + 1 if activity.submits == submits else 0
                    submits = activity.submits
                self._stage.on_turn(self.turn, str(answer.get("text", "")))
                if self.stopped:
                    self._process.hang_up()
                    return
                self._answered.set()
        finally:
            prompting.cancel()
            await asyncio.gather(prompting, return_exceptions=True)

    async def _prompt(self) -> None:
        while (message := await _message(self._stage, self.turn)) is not None:
            prompt = {"type": "prompt", "turn": self.turn, "message": message}
            self._stage.log.note(prompt)
            await self._process.say(orjson.dumps(prompt))
            await self._answered.wait()
            self._answered.clear()
            if self._idle > IDLE_TURNS:
                await self._stage.sleep(_IDLE_PAUSE_S)
        self._process.hang_up()


async def _message(stage: Stage, turn: int) -> str | None:
    """The turn's prompt; None if the budget is spent."""
    if turn == 0:
        return stage.prompts.begin()
    try:
        info = await stage.info()
        remaining = info["state"]["remaining_budget"]
        if not remaining or info["state"]["is_finalized"]:
            return None
    except (OSError, ValueError, KeyError):
        return "Go on. Ask /info for the budget that is left."
    return stage.prompts.stopped(remaining, prompts.NEXT_TURN) + prompts.warned(info.get("last_warning"))


def _answer(line: bytes) -> dict[str, Any] | None:
    """The line as a turn's answer; None if it is no JSON object."""
    with contextlib.suppress(orjson.JSONDecodeError):
        return dict(orjson.loads(line)) if line.lstrip().startswith(b"{") else None
    return None
