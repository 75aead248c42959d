"""A cluster on this machine for the duration of a command: a coordinator and its workers as child processes.

Rules: they end with the command, however it ends; workers end first, so that they return their leases. A process that
dies is restarted and resumes its work. One that refuses its options, or dies repeatedly, is an error.

Commands with one state folder share the cluster: each brings a coordinator and workers. One coordinator serves; the
others wait, and one of them takes its place when it ends, however it ends. Every worker plays episodes of all commands.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.cli.conventions import FAILURE, USAGE_ERROR
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes import proc
from evopolicy_common.processes.child_process import ChildProcess, last_words
from evopolicy_common.processes.notices import notify_if_slow, notify_of_many_slots
from evopolicy_common.processes.preflight import LOCAL, check_installed, check_scratch, check_writable
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.open_run import is_held
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.credentials import WORKERS, ReadyCluster, read_ready
from evopolicy_common.wire.operator_client import OperatorClient

T = TypeVar("T")
START_TIMEOUT_S = 60.0
END_GRACE_S = 10.0
_RESTART_PAUSE_S = 0.5
_LOOK_S = 5.0
"""Between searches for runs of killed commands, seconds."""
_LONGEST_PAUSE_S = 5.0
_MAX_DEATHS = 10
"""Number of successive deaths, each within `_SOON_S` seconds of its start, that counts as an error."""
_SOON_S = 60.0
_IN_VAIN = ("ModuleNotFoundError: ", "ImportError: ", "SyntaxError: ")
"""Beginnings of last words after which another start would end in the same way."""


class Workers(NamedTuple):
    """The options of a local cluster's workers; see `LocalCluster.start_workers`."""

    env_ids: Sequence[str]
    slots: int | None = None
    tiers: Collection[Tier] = ()


class LocalCluster:
    """A running coordinator, with methods that start its workers."""

    def __init__(
        self,
        ready: ReadyCluster,
        processes: _Processes,
        start_workers: Callable[[Workers], Awaitable[None]],
        kept: Path | None,
    ) -> None:
        self.operator_file = Path(ready.credentials["operator"])
        self.failed = processes.failed
        """Completes only with a ConfigError, which names the process that cannot be kept running, and the reason."""
        self._start_workers = start_workers
        self._kept = kept
        """Folder of the records of `opened`; None for a temporary state folder."""
        self.note = ready.note
        """A note for the operator on the cases of new runs; empty for none."""

    def opened(self, run: str, locks: Sequence[Path]) -> None:
        """Records the locks of a run's agent supervisors: the agent is alive only while one of them is held."""
        if self._kept is not None:
            write_atomically(self._kept / run, "\n".join(map(str, locks)).encode(), mode=0o600)

    async def start_workers(
        self, env_ids: Sequence[str], *, slots: int | None = None, tiers: Collection[Tier] = ()
    ) -> None:
        """Starts a worker that offers these environments, or one from each virtual environment that they need, with all
        slots each: they are rarely busy at the same time, and a slot that waits for an episode takes no processor time.

        `slots` None: one for each core. `tiers`: sandbox tiers that will be used. If one does not work here, the
        cluster fails with the remedy.
        """
        await self._start_workers(Workers(env_ids, slots, tiers))


async def _start_workers(
    processes: _Processes, locks: Path, options: Sequence[str], credentials: Sequence[str], wanted: Workers
) -> None:
    notify_of_many_slots(wanted.slots or 0)
    locks.mkdir(mode=0o700, exist_ok=True)
    for python, env_ids in installs.divided(wanted.env_ids).items():
        # --unsandboxed: whoever starts this cluster also chooses the tiers of its runs.
        program = [*_module("evopolicy_worker.cli", python), "--grace", "1", "--unsandboxed", *credentials]
        program += [*options, *_options([("--env", catalogue.source_of(env_id)) for env_id in env_ids])]
        program += _options([("--need-tier", tier) for tier in sorted(wanted.tiers)])
        own = "" if python == sys.executable else f"-{Path(python).parents[1].name}"
        program += ["--name", name := proc.new_worker_name(), *_options([("--slots", wanted.slots)])]
        await processes.keep_up(f"worker{own}", program, locks / name)


