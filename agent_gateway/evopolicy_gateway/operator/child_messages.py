"""What a parent and its child processes say to each other: JSON lines on the child's stdin and stdout.

The child's stdout holds nothing else. When its stdin ends, its parent is gone, and it ends too.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_gateway.jail.jail import JailOrder


class Event(msgspec.Struct, frozen=True, kw_only=True, tag_field="event"):
    """Child to parent."""


class Ready(Event, frozen=True, kw_only=True, tag="ready"):
    """The gateway serves."""

    variables: dict[str, str]
    """The `EVOPOLICYGYM_*` variables that hold URLs."""
    notes: tuple[str, ...] = ()
    """What the operator should know of the run that was opened."""
    held_s: float = 0.0
    """As in `Progress`."""
    permit_s: float = 0.0
    """Seconds for which the agent's permit was waited for."""


class Waits(Event, frozen=True, kw_only=True, tag="waits"):
    """The gateway waits, and not for the agent: before `Ready` for the agent's permit, at the end for the agent's end."""

    waits_for: str
    """Empty: no longer."""


class Progress(Event, frozen=True, kw_only=True, tag="progress"):
    """How far a run's train side is."""

    episode_budget: int
    remaining_budget: int
    n_submits: int
    n_rejected: int = 0
    submit_id: str | None = None
    """The submit that runs."""
    n_episodes: int = 0
    n_done: int = 0
    waits_for: str = ""
    last_submit_id: str | None = None
    """The last one with a verdict."""
    last_status: str | None = None
    last_mean: float | None = None
    best_mean: float | None = None
    """Highest visible mean return so far."""
    in_flight_s: float = 0.0
    """Seconds in which a submit was in flight."""
    feedback_s: float = 0.0
    """Of these, from the last result's arrival to the committed feedback."""
    held_s: float = 0.0
    """Seconds for which submits of the run have waited so far because hidden episodes had the machines."""
    spent: bool = False
    """No further submit can be taken, and none runs."""
    cancelled: bool = False
    """The operator has ended the run."""


class RunClosed(Event, frozen=True, kw_only=True, tag="closed"):
    """The coordinator knows that no more submits come."""


class AgentTurn(Event, frozen=True, kw_only=True, tag="turn"):
    """The agent has said something."""

    turn: int
    text: str


class AgentDoing(Event, frozen=True, kw_only=True, tag="doing"):
    """The agent is at something else, has used more tokens, or waits for its provider."""

    action: str = ""
    tokens: dict[str, Any] | None = None
    """Of the run so far, as in `run.json`."""
    note: str = ""
    """What the operator should know."""
    paused_s: float = 0.0
    """It waits that long for `provider`; 0.0: it does not, or no longer."""
    provider: str = ""


class AgentSurvives(Event, frozen=True, kw_only=True, tag="agent_survives"):
    """Its time is over, but the kernel holds processes of it that were killed; `AgentEnded` comes when they are gone."""

    pids: tuple[int, ...]


class AgentEnded(Event, frozen=True, kw_only=True, tag="agent_ended"):
    """The agent and all its children are gone."""

    reason: str
    """`agent_stopped`, `agent_failed`, `wall_limit`, `silent`, or `told` when the parent ended it."""
    detail: str = ""
    turns: int = 0
    """Prompts that it answered."""
    retries: int = 0
    facts: dict[str, Any] = {}
    """What else `run.json` tells: `cli_version`, `model_string`, `settings`, `tokens`."""
    said: tuple[str, ...] = ()
    """What a failed agent said last on stderr, without keys."""


class Order(msgspec.Struct, frozen=True, kw_only=True, tag_field="do"):
    """Parent to child."""


class CloseRun(Order, frozen=True, kw_only=True, tag="close"):
    """To a gateway: the agent is gone, and why."""

    reason: str
    agent: dict[str, Any] = {}


class AgentTime(Event, frozen=True, kw_only=True, tag="agent_time"):
    """How much of its wall limit the agent has used since it was started."""

    used_s: float


