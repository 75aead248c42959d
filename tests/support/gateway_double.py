"""The coordinator of one gateway: its real service and core in this process, over a real Zenoh session, and a worker
whose results are scripted. What a gateway is told (statuses, budgets, refusals, pages) is the core's."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import sqlite3
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import httpx
import msgspec
import numpy as np
from rigs.finished_run import mark_opened
from rigs.service_world import IDENTITY, Requested, World

from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import (
    BlobRef,
    EpisodeOutcome,
    EpisodeSpec,
    PolicyFailure,
    ResourceLimits,
)
from evopolicy_common.messages.gateway import CloseRun, RunOpened, RunState, Submit
from evopolicy_common.messages.run_settings import PUBLISHED, RunSettings
from evopolicy_common.messages.worker import BlobPut, Message, Refused
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.trajectory import Recorder
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import BundleFile
from evopolicy_common.wire import codec, credentials, keys, transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_gateway.cli.serve import progress_of
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.run.gateway import Gateway
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.submits.pipeline import SubmitPipeline
from evopolicy_gateway.workspace.agents_md import Urls

CLUSTER = IDENTITY.cluster
WORKER = "w-1"
HIDDEN_FROM = 1_000_000
"""Seeds of hidden cases. A train case's seed is its id."""
SUBMIT_WALL_S = 1800.0
N_HIDDEN = (16, 32)
"""Validation and held-out cases in the files, of which only runs of the published profile use all."""

