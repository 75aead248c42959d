"""The coordinator's half of the gateway protocol over a real Zenoh session, with a script in place of workers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import httpx
import msgspec
import numpy as np

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, PolicyFailure, ResourceLimits
from evopolicy_common.messages.gateway import (
    CloseRun,
    EpisodeFeedback,
    OpenRun,
    Permit,
    RequestPermit,
    ResultsPage,
    ResultsRequest,
    RunClosed,
    RunOpened,
    RunState,
    StateReply,
    StateRequest,
    Submit,
    SubmitAccepted,
    SubmitDone,
    SubmitInFlight,
)
from evopolicy_common.messages.worker import BlobAck, BlobChunk, BlobGet, BlobPut, Message, Refused
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.trajectory import Recorder
from evopolicy_common.wire import codec, credentials, keys, transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.refusals import Refusal
from evopolicy_gateway.run.gateway import Close, Gateway
from evopolicy_gateway.run.layout import OpenedRun, RunFolder, save
from evopolicy_gateway.submits.desk import Desk
from evopolicy_gateway.workspace.agents_md import Urls

CLUSTER = "test"
RUN = "run-1"
CAPABILITY = "capability-of-run-1"

LINE = EnvironmentDescription(
    env="toy/line",
    env_version="toy/line (evopolicy, version 1)",
    obs_space={
        "type": "Box",
        "shape": [3],
        "dtype": "float32",
        "low": [-2.0, -1.0, -1.5],
        "high": [2.0, 1.0, 1.5],
    },
    action_space={"type": "Box", "shape": [1], "dtype": "float32", "low": [-1.0], "high": [1.0]},
    max_episode_steps=60,
    reward_components=("reward_distance",),
    task_text="# A line\n\nPush the mass to the target.",
)


def opened(env: EnvironmentDescription = LINE, **fields: Any) -> RunOpened:
    """A run of 12 episodes on 8 train cases, unless `fields` say otherwise."""
    usual: dict[str, Any] = {
        "env": env,
        "n_env_instances": 8,
        "episode_budget": 12,
        "min_episodes_per_submit": 1,
        "max_episodes_per_submit": 6,
        "policy_scope": "episode",
        "observations": "arrays",
        "sandbox_tier": "bwrap",
        "video": "off",
        "limits": ResourceLimits(),
        "allowed_imports": ("numpy",),
        "denied_imports": ("gymnasium",),
        "state": RunState(remaining_budget=12, n_submits=0, is_finalized=False),
    }
    return RunOpened(**usual | fields)


def packed_episode(case: int, n_steps: int = 3) -> bytes:
    """Trajectory bytes of an episode that depends on its case only."""
    recorder = Recorder()
    for t in range(n_steps):
        obs = np.array([case + 0.1, t, -0.5], dtype=np.float32)
        action = np.array([0.25], dtype=np.float32)
        recorder.append(obs, action, -1.0, False, t == n_steps - 1, {"reward_distance": -1.0})
    return recorder.finish()


def episode(index: int, case: int, failure: PolicyFailure | None = None) -> EpisodeFeedback:
    """What came of `case` at that place of the request."""
    packed = packed_episode(case)
    return EpisodeFeedback(
        index=index,
        episode_return=-3.0 - case,
        length=3,
        failure=failure,
        reward_components={"reward_distance": -3.0},
        trajectory=BlobRef(digest=digest_of(packed), size=len(packed), inline=packed if case % 2 else None),
        video=None,
        stdout=b"hello\n",
        stderr=b"",
    )


class Double:
    """Answers one run's gateway. Change its attributes to script what happens."""

    def __init__(self, run: RunOpened) -> None:
        self.run = run
        self.remaining = run.episode_budget
        self.submits: list[Submit] = []
        self.blobs: dict[str, bytes] = {}
        self.closed: CloseRun | None = None
        self.asked: list[Message] = []
        self.up = True
        """False: no question is answered."""
        self.go = asyncio.Event()
        """Until it is set, submits run on."""
        self.go.set()
        self.order: Callable[[int], list[int]] = lambda n: list(range(n))[::-1]
        """In which order a submit's episodes come in."""
        self.verdict: Callable[[Submit], tuple[str, PolicyFailure | None, int]] = lambda submit: (
            "ok",
            None,
            len(submit.env_instances),
        )
        """Status, cause and episodes kept."""
        self.failures: dict[int, PolicyFailure] = {}
        """By request index."""
        self.refuse_submit: Refused | None = None
        self.permits: list[Permit | Refused] = []
        """Answers to requests for a permit, the last one again and again; none: it is granted."""
        self.held_s = 0.0

    def on_queries(self, queries: list[transport.IncomingQuery]) -> None:
        for query in queries:
            if not self.up:
                query.drop()
                continue
            message = codec.decode(codec.gateway_requests, query.payload)
            self.asked.append(message)
            if isinstance(message, ResultsRequest) and not self.go.is_set():
                asyncio.get_running_loop().create_task(self._later(query, message))
            else:
                query.reply(codec.encode(self._answer(message)))

    async def _later(self, query: transport.IncomingQuery, message: ResultsRequest) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.2):
                await self.go.wait()
        query.reply(codec.encode(self._answer(message)))

    def _answer(self, message: Message) -> Message:
        if message.token != CAPABILITY:  # type: ignore[attr-defined]
            return Refused(status=Refusal.BAD_TOKEN, message="wrong token")
        if isinstance(message, OpenRun):
            return msgspec.structs.replace(self.run, state=self._state())
        if isinstance(message, RequestPermit):
            if not self.permits:
                return Permit(granted=True)
            return self.permits.pop(0) if len(self.permits) > 1 else self.permits[0]
        if isinstance(message, StateRequest):
            return StateReply(state=self._state())
        if isinstance(message, BlobPut):
            have = self.blobs.get(message.digest, b"")
            if message.offset == len(have) < message.size:
                self.blobs[message.digest] = have = have + message.data
            return BlobAck(have=len(have))
        if isinstance(message, BlobGet):
            data = next(
                packed for case in range(99) if digest_of(packed := packed_episode(case)) == message.digest
            )
            return BlobChunk(size=len(data), data=data[message.offset : message.offset + 50])
        if isinstance(message, Submit):
            return self._submit(message)
        if isinstance(message, ResultsRequest):
            return self._page(message)
        assert isinstance(message, CloseRun)
        self.closed = message
        return RunClosed()

    def _submit(self, message: Submit) -> Message:
        known = [index for index, old in enumerate(self.submits) if old.key == message.key]
        if not known:
            if self.refuse_submit is not None:
                return self.refuse_submit
            self.submits.append(message)
            self.remaining -= len(message.env_instances)
        index = known[0] if known else len(self.submits) - 1
        return SubmitAccepted(
            submit_index=index, first_global_episode=self._first(index), remaining_budget=self._left(index)
        )

    def _page(self, message: ResultsRequest) -> ResultsPage:
        submit = self.submits[message.submit_index]
        if not self.go.is_set():
            return ResultsPage(
                cursor=message.cursor, episodes=(), done=None, waits_for="a worker", held_s=self.held_s
            )
        status, cause, n_kept = self.verdict(submit)
        n = len(submit.env_instances)
        arrivals = self.order(n) if status in ("ok", "rollout_timeout", "quarantined") else []
        page = arrivals[message.cursor : message.cursor + 2]
        cursor = message.cursor + len(page)
        done = None
        if cursor == len(arrivals):
            done = SubmitDone(
                status=status,  # type: ignore[arg-type]
                n_episodes=n,
                env_instances=submit.env_instances,
                first_global_episode=self._first(message.submit_index),
                remaining_budget=self._left(message.submit_index),
                started_at=1_700_000_000.0,
                completed_at=1_700_000_002.5,
                failure=cause,
                n_kept=n_kept,
            )
        episodes = tuple(episode(i, submit.env_instances[i], self.failures.get(i)) for i in page)
        return ResultsPage(cursor=cursor, episodes=episodes, done=done, held_s=self.held_s)

    def _state(self) -> RunState:
        running = None
        if self.submits and not self.go.is_set():
            running = SubmitInFlight(
                submit_index=len(self.submits) - 1,
                n_episodes=len(self.submits[-1].env_instances),
                n_done=0,
                waits_for="a worker",
                held_s=self.held_s,
            )
        return RunState(
            remaining_budget=self.remaining,
            n_submits=len(self.submits),
            is_finalized=self.closed is not None,
            in_flight=running,
            held_s=self.held_s,
        )

    def _first(self, index: int) -> int:
        return sum(len(submit.env_instances) for submit in self.submits[:index])

    def _left(self, index: int) -> int:
        return self.run.episode_budget - self._first(index + 1)