class StartAgent(Order, frozen=True, kw_only=True, tag="start_agent"):
    """The first line to an agent supervisor."""

    agent: str
    """As `--agent` takes it."""
    workspace: str
    agent_log: str
    urls: dict[str, str]
    """The `EVOPOLICYGYM_*` variables that hold URLs: what its jail lets through."""
    variables: dict[str, str] = {}
    """The others."""
    started_in: str
    """Where the operator's command was given: file names in the agent's command are meant from there."""
    wall_limit_s: float
    config: dict[str, Any] | None = None
    """A coding agent's settings: `AgentConfig`."""
    session_file: str | None = None
    silence_s: float | None = None
    """A program that does nothing for so long is ended; None: never for that."""
    jail: JailOrder | None = None
    """None: not jailed."""
    lock: str | None = None
    """File that the agent supervisor holds while the agent may be alive; it waits for an agent supervisor before it that still does."""


class HeldTime(Order, frozen=True, kw_only=True, tag="held_time"):
    """To an agent supervisor: submits have waited so long in all since it was started, which counts against no limit of the agent."""

    seconds: float


class SubmitsSeen(Order, frozen=True, kw_only=True, tag="submits_seen"):
    """To an agent supervisor: the submits that the agent has asked for so far, refused ones too."""

    asked: int
    running: bool
    """One of them has no answer yet."""


class StopAgent(Order, frozen=True, kw_only=True, tag="stop_agent"):
    """To an agent supervisor: end the agent and all that it has started."""


AnyEvent = (
    Ready | Waits | Progress | RunClosed | AgentTurn | AgentDoing | AgentTime | AgentSurvives | AgentEnded
)
AnyOrder = CloseRun | StartAgent | HeldTime | SubmitsSeen | StopAgent
_events: msgspec.json.Decoder[AnyEvent] = msgspec.json.Decoder(AnyEvent)
_orders: msgspec.json.Decoder[AnyOrder] = msgspec.json.Decoder(AnyOrder)


MAX_LINE_BYTES = 1 << 20
"""A line is no longer; whoever reads it takes four times as much."""
_MAX_TEXT = 2000


def line(message: Event | Order) -> bytes:
    """A message as one line of JSON; without what would make it too long, which an agent's CLI may have said.

    The operator's own settings, in `StartAgent`, are left whole.
    """
    data = msgspec.json.encode(message) + b"\n"
    if len(data) <= MAX_LINE_BYTES or isinstance(message, StartAgent):
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
    """The event in a line; ProtocolError for anything else."""
    try:
        return _events.decode(data)
    except DECODE_ERRORS as error:
        raise ProtocolError(f"not an event of a child process: {data[:200]!r} ({error})") from error


def emit(event: Event) -> None:
    """Tells the parent; what it no longer hears is dropped."""
    try:
        os.write(sys.stdout.fileno(), line(event))
    except BrokenPipeError:
        pass


class Orders:
    """The parent's orders, on the event loop; None when its end of the pipe is gone."""

    def __init__(self) -> None:
        self._queue: asyncio.Queue[AnyOrder | None] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        # A thread, since a pipe inherited as stdin may not be set non-blocking: it is shared with the parent.
        threading.Thread(target=self._read, args=(loop,), name="orders", daemon=True).start()

    async def next(self) -> AnyOrder | None:
        """The next order; waits for it."""
        return await self._queue.get()

    def end(self) -> None:
        """As if the parent were gone: for a signal."""
        self._queue.put_nowait(None)

    def _read(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            with open(sys.stdin.fileno(), "rb", closefd=False) as stdin:
                for data in stdin:
                    try:
                        order = _orders.decode(data)
                    except DECODE_ERRORS:
                        continue
                    loop.call_soon_threadsafe(self._queue.put_nowait, order)
        finally:
            # Who hears no more orders, for whatever reason, ends as when its parent is gone.
            with contextlib.suppress(RuntimeError):  # the loop is closed already
                loop.call_soon_threadsafe(self._queue.put_nowait, None)
