"""Messages between a parent and its child processes: JSON lines on the child's stdin and stdout.

The child's stdout carries nothing else. The end of its stdin means that its parent is gone; the child then ends too.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
from collections.abc import AsyncIterator
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.processes import child_process
from evopolicy_common.processes.child_process import ChildProcess
from evopolicy_common.records.run_record import AgentInput, AgentLimits, AgentResources
from evopolicy_gateway.jail.jail import JailOrder
from evopolicy_gateway.processes import trees as processes


class RelayAddress(msgspec.Struct, frozen=True, kw_only=True):
    """The relay of the run, as its agent sees it."""

    url: str
    token: str


class FromChild(msgspec.Struct, frozen=True, kw_only=True, tag_field="event"):
    """Child to parent."""


class Ready(FromChild, frozen=True, kw_only=True, tag="ready"):
    variables: dict[str, str]
    """The `EVOPOLICYGYM_*` variables that hold URLs."""
    notes: tuple[str, ...] = ()
    """Notes for the operator about the opened run."""
    held_s: float = 0.0
    """As in `TrainProgress`."""
    permit_s: float = 0.0
    """Seconds spent waiting for the agent's permit."""


class Waits(FromChild, frozen=True, kw_only=True, tag="waits"):
    """The gateway waits: before `Ready` for the agent's permit, at the end for the agent's end."""

    waits_for: str
    """Empty: the wait is over."""


class TrainProgress(FromChild, frozen=True, kw_only=True, tag="progress"):
    """Progress of a run's train side."""

    episode_budget: int
    remaining_budget: int
    n_submits: int
    n_rejected: int = 0
    submit_id: str | None = None
    """The running submit."""
    n_episodes: int = 0
    n_done: int = 0
    waits_for: str = ""
    last_submit_id: str | None = None
    """The last submit with a verdict."""
    last_status: str | None = None
    last_mean: float | None = None
    best_mean: float | None = None
    """Highest visible mean return so far."""
    in_flight_s: float = 0.0
    """Seconds in which a submit was in flight."""
    feedback_s: float = 0.0
    """Of these, seconds from the last result's arrival to the committed feedback."""
    held_s: float = 0.0
    """Seconds so far for which submits of the run waited because hidden episodes used the machines."""
    spent: bool = False
    """No further submit is possible, and none runs."""
    cancelled: bool = False
    """The operator has cancelled the run."""


class AgentTurn(FromChild, frozen=True, kw_only=True, tag="turn"):
    turn: int
    text: str


class AgentDoing(FromChild, frozen=True, kw_only=True, tag="doing"):
    """The agent's activity changed, it used more tokens, or it waits for its provider."""

    action: str = ""
    tokens: dict[str, Any] | None = None
    """Of the run so far, as in `run.json`."""
    note: str = ""
    paused_s: float = 0.0
    """Seconds that it waits for `provider`; 0.0 when it does not wait, or no longer."""
    provider: str = ""


class AgentUsed(FromChild, frozen=True, kw_only=True, tag="agent_used"):
    """The agent's use of its wall limit and its machine since it was started."""

    used_s: float
    resources: AgentResources


class AgentSurvives(FromChild, frozen=True, kw_only=True, tag="agent_survives"):
    """The agent was ended, but the kernel holds killed processes of it; `AgentEnded` follows when they are gone."""

    pids: tuple[int, ...]


class AgentEnded(FromChild, frozen=True, kw_only=True, tag="agent_ended"):
    """The agent and all its children are gone."""

    reason: str
    """`agent_stopped`, `agent_failed`, `wall_limit`, `silent`, `disk_limit`, or `told` when the parent ended
    it."""
    detail: str = ""
    turns: int = 0
    """Prompts that it answered."""
    retries: int = 0
    facts: dict[str, Any] = {}
    """Further fields of `run.json`: `cli_version`, `model_string`, `settings`, `tokens`."""
    stderr_tail: tuple[str, ...] = msgspec.field(default=(), name="said")
    """A failed agent's last lines on stderr, without keys."""


class ModelBudgetSpent(FromChild, frozen=True, kw_only=True, tag="model_budget_spent"):
    """The relay for model calls has refused a request beyond the run's limits."""

    what: str
    """The limit, such as `5,000 requests`."""


class ToChild(msgspec.Struct, frozen=True, kw_only=True, tag_field="do"):
    """Parent to child."""


class CloseGateway(ToChild, frozen=True, kw_only=True, tag="close"):
    """To a gateway: the agent is gone, and why."""

    reason: str
    agent: dict[str, Any] = {}


class StartAgent(ToChild, frozen=True, kw_only=True, tag="start_agent"):
    """The first line to an agent supervisor."""

    agent: str
    """In the form of `--agent`."""
    folder: str
    urls: dict[str, str]
    """The `EVOPOLICYGYM_*` variables that hold URLs; the jail lets these URLs through."""
    variables: dict[str, str] = {}
    """The other variables."""
    started_in: str
    """The operator's working directory; relative file names in the agent's command start there."""
    wall_limit_s: float
    tells_left: bool = False
    """Whether prompts say how much of the agent's time and tokens is left."""
    prompts: dict[str, str] = {}
    """Texts in place of the standard ones: `Prompts`."""
    config: dict[str, Any] | None = None
    """A coding agent's settings: `AgentConfig`."""
    inputs: tuple[AgentInput, ...] = ()
    """Skills and MCP servers with which the run was opened; they need a jail."""
    relay: RelayAddress | None = None
    """Where the agent finds its model; None: at the provider, with the operator's key."""
    silence_s: float | None = None
    """A program without activity for this long is ended, seconds; None: no such limit."""
    jail: JailOrder | None = None
    """None: not jailed."""
    limits: AgentLimits = AgentLimits()


