"""Any agent that supports the Agent Client Protocol, over the protocol's official Python library.

Its program runs in the agent's jail for the whole run, and is restarted after a crash. It then loads its session, or
begins a new one if it cannot load sessions. This side offers neither files nor terminals: the agent reads files and
runs commands in its jail. The rules of the run decide its requests for permission.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
from collections.abc import AsyncIterator, Iterator
from pathlib import PurePosixPath
from typing import Any

import orjson

from evopolicy_common.errors import ConfigError
from evopolicy_common.installation import add_extra
from evopolicy_gateway.harnesses.coding_agents.acp_stream import (
    MODE_THAT_ASKS,
    Acp,
    AcpReader,
    Choice,
    offered_choice,
    offered_modes,
    permission,
)
from evopolicy_gateway.harnesses.coding_agents.cli_agent import CliAgent
from evopolicy_gateway.harnesses.coding_agents.dialect import TurnReader, mapping, string
from evopolicy_gateway.harnesses.coding_agents.turn import Capped
from evopolicy_gateway.harnesses.coding_agents.turn_failure import (
    TurnFailure,
    turn_failure_of,
    with_last_errors,
)
from evopolicy_gateway.harnesses.interface.base import AgentError, Stage
from evopolicy_gateway.processes import trees as processes
from evopolicy_gateway.processes.agent_process import AgentProcess
from evopolicy_gateway.processes.child_messages import AgentDoing, AgentEnded

_START_TIMEOUT_S = 120.0
"""Time for each of the requests before the first prompt, seconds."""
_END_TIMEOUT_S = 5.0
_KILL_GRACE_S = 3.0
_AUTH_REQUIRED = -32000


class _LostError(Exception):
    """The session cannot be resumed."""


class AcpAgent(CliAgent):
    """Plays turns over one connection."""

    def __init__(self, dialect: Acp) -> None:
        super().__init__(dialect)
        if importlib.util.find_spec("acp") is None:
            why = "agents that speak the Agent Client Protocol need its library"
            raise ConfigError(f"{why}: {add_extra('acp')}")
        self._acp = dialect
        self._link: _Link | None = None

    async def run_agent(self, stage: Stage) -> AgentEnded:
        try:
            return await super().run_agent(stage)
        finally:
            await self._hang_up(stage)

    async def _probe(self, stage: Stage) -> None:
        self._check_program(stage.environment, AgentError)

    async def _play_turn(
        self, stage: Stage, session: str | None, prompt: str, reader: TurnReader, capped: Capped
    ) -> None:
        assert isinstance(reader, AcpReader)
        stage.log.last_errors.clear()
        try:
            link = await self._linked(stage, session)
            reader.session = link.session
            await self._prompted(stage, link, prompt, reader, capped)
        except _LostError:
            reader.failure = TurnFailure(kind="lost", message="the agent cannot load its session again")
            await self._hang_up(stage)
        except (ConnectionError, TimeoutError) as error:
            if self._link is not None:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._link.process.ended(), 1.0)
            why = str(error) or f"no answer within {_START_TIMEOUT_S:g} s"
            reader.failure = with_last_errors(f"{self._program[0]}: {why}", list(stage.log.last_errors))
            # Nothing is known of the program's state: the next turn starts it again.
            await self._hang_up(stage)
        except Exception as error:
            if (failure := _refusal(error)) is None:
                raise
            reader.failure = failure
        for entry in reader.entries():
            stage.log.note(entry)

    async def _linked(self, stage: Stage, session: str | None) -> _Link:
        """The connection, in the session; a new session for None. Raises _LostError when the session cannot be
        resumed."""
        from acp.exceptions import RequestError

        if session is not None and self._link is not None and self._link.session == session:
            return self._link
        await self._hang_up(stage)
        program = [*self._program, *self._acp.arguments(None, resume=False, prompt="", options="")]
        link = self._link = _Link(await stage.start(program, talks=True), stage)
        async with asyncio.timeout(_START_TIMEOUT_S):
            able = await link.initialize()
            self._version = link.version or self._version
            if self._acp.table.auth:
                await link.request("authenticate", {"methodId": self._acp.table.auth})
        servers = [
            {"name": name, "command": server.command, "args": list(server.args)}
            | {"env": [{"name": variable, "value": value} for variable, value in server.env.items()]}
            for name, server in self._acp.kept.servers.items()
        ]
        known = {"cwd": str(stage.workspace), "mcpServers": servers}
        async with asyncio.timeout(_START_TIMEOUT_S):
            if session is None:
                answer = await link.request("session_new", known)
                link.session = string(answer.get("sessionId")) or None
            else:
                resumes = "resume" in mapping(able.get("sessionCapabilities"))
                if not resumes and not able.get("loadSession"):
                    raise _LostError
                how = "session_resume" if resumes else "session_load"
                try:
                    answer = await link.request(how, known | {"sessionId": session})
                except RequestError as error:
                    failure = _refusal(error)
                    if failure is None or failure.provider:
                        raise
                    # It would refuse the session again.
                    raise _LostError from error
                link.session = session
            await self._set(link, answer)
        return link

    async def _set(self, link: _Link, answer: dict[str, object]) -> None:
        """Chooses the mode, the model and the effort of a session, as the agent's settings say.

        Raises AgentError when the agent offers no choice of models and is not started with this one: `run.json` would
        name a model that did not play. Likewise for the effort.
        """
        modes = offered_modes(answer)
        # In `auto`, where Qwen Code and Claude Code begin, a model of the agent's own decides what is allowed. It costs
        # tokens, and may refuse what the rules of the run allow.
        judges_itself = modes is not None and modes.current == "auto" and MODE_THAT_ASKS in modes.values
        mode = self._acp.table.mode or (MODE_THAT_ASKS if judges_itself else "")
        if mode and modes is not None and modes.option:
            await link.choose(modes, mode)
        elif mode:
            await link.request("session_set_mode", {"sessionId": link.session, "modeId": mode})
        config = self._config
        words = (*self._program, *config.extra_args, *config.environment.values())
        chosen = (("model", "model", config.model), ("effort", "thought_level", config.effort))
        for name, category, value in chosen:
            if value is None:
                continue
            choice = offered_choice(answer, category)
            started_with_it = any(value in word for word in words)
            if choice is not None and (value in choice.values or not started_with_it):
                await link.choose(choice, value)
            elif not started_with_it:
                raise AgentError(
                    f"{name} = {value!r}: the agent offers no choice of it in a session; put the {name} into `program`,"
                    f' such as ["{self._program[0]}", "--{name}", "{value}"], or remove `{name}`'
                )

    async def _prompted(
        self, stage: Stage, link: _Link, prompt: str, reader: AcpReader, capped: Capped
    ) -> None:
        """Sends the prompt and reads updates until its answer."""
        link.listens = True
        sent = {"sessionId": link.session, "prompt": [{"type": "text", "text": prompt}]}
        prompt_reply = asyncio.ensure_future(link.request("session_prompt", sent))
        try:
            while not prompt_reply.done():
                update = asyncio.ensure_future(link.updates.get())
                waited: list[asyncio.Future[Any]] = [prompt_reply, update]
                done, _ = await asyncio.wait(
                    waited, timeout=self._config.silence_s, return_when=asyncio.FIRST_COMPLETED
                )
                if not update.done():
                    update.cancel()
                if not done:
                    raise TimeoutError(f"the agent's program had no output for {self._config.silence_s:g} s")
                if update in done:
                    # All of them, as an agent may send them faster than one at a time is read.
                    for each in (update.result(), *link.arrived()):
                        self._read(stage, reader, each)
                if (why := capped(reader)) is not None:
                    reader.failure = TurnFailure(kind="cap", message=why)
                    return
            answer = prompt_reply.result()
            for each in link.arrived():
                self._read(stage, reader, each)
            reader.ended(answer)
            if not reader.done:
                reason = string(answer.get("stopReason")) or "no reason"
                reader.failure = TurnFailure(kind="passing", message=f"the agent stopped its turn: {reason}")
            elif (why := capped(reader)) is not None:
                reader.done, reader.failure = False, TurnFailure(kind="cap", message=why)
        finally:
            link.listens = False
            list(link.arrived())
            prompt_reply.cancel()
            await asyncio.gather(prompt_reply, return_exceptions=True)

    def _read(self, stage: Stage, reader: AcpReader, event: dict[str, object]) -> None:
        before = reader.action
        reader.read_event(event)
        for entry in reader.entries():
            stage.log.note(entry)
        if reader.action != before:
            stage.on_doing(AgentDoing(action=stage.log.redact.text(reader.action)))

    async def _hang_up(self, stage: Stage) -> None:
        link, self._link = self._link, None
        if link is None:
            return
        link.process.hang_up()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(link.process.ended(), _END_TIMEOUT_S)
        await asyncio.to_thread(processes.end_descendants, _KILL_GRACE_S, waited=stage.started)
        await link.close()


class _Link:
    """A started program, and the connection to it."""

    def __init__(self, process: AgentProcess, stage: Stage) -> None:
        from acp.connection import Connection

        self.process = process
        self.session: str | None = None
        self.version: str | None = None
        self.updates: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self.listens = False
        """Whether a turn is played; updates at other times, such as those of a loaded session, are dropped."""
        self._stage = stage
        self._connection = Connection(self._handle, _Pipe(process))

    async def initialize(self) -> dict[str, Any]:
        """Opens the connection; returns the agent's capabilities."""
        from acp.meta import PROTOCOL_VERSION

        nothing = {"fs": {"readTextFile": False, "writeTextFile": False}, "terminal": False}
        known = {"clientCapabilities": nothing, "clientInfo": {"name": "evopolicy", "version": "1"}}
        answer = await self.request("initialize", {"protocolVersion": PROTOCOL_VERSION, **known})
        if (version := answer.get("protocolVersion")) != PROTOCOL_VERSION:
            raise AgentError(
                f"the agent speaks version {version!r} of the protocol, and evopolicy speaks {PROTOCOL_VERSION}"
            )
        info = mapping(answer.get("agentInfo"))
        self.version = f"{string(info.get('name'))} {string(info.get('version'))}".strip() or None
        return dict(mapping(answer.get("agentCapabilities")))

    async def request(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        """Sends a request by its name in the library's table; returns the answer."""
        from acp.meta import AGENT_METHODS

        answer = await self._connection.send_request(AGENT_METHODS[method], params)
        return answer if isinstance(answer, dict) else {}

    async def choose(self, choice: Choice, value: str) -> None:
        """Chooses a value of a setting, which may be one that the agent does not list, such as an alias of a model."""
        chosen = {"configId": choice.option, "value": choice.values.get(value, value)}
        await self.request("session_set_config_option", {"sessionId": self.session, **chosen})

    def _update(self, update: dict[str, object]) -> None:
        if self.listens:
            self.updates.put_nowait(update)

    def arrived(self) -> Iterator[dict[str, Any]]:
        while not self.updates.empty():
            yield self.updates.get_nowait()

    async def close(self) -> None:
        await self._connection.close()
        await self.process.close()

    async def _handle(self, method: str, params: object, is_notification: bool) -> Any:
        from acp.exceptions import RequestError
        from acp.meta import CLIENT_METHODS

        fields = params if isinstance(params, dict) else {}
        if method == CLIENT_METHODS["session_update"]:
            if fields.get("sessionId") == self.session or self.session is None:
                self._update(dict(mapping(fields.get("update"))))
            return None
        if method == CLIENT_METHODS["session_request_permission"]:
            answer = permission(fields, PurePosixPath(self._stage.workspace))
            call = mapping(fields.get("toolCall"))
            noted = {"type": "permission", "title": string(call.get("title")), **answer["outcome"]}
            self._stage.log.note(noted)
            # Some agents tell of a tool call only here.
            self._update({**call, "sessionUpdate": "tool_call_update", "status": "pending"})
            return answer
        if is_notification:
            return None
        raise RequestError.method_not_found(method)


class _Pipe:
    """The program's pipes as the library's transport, one JSON message a line; other lines are skipped."""

    def __init__(self, process: AgentProcess) -> None:
        self._process = process
        self._lines: AsyncIterator[bytes] = process.lines()

    async def send(self, message: dict[str, object]) -> None:
        try:
            said = await self._process.say(orjson.dumps(message))
        except TypeError:
            # An answer repeats its request's id, which may nest deeper than can be written.
            said = False
        # The library logs a traceback of every answer that cannot be sent: an agent could fill the disk.
        if not said and "method" in message:
            raise ConnectionError("the agent's program has closed its input")

    async def receive(self) -> dict[str, Any] | None:
        # A program that sends requests and does not read the answers is not read either.
        await self._process.drained()
        async for line in self._lines:
            try:
                message = orjson.loads(line)
            except orjson.JSONDecodeError:
                continue
            if isinstance(message, dict):
                return message
        return None

    async def close(self) -> None:
        self._process.hang_up()


def _refusal(error: Exception) -> TurnFailure | None:
    """The failure behind an agent's answer with an error; None for any other exception."""
    from acp.exceptions import RequestError

    if not isinstance(error, RequestError):
        return None
    details = ""
    with contextlib.suppress(TypeError):  # nested too deeply
        details = "" if error.data is None else f" {orjson.dumps(error.data).decode()}"
    if error.code == _AUTH_REQUIRED:
        return TurnFailure(kind="final", message=f"not logged in: {error}{details}", provider=True)
    return turn_failure_of(f"{error}{details}")
