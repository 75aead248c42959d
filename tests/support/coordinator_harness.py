"""A real coordinator process, and clients that speak to it over Zenoh: a worker that answers at once, a gateway, an
operator. The clients are the tests' own, so that nothing but the coordinator is under test."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import RefusedError, TransportError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, EpisodeSpec, Job
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.status import StatusReply, StatusRequest, unfolded
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import Bundle, BundleFile
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec, credentials, keys
from evopolicy_common.wire.credentials import Credentials, Role
from evopolicy_common.wire.requests import Requester
from evopolicy_common.wire.transport import Link, connect

LINE = EnvironmentDescription(
    env="toy/line",
    env_version="line-1",
    obs_space={"type": "Discrete", "n": 2},
    action_space={"type": "Discrete", "n": 2},
    max_episode_steps=60,
    task_text="# A line",
)
FINGERPRINT = worker.Fingerprint(code_version="1", python="3", packages={}, cpu="any")
TIMEOUT_S = 60.0


class Coordinator:
    """One coordinator process on a state folder."""

    def __init__(
        self,
        state: Path,
        *args: str,
        trust_workers: bool = True,
        program: Sequence[str] = ("-m", "evopolicy_coordinator.cli"),
        wait: bool = True,
        **environment: str,
    ) -> None:
        self.state = state
        self.ready_file = state.parent / f"{state.name}.ready"
        self.log = state.parent / f"{state.name}.log"
        self.ready_file.unlink(missing_ok=True)
        command = [sys.executable, *program, "--state", str(state)]
        command += ["--trust-workers"] * trust_workers
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--ready-file", str(self.ready_file), *args],
                stdout=log,
                stderr=log,
                env={**os.environ, "XDG_STATE_HOME": str(state.parent / "xdg"), **environment},
            )
        if wait:
            self.await_ready()

    def await_ready(self) -> None:
        """Returns once it serves; a standby does when it leads."""
        deadline = time.monotonic() + TIMEOUT_S
        while not self.ready_file.exists():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.kill()
                raise AssertionError(f"coordinator did not become ready:\n{self.log.read_text()}")
            time.sleep(0.01)
        self.ready: dict[str, Any] = json.loads(self.ready_file.read_text())

    def credentials(self, role: Role) -> Credentials:
        return credentials.read_credentials(Path(self.ready["credentials"][role]))

    def kill(self) -> None:
        """SIGKILL: nothing is said, nothing is flushed."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> int:
        """SIGTERM, and the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=TIMEOUT_S)


def run(scenario: Callable[[], Coroutine[Any, Any, None]], within_s: float = 60.0) -> None:
    """Runs a scenario to its end, which has to come within that time."""
    asyncio.run(asyncio.wait_for(scenario(), within_s))


def bundle_of(source: str) -> Bundle:
    """A bundle with one policy.py; tests that need no policy's work put any text in it."""
    return bundles.pack([BundleFile("policy.py", False, source.encode())])


def _blob(data: bytes) -> BlobRef:
    return BlobRef(digest=hashlib.sha256(data).hexdigest(), size=len(data), inline=data)


def play(job: Job, spec: EpisodeSpec) -> EpisodeOutcome:
    """An outcome that depends on nothing but the bundle and the case."""
    text = f"{job.bundle}|{spec.case.seed}".encode()
    value = int.from_bytes(hashlib.sha256(text).digest()[:4], "big") / 2**32
    values = {"length": 10, "terminated": True, "truncated": False, "stdout": b"hello"}
    trajectory = _blob(b"trajectory of " + text)
    return EpisodeOutcome(index=spec.index, episode_return=value, trajectory=trajectory, **values)