class StartRelay(ToChild, frozen=True, kw_only=True, tag="start_relay"):
    """The first line to a relay for model calls."""

    order: dict[str, Any]
    """`relay.service.RelaySetup`; it has the provider's key."""


class SubmitsSeen(ToChild, frozen=True, kw_only=True, tag="submits_seen"):
    """To an agent supervisor: the agent's submits so far."""

    asked: int
    """Their number, refused ones included."""
    running: bool
    """Whether one of them has no answer yet."""
    held_s: float = 0.0
    """Seconds that they have waited since the supervisor's start, which count against no limit of the agent."""


class StopAgent(ToChild, frozen=True, kw_only=True, tag="stop_agent"):
    """To an agent supervisor: end the agent and all that it has started."""


AnyEvent = (
    Ready
    | Waits
    | TrainProgress
    | AgentTurn
    | AgentDoing
    | AgentUsed
    | AgentSurvives
    | AgentEnded
    | ModelBudgetSpent
)
AnyOrder = CloseGateway | StartAgent | StartRelay | SubmitsSeen | StopAgent
_events: msgspec.json.Decoder[AnyEvent] = msgspec.json.Decoder(AnyEvent)
_orders: msgspec.json.Decoder[AnyOrder] = msgspec.json.Decoder(AnyOrder)


MAX_LINE_BYTES = 1 << 20
"""Maximum length of a line; the reader accepts four times as much."""
_MAX_TEXT = 2000


def line(message: FromChild | ToChild) -> bytes:
    """Encodes a message as one line of JSON, shortened if it is too long, which an agent's CLI may cause.

    `StartAgent` and `StartRelay`, with the operator's own settings, are never shortened.
    """
    data = msgspec.json.encode(message) + b"\n"
    if len(data) <= MAX_LINE_BYTES or isinstance(message, StartAgent | StartRelay):
        return data
    shorter: dict[str, Any] = {}
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if isinstance(value, str):
            shorter[name] = value[:_MAX_TEXT]
        elif isinstance(value, dict):
            size = len(msgspec.json.encode(value))
            shorter[name] = value if size <= _MAX_TEXT else {"left_out": f"{size:,} bytes"}
    return msgspec.json.encode(msgspec.structs.replace(message, **shorter)) + b"\n"


def event_of(data: bytes) -> AnyEvent:
    """Decodes a line. Raises ProtocolError when it is no event."""
    try:
        return _events.decode(data)
    except DECODE_ERRORS as error:
        raise ProtocolError(f"not an event of a child process: {data[:200]!r} ({error})") from error


def emit(event: FromChild) -> None:
    """Sends an event to the parent; dropped when the parent is gone."""
    with contextlib.suppress(BrokenPipeError):
        os.write(sys.stdout.fileno(), line(event))


class Orders:
    """The parent's orders, on the event loop; None when the parent's end of the pipe is closed."""

    def __init__(self) -> None:
        self._queue: asyncio.Queue[AnyOrder | None] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        # In a thread: a pipe inherited as stdin is shared with the parent and may not be set non-blocking.
        threading.Thread(target=self._read, args=(loop,), name="orders", daemon=True).start()

    async def next(self) -> AnyOrder | None:
        return await self._queue.get()

    def end(self) -> None:
        """Acts as if the parent were gone; for a signal handler."""
        self._queue.put_nowait(None)

    def _read(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            with open(sys.stdin.fileno(), "rb", closefd=False) as stdin:
                for data in stdin:
                    with contextlib.suppress(*DECODE_ERRORS):
                        loop.call_soon_threadsafe(self._queue.put_nowait, _orders.decode(data))
        finally:
            # A child that can no longer read commands ends as if its parent were gone.
            with contextlib.suppress(RuntimeError):  # the loop is closed already
                loop.call_soon_threadsafe(self._queue.put_nowait, None)


async def end_orphans() -> list[int]:
    """Ends children inherited from dead parents; returns the ids of survivors, which the kernel holds."""
    async with child_process.starting():
        return await asyncio.to_thread(processes.end_orphans, frozenset(child_process.live))


class Child(ChildProcess):
    """A running child, started with `talks=True`."""

    async def events(self) -> AsyncIterator[AnyEvent]:
        assert self._process.stdout is not None
        while data := await self._process.stdout.readline():
            yield event_of(data)

    async def finish(self, grace_s: float) -> None:
        """Ends its orders, and waits for at most this time until it has ended by itself, in seconds."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(grace_s):
                await self.ended()

    async def tell(self, order: ToChild) -> None:
        """Sends an order; dropped when the child is gone."""
        stdin = self._process.stdin
        assert stdin is not None
        if stdin.is_closing():
            return  # asyncio would count such writes, and warn
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            stdin.write(line(order))
            await stdin.drain()