@contextlib.asynccontextmanager
async def answering(folder: Path, double: Double) -> AsyncIterator[Credentials]:
    """The double listening on a unix socket in `folder`; the credentials of its gateway."""
    (folder / "passwords").write_text("gateway:secret\n")
    endpoint = f"unixsock-stream/{folder}/sock"
    config = transport.server_config(CLUSTER, [endpoint], folder / "passwords", {"gateway": "gateway"})
    async with transport.serve(config, double.on_queries) as server:
        server.declare([keys.gateway_expr(CLUSTER)])
        yield Credentials(
            cluster=CLUSTER,
            role="gateway",
            endpoints=(endpoint,),
            user="gateway",
            password="secret",
            token=CAPABILITY,
        )


def prepare(root: Path, found: Credentials) -> RunFolder:
    """A run folder as `evopolicy run` leaves it for a gateway."""
    folder = RunFolder(root)
    folder.state.mkdir(parents=True, mode=0o700, exist_ok=True)
    credentials.write(found, folder.credentials)
    save(folder.opened, OpenedRun(run=RUN))
    return folder


class Served(msgspec.Struct, frozen=True):
    """A gateway that serves, and what a test looks at."""

    waits: list[str]
    """What it has said that it waits for."""

    double: Double
    folder: RunFolder
    gateway: Gateway
    task: asyncio.Task[bool]
    urls: Urls
    desk: Desk
    http: httpx.AsyncClient

    async def close(self, reason: str = "agent_stopped") -> bool:
        self.gateway.tell(Close(reason=reason))
        return await self.task