@contextlib.asynccontextmanager
async def local_cluster(
    kind: str,
    *,
    state: Path | None = None,
    data: Path | None = None,
    hidden_isolation: str | None = None,
    unjailed: bool = False,
    workers: Workers | None = None,
    policy_packages: Sequence[str] = (),
    env_timeout: float | None = None,
    env_memory: int | None = None,
) -> AsyncIterator[LocalCluster]:
    """A coordinator, open inside the `async with`; it and its workers are ended on exit. Enter it on the main thread.

    `kind` names its logs and its folder. `state` None: a temporary folder. `hidden_isolation`: the coordinator's
    option, None for its default. `unjailed`: agents could read the folder; see the coordinator's `--unjailed-agents`.
    `policy_packages`: those that policies may import besides numpy. `env_timeout`, `env_memory`: the workers' options
    (seconds, MiB), None for their defaults. `workers`: workers to start at once, in parallel with the coordinator.
    Raises ConfigError when the coordinator does not start: another one may use the folder, or a local cluster with
    other options.
    """
    with contextlib.ExitStack() as folders:
        root = folders.enter_context(scratch_folder(kind)) if state is None else state
        check_installed(LOCAL)
        if workers is not None:
            installs.divided(workers.env_ids)  # what nothing here can play is told before anything starts
        check_scratch()  # workers keep their sandboxes there
        check_writable(root, "--state or XDG_STATE_HOME")
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Named after this process: the folder may be in use, and another command's file in it.
        ready_file = root / f"{kind}-{os.getpid()}.json"
        for stale in root.glob(f"{kind}-[0-9]*.*"):
            if not Path("/proc", stale.stem.rpartition("-")[2]).exists():
                stale.unlink(missing_ok=True)
        ready_file.unlink(missing_ok=True)
        folders.callback(ready_file.unlink, missing_ok=True)
        packages = _options([("--policy-package", name) for name in policy_packages])
        own = {
            "--data": data and data.absolute(),
            "--hidden-isolation": hidden_isolation,
        }
        place = ("--state", str(root), "--ready-file", str(ready_file), "--trust-workers")
        coordinator = [*_module("evopolicy_coordinator.cli"), *place, *_options(own.items()), *packages]
        if unjailed and state is not None:
            coordinator += ["--unjailed-agents"]
        limits = {"--env-timeout": env_timeout, "--env-memory": env_memory}
        shared = {
            "--data": own["--data"],
            "--hidden-isolation": hidden_isolation or "related",
            "--policy-package": ", ".join(sorted(policy_packages)),
            "env_timeout": env_timeout,
            "env_memory": env_memory,
            "--jail or --tier": "none" if unjailed else None,
        }
        given = {name: str(value) for name, value in shared.items() if value}
        coordinator += ["--local", json.dumps(given)]
        worker_options = [*packages, *_options(limits.items())]
        processes = _Processes(root / "logs", kind)
        start = partial(_start_workers, processes, root / WORKERS, worker_options)
        watching = None
        try:
            await processes.keep_up("coordinator", coordinator)
            if workers is not None:
                # In parallel with the coordinator: meanwhile they import simulators and test sandboxes.
                await start(("--ready-file", str(ready_file)), workers)
            try:
                with notify_if_slow(f"the local coordinator to start; its log is in {root / 'logs'}"):
                    async with asyncio.timeout(START_TIMEOUT_S):
                        ready = await read_ready(ready_file, processes.failed)
            except TimeoutError as error:
                why = last_words(processes.log("coordinator")) or "no output"
                text = f"the local coordinator did not start within {START_TIMEOUT_S:g} s: {why}"
                raise ConfigError(text) from error
            kept = None if state is None else root / "open"
            if kept is not None:
                kept.mkdir(mode=0o700, exist_ok=True)
                killed = partial(_end_permits_of_killed, kept, Path(ready.credentials["operator"]))
                await killed()
                watching = asyncio.create_task(_repeat(killed))
            joining = partial(start, ("--credentials", ready.credentials["worker"]))
            yield LocalCluster(ready, processes, joining, kept)
        finally:
            if watching is not None:
                watching.cancel()
                await asyncio.gather(watching, return_exceptions=True)
            with notify_if_slow("the local cluster to end"):
                await processes.end()


async def _end_permits_of_killed(kept: Path, operator_file: Path) -> None:
    """Ends the permits of agents whose commands were killed: the kernel has ended these agents."""
    watched: dict[str, list[str]] = {}
    for path in kept.glob("[!.]*"):
        with contextlib.suppress(FileNotFoundError):  # another command has ended it
            watched[path.name] = path.read_text().splitlines()
    gone = [run for run, locks in watched.items() if not any(is_held(Path(lock)) for lock in locks)]
    if not gone:
        return
    async with transport.connect(credentials.find("operator", (), operator_file)) as link:
        operator = OperatorClient(link)
        alive = {run.run for run in (await operator.status()).runs if run.agent_host}
        for run in gone:
            if run in alive:
                await operator.agent_gone(run)
            (kept / run).unlink(missing_ok=True)