class InstantWorker:
    """Leases jobs and reports `play(job, episode)` at once; registers again when its session is unknown."""

    def __init__(
        self,
        link: Link,
        name: str = "w-1",
        slots: int = 4,
        play: Callable[[Job, EpisodeSpec], EpisodeOutcome] = play,
        pause_s: float = 0.0,
        fingerprint: worker.Fingerprint = FINGERPRINT,
    ) -> None:
        self.name = name
        self.link = link
        self.slots = slots
        self.play = play
        self.fingerprint = fingerprint
        self.pause_s = pause_s
        """How long a batch takes."""
        self.session = ""
        self.jobs: list[Job] = []
        self.batches = 0
        self.hold = asyncio.Event()
        """While clear, leases are taken but nothing is reported."""
        self.hold.set()
        cluster = link.credentials.cluster
        self.ask = Requester(link, lambda verb: keys.worker_key(cluster, verb), codec.worker_replies)

    async def register(self, token: str | None = None) -> None:
        message = worker.Register(
            worker=self.name,
            token=self.link.credentials.token if token is None else token,
            protocol=codec.WIRE_VERSION,
            slots=self.slots,
            tiers=("bwrap",),
            environments=(LINE,),
            fingerprint=self.fingerprint,
            boot_id=f"kernel-of-{self.name}",
        )
        self.session = (await self.ask.until_answered("register", message, worker.Registered)).session
        beat = worker.Heartbeat(worker=self.name, session=self.session, held=())
        await self.ask.until_answered("beat", beat, worker.HeartbeatReply)

    def declare_alive(self) -> None:
        self.link.declare_alive(keys.liveliness_key(self.link.credentials.cluster, self.name))

    async def lease(self, n: int, wait_s: float = 1.0) -> tuple[worker.Lease, ...]:
        request = worker.LeaseRequest(worker=self.name, session=self.session, n=n, wait_s=wait_s)
        return (await self.ask.until_answered("lease", request, worker.Leases, wait_s=wait_s)).leases

    async def report_results(self, results: tuple[worker.JobResult, ...]) -> None:
        message = worker.ReportResults(worker=self.name, session=self.session, results=results)
        await self.ask.until_answered("done", message, worker.ResultsReported)

    def result(self, lease: worker.Lease) -> worker.JobResult:
        return worker.JobResult(
            lease_id=lease.lease_id,
            job_id=lease.job.job_id,
            attempt=lease.attempt,
            kind="done",
            episodes=tuple(self.play(lease.job, spec) for spec in lease.job.episodes),
        )

    async def work(self) -> None:
        """Works until cancelled."""
        registered = False
        leases: tuple[worker.Lease, ...] = ()
        while True:
            try:
                if not registered:
                    # The coordinator may end between the registration and its first heartbeat.
                    await self.register()
                    registered = True
                if not leases:
                    leases = await self.lease(self.slots)
                    self.jobs.extend(lease.job for lease in leases)
                    self.batches += bool(leases)
                await self.hold.wait()
                await asyncio.sleep(self.pause_s)
                if leases:
                    await self.report_results(tuple(self.result(lease) for lease in leases))
                leases = ()
            except RefusedError as error:
                if error.status != "unknown_worker":
                    raise
                registered = False


class GatewayClient:
    """Speaks for one run."""

    def __init__(self, link: Link, run: str, capability: str) -> None:
        self.run = run
        self.token = capability
        cluster = link.credentials.cluster
        self.ask = Requester(link, lambda verb: keys.gateway_key(cluster, run, verb), codec.gateway_replies)

    async def open(self) -> gateway.RunOpened:
        message = gateway.OpenRun(run=self.run, token=self.token, asks_permit=True)
        return await self.ask.until_answered("open", message, gateway.RunOpened)

    async def permit(self, boot_id: str, wait_s: float = 0.0) -> gateway.Permit:
        """The right that the agent may be alive on a kernel; `gateway_of` has one for a machine without workers."""
        message = gateway.RequestPermit(run=self.run, token=self.token, boot_id=boot_id, wait_s=wait_s)
        return await self.ask.until_answered("permit", message, gateway.Permit, wait_s=wait_s)

    async def state(self) -> gateway.RunState:
        message = gateway.StateRequest(run=self.run, token=self.token)
        return await self.ask.until_answered("state", message, gateway.RunState)

    async def submit(self, bundle: Bundle, ids: tuple[int, ...], key: str) -> gateway.SubmitAccepted:
        while True:
            await self.ask.upload(self.run, self.token, bundle.digest, bundle.packed)
            try:
                return await self.submit_digest(bundle.digest, ids, key)
            except RefusedError as error:
                # As a gateway does: a coordinator that was killed in between has forgotten who uploaded the bundle.
                if error.status != Refusal.MISSING_BUNDLE:
                    raise

    async def submit_digest(
        self, digest: str | None, ids: tuple[int, ...], key: str
    ) -> gateway.SubmitAccepted:
        message = gateway.Submit(run=self.run, token=self.token, key=key, env_instances=ids, bundle=digest)
        return await self.ask.until_answered("submit", message, gateway.SubmitAccepted)

    async def results(self, submit_index: int) -> tuple[list[gateway.EpisodeFeedback], gateway.SubmitDone]:
        """All feedback of a submit, in order of arrival, and its end."""
        episodes: list[gateway.EpisodeFeedback] = []
        cursor = 0
        while True:
            page = await self.page(submit_index, cursor, wait_s=2.0)
            episodes += page.episodes
            cursor = page.cursor
            if page.done is not None:
                return episodes, page.done

    async def page(self, submit_index: int, cursor: int = 0, wait_s: float = 0.0) -> gateway.ResultsPage:
        message = gateway.ResultsRequest(
            run=self.run, token=self.token, submit_index=submit_index, cursor=cursor, wait_s=wait_s
        )
        return await self.ask.until_answered("results", message, gateway.ResultsPage, wait_s=wait_s)

    async def close(self, reason: str = "agent_stopped") -> None:
        message = gateway.CloseRun(run=self.run, token=self.token, reason=reason)
        await self.ask.until_answered("close", message, gateway.RunClosed)