@contextlib.asynccontextmanager
async def gateway_on(folder: RunFolder, double: Double, **more: Any) -> AsyncIterator[Served]:
    """A gateway on that folder; stopped without closing the run at the end, if it still serves."""
    waits: list[str] = []
    ready: asyncio.Future[tuple[Urls, Desk]] = asyncio.get_running_loop().create_future()
    gateway = Gateway(
        folder,
        on_ready=lambda urls, desk: ready.set_result((urls, desk)),
        on_change=lambda desk: None,
        on_wait=waits.append,
        **{"alone": False, **more},
    )
    task = asyncio.create_task(gateway.run())
    await asyncio.wait([task, ready], return_when=asyncio.FIRST_COMPLETED)
    if task.done():
        task.result()
    urls, desk = ready.result()
    async with httpx.AsyncClient(timeout=30.0, trust_env=False) as client:
        yield Served(waits, double, folder, gateway, task, urls, desk, client)
    gateway.tell(None)
    await task


@contextlib.asynccontextmanager
async def served(tmp_path: Path, double: Double | None = None) -> AsyncIterator[Served]:
    """Double and gateway together in `tmp_path`."""
    double = double or Double(opened())
    async with (
        answering(tmp_path, double) as found,
        gateway_on(prepare(tmp_path / "run", found), double) as service,
    ):
        yield service