@contextlib.contextmanager
def _locked(path: Path | None) -> Iterator[tuple[int, ...]]:
    """The descriptor of a lock on this file, for a process that keeps it open; nothing for None. The file has the id of
    this command."""
    if path is None:
        yield ()
        return
    new = path.with_name(f".{path.name}")  # a coordinator never sees the file without its lock
    fd = os.open(new, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        os.pwrite(fd, str(os.getpid()).encode(), 0)
        new.rename(path)
        yield (fd,)
    finally:
        os.close(fd)


async def _repeat(work: Callable[[], Awaitable[None]]) -> None:
    """For the runs of a command that is killed while others share its cluster."""
    while True:
        await asyncio.sleep(_LOOK_S)
        with contextlib.suppress(EvopolicyError):  # no coordinator serves at the moment
            await work()


async def unless_failed(work: asyncio.Task[T], failed: asyncio.Future[None] | None) -> T:
    """The result of `work`, or the local cluster's error if that is first. `failed` None: it is not ours."""
    try:
        both: list[asyncio.Future[Any]] = [work, *([failed] if failed else [])]
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        if failed is not None and failed.done() and not work.done():
            failed.result()
        return await work
    finally:
        if not work.done():
            if not work.cancelling():
                work.cancel()
            await asyncio.gather(work, return_exceptions=True)


class _Processes:
    """Programs that are restarted until all of them are ended."""

    def __init__(self, logs: Path, kind: str) -> None:
        self.failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._logs, self._kind = logs, kind
        self._running: list[ChildProcess] = []
        self._restarting: list[asyncio.Task[None]] = []

    def log(self, name: str) -> Path:
        return self._logs / f"{self._kind}-{name}.log"

    async def keep_up(self, name: str, program: Sequence[str], lock: Path | None = None) -> None:
        """`lock`: a file that each of these processes holds locked until its end."""
        child = await self._start(name, program, lock)
        restarting = asyncio.create_task(self._keep_up(child, name, program, lock))
        restarting.add_done_callback(self._given_up)
        self._restarting.append(restarting)

    async def end(self) -> None:
        for task in self._restarting:
            task.cancel()
        await asyncio.gather(*self._restarting, return_exceptions=True)
        if not self.failed.cancel():
            self.failed.exception()  # retrieved, so that asyncio does not report it as never retrieved
        for child in reversed(self._running):
            await child.end(END_GRACE_S)

    async def _keep_up(
        self, child: ChildProcess, name: str, program: Sequence[str], lock: Path | None
    ) -> None:
        deaths, began = 0, time.monotonic()
        while True:
            code = await child.ended()
            self._running.remove(child)
            deaths = deaths + 1 if time.monotonic() - began < _SOON_S else 1
            reason = child.last_words() or f"see {child.log}"
            if code == USAGE_ERROR:
                raise ConfigError(reason)
            if code == FAILURE and reason.startswith(_IN_VAIN):
                raise ConfigError(f"{name} does not start: {reason}; see {child.log}")
            if deaths == _MAX_DEATHS:
                raise ConfigError(f"{name} keeps ending: {reason}")
            await asyncio.sleep(min(_LONGEST_PAUSE_S, _RESTART_PAUSE_S * 2 ** (deaths - 1)))
            began = time.monotonic()
            child = await self._start(name, program, lock)

    async def _start(self, name: str, program: Sequence[str], lock: Path | None) -> ChildProcess:
        with _locked(lock) as keeps:
            child = await ChildProcess.start(program, self.log(name), keeps=keeps)
        self._running.append(child)
        return child

    def _given_up(self, restarting: asyncio.Task[None]) -> None:
        if not restarting.cancelled() and not self.failed.done():
            error = restarting.exception()
            assert error is not None
            self.failed.set_exception(error)


def _options(given: Iterable[tuple[str, object | None]]) -> list[str]:
    return [word for name, value in given if value is not None for word in (name, str(value))]


def _module(name: str, python: str = sys.executable) -> list[str]:
    return [python, "-P", "-m", name]