class OperatorClient:
    """Speaks for an operator."""

    def __init__(self, link: Link) -> None:
        self.token = link.credentials.token
        cluster = link.credentials.cluster
        self.ask = Requester(link, lambda verb: keys.operator_key(cluster, verb), codec.operator_replies)

    async def create(self, key: str = "run", **settings: Any) -> operator.RunCreated:
        usual = {"env": "toy/line", "entry": "tester", "model": "none", "exp_id": "t", "budget": 16}
        message = operator.CreateRun(token=self.token, key=key, settings=RunSettings(**{**usual, **settings}))
        return await self.ask.until_answered("create", message, operator.RunCreated)

    async def progress(self, run: str, wait_s: float = 2.0) -> operator.RunProgress:
        message = operator.WaitRun(token=self.token, run=run, wait_s=wait_s)
        return await self.ask.until_answered("wait", message, operator.RunProgress, wait_s=wait_s)

    async def finished(self, run: str) -> RunFinished:
        while True:
            progress = await self.progress(run)
            if progress.finished is not None:
                return progress.finished

    async def evaluate(self, key: str = "evaluation", **values: Any) -> list[EpisodeOutcome]:
        message = operator.Evaluate(token=self.token, key=key, env="toy/line", **values)
        started = await self.ask.until_answered("evaluate", message, operator.EvaluationStarted)
        outcomes: list[EpisodeOutcome] = []
        cursor = 0
        while True:
            poll = operator.EvaluationPoll(
                token=self.token, evaluation=started.evaluation, cursor=cursor, wait_s=2.0
            )
            page = await self.ask.until_answered("poll", poll, operator.EvaluationPage, wait_s=2.0)
            outcomes += page.outcomes
            cursor = page.cursor
            if page.finished:
                return outcomes

    async def status(self) -> StatusReply:
        return unfolded(await self.ask.until_answered("status", StatusRequest(token=self.token), StatusReply))


@contextlib.asynccontextmanager
async def operator_of(coordinator: Coordinator) -> AsyncIterator[OperatorClient]:
    async with connect(coordinator.credentials("operator")) as link:
        yield OperatorClient(link)


@contextlib.asynccontextmanager
async def gateway_of(
    coordinator: Coordinator, created: operator.RunCreated, boot_id: str = "agents"
) -> AsyncIterator[GatewayClient]:
    """The run's gateway, whose agent may be alive on that kernel."""
    async with connect(coordinator.credentials("gateway")) as link:
        client = GatewayClient(link, created.run, created.capability)
        with contextlib.suppress(RefusedError):  # of a run that is over
            await client.permit(boot_id)
        yield client


@contextlib.asynccontextmanager
async def working(
    coordinator: Coordinator, name: str = "w-1", **options: Any
) -> AsyncIterator[InstantWorker]:
    """A worker that works in the background."""
    async with connect(coordinator.credentials("worker")) as link:
        instant = InstantWorker(link, name, **options)
        task = asyncio.create_task(instant.work())
        try:
            yield instant
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, TransportError):
                await task


def comparable(finished: RunFinished) -> dict[str, Any]:
    """The part of a result that must not depend on restarts and retries: all but times and counts of retries."""
    plain: dict[str, Any] = msgspec.to_builtins(finished)
    own = ("run", "committed", "created_at", "finished_at", "wall_s", "infrastructure_retries")
    for name in own:
        del plain[name]
    for submit in plain["submits"]:
        del submit["started_at"], submit["completed_at"]
    return plain