BOX = {"type": "Box", "dtype": "float32"}
LINE = EnvironmentDescription(
    env="toy/line",
    env_version="toy/line (evopolicy, version 1)",
    obs_space=BOX | {"shape": [3], "low": [-2.0, -1.0, -1.5], "high": [2.0, 1.0, 1.5]},
    action_space=BOX | {"shape": [1], "low": [-1.0], "high": [1.0]},
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


def outcome(spec: EpisodeSpec, failure: PolicyFailure | None = None) -> EpisodeOutcome:
    """The outcome of an episode. If its case is odd, it includes the recording, which is otherwise uploaded before."""
    case = spec.case.seed
    packed = packed_episode(case)
    return EpisodeOutcome(
        index=spec.index,
        episode_return=-3.0 - case,
        length=3,
        terminated=False,
        truncated=True,
        failure=failure,
        reward_components={"reward_distance": -3.0},
        trajectory=BlobRef(digest=digest_of(packed), size=len(packed), inline=packed if case % 2 else None),
        stdout=b"hello\n",
    )


class _Gate(asyncio.Event):
    """An event that tells when it is cleared."""

    def __init__(self, on_clear: Callable[[], None]) -> None:
        super().__init__()
        self._on_clear = on_clear
        self.set()

    def clear(self) -> None:
        super().clear()
        self._on_clear()


class _Overheard:
    """A gateway's query on its way to the service, whose answer is heard."""

    def __init__(self, double: Double, query: transport.IncomingQuery, message: Message) -> None:
        self._double, self._query, self._message = double, query, message
        self.key, self.payload, self.arrived = query.key, query.payload, query.arrived

    def reply(self, payload: bytes, lane: int = 0) -> None:
        self._query.reply(self._double.heard(self._message, payload), lane)

    def drop(self) -> None:
        self._query.drop()


class Double:
    """Answers one run's gateway. Change its attributes to script what its worker does and what fails."""

    def __init__(self, run: RunOpened) -> None:
        self.run = run
        self.run_id = self.capability = ""
        """The run's id and its gateway's token, once it is answering."""
        self.asked: list[Message] = []
        self.submits: list[Submit] = []
        """Those that were accepted."""
        self.closed: CloseRun | None = None
        self.up = True
        """False: no question is answered."""
        self.go = _Gate(self._take_back)
        """While it is clear, the worker takes no episodes."""
        self.order: Callable[[int], list[int]] = lambda n: list(range(n))[::-1]
        """In which order a submit's episodes are reported. Those left out are never: the submit's wall time passes."""
        self.failures: dict[int, PolicyFailure] = {}
        """By request index."""
        self.lost: set[int] = set()
        """Cases whose recordings the coordinator's disk has lost, as after a restore from an older backup."""
        self.held_s: float | None = None
        """Told in place of how long hidden episodes have held the run up, which would take that long."""
        self.intercept: Callable[[Message], Message | None] = lambda message: None
        """Answers in the service's place, as another version's coordinator would."""
        self.world: World
        """The service and its store; `world.full = True` is a full disk."""
        self.scoring = asyncio.Event()
        """While it is set, hidden episodes that the worker plays do not end."""
        self._boot_id = "kernel-of-the-worker"
        self._session = ""
        self._held: dict[str, worker.Lease] = {}
        self._tasks: list[asyncio.Task[None]] = []

    # What a gateway asks.

    def on_queries(self, queries: list[transport.IncomingQuery]) -> None:
        served = []
        for query in queries:
            if not self.up:
                query.drop()
                continue
            message = codec.decode(codec.gateway_requests, query.payload)
            self.asked.append(message)
            answer = self.intercept(message)
            if answer is not None:
                query.reply(codec.encode(answer))
            else:
                served.append(_Overheard(self, query, message))
        self.world.service.on_queries(served)  # type: ignore[arg-type]

    def heard(self, message: Message, payload: bytes) -> bytes:
        """Notes the service's answer, and returns what the gateway gets."""
        answer = codec.decode(codec.gateway_replies, payload)
        if isinstance(message, Submit) and isinstance(answer, gateway.SubmitAccepted):
            if message.key not in {old.key for old in self.submits}:
                self.submits.append(message)
        elif isinstance(message, CloseRun) and isinstance(answer, gateway.RunClosed):
            self.closed = message
        if self.held_s is not None:
            if isinstance(answer, gateway.ResultsPage | RunState):
                return codec.encode(msgspec.structs.replace(answer, held_s=self.held_s))
            if isinstance(answer, RunOpened):
                state = msgspec.structs.replace(answer.state, held_s=self.held_s)
                return codec.encode(msgspec.structs.replace(answer, state=state))
        return payload

    # The coordinator.

    async def start(self, root: Path) -> None:
        """The service with this run, and its worker."""
        root.mkdir(exist_ok=True)
        run = self.run
        self.world = World(
            root,
            CoreSettings(),
            data=_write_cases(root / "data", run.n_env_instances),
            allowed_imports=run.allowed_imports,
            denied_imports=run.denied_imports,
        )
        await self.world.service.start()
        await self._register()
        created = await self._create("run")
        self.run_id, self.capability = created.run, created.capability
        self._tasks = [asyncio.create_task(self._work()), asyncio.create_task(self._beat())]

    async def stop(self) -> None:
        # Again until they end: asyncio.wait_for of Python 3.11 loses a cancellation that comes with its answer.
        while pending := [task for task in self._tasks if not task.done()]:
            for task in pending:
                task.cancel()
            await asyncio.wait(pending, timeout=1.0)
        ended = await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.world.service.stop()
        self.world.store.close()
        for end in ended:
            if isinstance(end, Exception):
                raise end

    def back_up(self, target: Path) -> None:
        """Copies the coordinator's database."""
        source, copy = (sqlite3.connect(path) for path in (self.world.root / "db", target))
        with contextlib.closing(source), contextlib.closing(copy):
            source.backup(copy)

    async def restore(self, backup: Path) -> None:
        """Another coordinator is started on that copy, without the bundles. The run is opened as its command does."""
        root, self.up = self.world.root, False
        await self.stop()
        for path in (*root.glob("db*"), *root.glob("blobs/*")):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        shutil.copy(backup, root / "db")
        self._held.clear()
        await self.start(root)
        self.up = True

    async def _create(self, key: str) -> operator.RunCreated:
        run = self.run
        settings = RunSettings(
            env=run.env.env,
            entry="e",
            model="m",
            exp_id=key,
            budget=run.episode_budget,
            min_episodes_per_submit=run.min_episodes_per_submit,
            max_episodes_per_submit=run.max_episodes_per_submit,
            n_validation=1,
            n_heldout=1,
            policy_scope=run.policy_scope,
            observations=run.observations,
            sandbox_tier=run.sandbox_tier,
            limits=msgspec.structs.replace(run.limits, submit_wall_s=SUBMIT_WALL_S),
        )
        if run.profile == "published":
            counts = {"n_validation": N_HIDDEN[0], "n_heldout": N_HIDDEN[1]}
            settings = msgspec.structs.replace(settings, **PUBLISHED, profile="published", **counts)
        message = operator.CreateRun(token="operate", key=key, settings=settings)
        created = await self._ask(keys.operator_key(CLUSTER, "create"), message)
        assert isinstance(created, operator.RunCreated), created
        return created

    async def score_another_run(self, boot_id: str) -> None:
        """A hidden episode of another run on the same cases is played on that kernel, until `scoring` is cleared."""
        self._boot_id = boot_id
        await self._register()
        created = await self._create("other")
        token = created.capability
        speaker: dict[str, Any] = {"run": created.run, "token": token}

        async def ask(verb: str, message: Message) -> Any:
            return await self._ask(keys.gateway_key(CLUSTER, created.run, verb), message)

        await ask("open", gateway.OpenRun(**speaker, asks_permit=True))
        await ask("permit", gateway.RequestPermit(**speaker, boot_id="kernel-of-another-agent"))
        bundle = bundles.pack([BundleFile("policy.py", False, b"class Policy: pass")])
        await ask("blob", _whole(bundle.packed, sender=created.run, token=token))
        await ask("submit", Submit(**speaker, key="k", env_instances=(0,), bundle=bundle.digest))
        asked = gateway.ResultsRequest(**speaker, submit_index=0, cursor=1, wait_s=1.0)
        while (await ask("results", asked)).done is None:
            pass
        self.scoring.set()
        await ask("close", CloseRun(**speaker, reason="agent_stopped"))
        while not self._held:
            await asyncio.sleep(0.01)

    async def cancel(self) -> None:
        """The operator cancels the run."""
        await self._order("cancel", operator.CancelRun(token="operate", run=self.run_id))

    async def agent_gone(self) -> None:
        """The operator says that the run's agent is not alive, from wherever it was."""
        await self._order("agent_gone", operator.AgentGone(token="operate", run=self.run_id))

    async def _order(self, verb: str, message: Message) -> None:
        answer = await self._ask(keys.operator_key(CLUSTER, verb), message)
        assert not isinstance(answer, Refused), answer

    def has_permit(self) -> bool:
        """Whether the run's agent may be alive somewhere."""
        core = self.world.service.host.core
        return core is not None and self.run_id in core.state.permits

    async def _ask(self, key: str, message: Message) -> Any:
        """Asks until there is an answer: while the core is loaded anew there is none."""
        while True:
            asked = Requested(key, message)
            self.world.service.on_queries([asked])  # type: ignore[list-item]
            answer = await asked.message()
            if answer is not None:
                return answer
            await asyncio.sleep(0.02)

    # The worker.

    async def _register(self) -> None:
        message = worker.Register(
            worker=WORKER,
            token="join",
            protocol=codec.WIRE_VERSION,
            slots=256,
            tiers=("bwrap", "none"),
            environments=(self.run.env,),
            fingerprint=worker.Fingerprint(code_version="1", python="3", packages={}, cpu="any"),
            boot_id=self._boot_id,
        )
        self._session = (await self._ask(keys.worker_key(CLUSTER, "register"), message)).session
        await self._tell("beat", worker.Heartbeat(worker=WORKER, session=self._session, held=()))

    async def _tell(self, verb: str, message: Message) -> Any:
        answer = await self._ask(keys.worker_key(CLUSTER, verb), message)
        if isinstance(answer, Refused):  # of a core that was loaded anew
            await self._register()
        return answer

    def _take_back(self) -> None:
        """Ends the poll that waits, so that it brings no lease."""
        if self._session:
            message = worker.LeaseRequest(worker=WORKER, session=self._session, n=0, wait_s=0.0)
            self.world.service.on_queries([Requested(keys.worker_key(CLUSTER, "lease"), message)])  # type: ignore[list-item]

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(2.0)
            held = tuple(worker.HeldLease(**_names(lease), running=True) for lease in self._held.values())
            await self._tell("beat", worker.Heartbeat(worker=WORKER, session=self._session, held=held))

    async def _work(self) -> None:
        while True:
            await self.go.wait()
            request = worker.LeaseRequest(worker=WORKER, session=self._session, n=256, wait_s=5.0)
            answer = await self._tell("lease", request)
            if isinstance(answer, worker.Leases):
                self._held |= {lease.lease_id: lease for lease in answer.leases}
            found = {spec.index: lease for lease in self._held.values() for spec in lease.job.episodes}
            if not found:
                continue
            if any(spec.case.seed >= HIDDEN_FROM for lease in found.values() for spec in lease.job.episodes):
                while self.scoring.is_set():
                    await asyncio.sleep(0.01)
                await self._report_results(list(found.values()))
            elif not self.submits or len(found) == len(self.submits[-1].env_instances):
                await self._play(found)

    async def _play(self, found: dict[int, worker.Lease]) -> None:
        """Hands a submit's episodes in, one after another."""
        order = self.order(len(found))
        for index in order:
            # With policy scope `submit`, one lease has all episodes.
            if found[index].lease_id in self._held:
                await self._report_results([found[index]])
        if len(order) < len(found):
            self.world.service.host._unix_offset += SUBMIT_WALL_S + 1.0
            self.world.service.host._on_timer()
            # The leases live meanwhile: an expired one would be a fault of ours, after which the limit begins again.
            while self._plays_train():
                await asyncio.sleep(0.05)
            self._held.clear()

    def _plays_train(self) -> bool:
        core = self.world.service.host.core
        return core is not None and any(group.kind == "train" for group in core.state.groups.values())

    async def _report_results(self, leases: list[worker.Lease]) -> None:
        for lease in leases:
            episodes = tuple(outcome(spec, self.failures.get(spec.index)) for spec in lease.job.episodes)
            for each in episodes:
                if each.trajectory is not None and each.trajectory.inline is None:
                    await self._upload(packed_episode(_case_of(lease, each.index)))
            results = (worker.JobResult(**_names(lease), kind="done", episodes=episodes),)
            report = worker.ReportResults(worker=WORKER, session=self._session, results=results)
            await self._tell("done", report)
            self._held.pop(lease.lease_id, None)
            for case in self.lost & {_case_of(lease, each.index) for each in episodes}:
                self.world.blobs.delete(digest_of(packed_episode(case)))

    async def _upload(self, data: bytes) -> None:
        await self._tell("blob", _whole(data, sender=WORKER, token=self._session))


def _names(lease: worker.Lease) -> dict[str, Any]:
    return {"lease_id": lease.lease_id, "job_id": lease.job.job_id, "attempt": lease.attempt}


def _case_of(lease: worker.Lease, index: int) -> int:
    return next(spec.case.seed for spec in lease.job.episodes if spec.index == index)


def _whole(data: bytes, **sender: str) -> BlobPut:
    return BlobPut(digest=digest_of(data), size=len(data), offset=0, data=data, **sender)


def _write_cases(folder: Path, n_train: int) -> Path:
    first = [HIDDEN_FROM + n for n in (0, N_HIDDEN[0], sum(N_HIDDEN))]
    splits = {"train": range(n_train), "valid": range(*first[:2]), "heldout": range(*first[1:])}
    for stem, seeds in splits.items():
        path = folder / "toy_line" / f"{stem}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        cases = [{"seed": seed} for seed in seeds]
        path.write_text(json.dumps({"env": "toy/line", "split": stem, "cases": cases}))
    return folder


@contextlib.asynccontextmanager
async def answering(folder: Path, double: Double) -> AsyncIterator[Credentials]:
    """The double listening on a unix socket in `folder`; the credentials of its gateway."""
    (folder / "passwords").write_text("gateway:secret\n")
    endpoint = f"unixsock-stream/{folder}/sock"
    config = transport.server_config(CLUSTER, [endpoint], folder / "passwords", [("gateway", "gateway")])
    await double.start(folder / "coordinator")
    try:
        async with transport.serve(config, double.on_queries) as server:
            server.declare([keys.requests(CLUSTER)["gateway"]])
            known = {"cluster": CLUSTER, "user": "gateway", "password": "secret", "token": double.capability}
            yield Credentials(role="gateway", endpoints=(endpoint,), **known)
    finally:
        await double.stop()


def prepare(root: Path, found: Credentials, double: Double) -> RunFolder:
    """A run folder as `evopolicy run` leaves it for a gateway."""
    folder = RunFolder(root)
    folder.state.mkdir(parents=True, mode=0o700, exist_ok=True)
    credentials.write(found, folder.credentials)
    mark_opened(folder, double.run_id)
    return folder


@contextlib.asynccontextmanager
async def prepared(root: Path, double: Double | None = None) -> AsyncIterator[tuple[RunFolder, Double]]:
    """A double that answers, and a run folder in `root` for its gateway."""
    double = double or Double(opened())
    async with answering(root, double) as found:
        yield prepare(root / "run", found, double), double


class Served(msgspec.Struct, frozen=True):
    """A gateway that serves, and what a test looks at."""

    waits: list[str]
    """The reasons for waiting that it has reported."""
    progress: list[child_messages.TrainProgress]
    """All that it has reported."""
    double: Double
    folder: RunFolder
    gateway: Gateway
    task: asyncio.Task[bool]
    urls: Urls
    pipeline: SubmitPipeline
    http: httpx.AsyncClient

    async def submit(self, env_instances: object, *, wait: bool = True, key: str = "") -> httpx.Response:
        """Its answer to a submit; `key`: of idempotency."""
        url = self.urls.submit + ("" if wait else "?wait=false")
        headers = {"Idempotency-Key": key} if key else {}
        return await self.http.post(url, json={"env_instances": env_instances}, headers=headers)

    async def info(self) -> dict[str, Any]:
        found: dict[str, Any] = (await self.http.get(self.urls.info)).json()
        return found

    async def close(self, reason: str = "agent_stopped") -> bool:
        self.gateway.tell(child_messages.CloseGateway(reason=reason))
        return await self.task


@contextlib.asynccontextmanager
async def gateway_on(folder: RunFolder, double: Double) -> AsyncIterator[Served]:
    """A gateway on that folder; stopped without closing the run at the end, if it still serves."""
    waits: list[str] = []
    progress: list[child_messages.TrainProgress] = []
    ready: asyncio.Future[tuple[Urls, SubmitPipeline]] = asyncio.get_running_loop().create_future()
    gateway = Gateway(
        folder,
        on_ready=lambda urls, pipeline: ready.set_result((urls, pipeline)),
        on_change=lambda pipeline: progress.append(progress_of(pipeline.machine)),
        on_wait=waits.append,
    )
    task = asyncio.create_task(gateway.run())
    await asyncio.wait([task, ready], return_when=asyncio.FIRST_COMPLETED)
    if task.done():
        task.result()
    urls, pipeline = ready.result()
    async with httpx.AsyncClient(timeout=30.0, trust_env=False) as client:
        yield Served(waits, progress, double, folder, gateway, task, urls, pipeline, client)
    gateway.tell(None)
    await task


@contextlib.asynccontextmanager
async def served(tmp_path: Path, double: Double | None = None) -> AsyncIterator[Served]:
    """Double and gateway together in `tmp_path`."""
    async with prepared(tmp_path, double) as known, gateway_on(*known) as service:
        yield service
