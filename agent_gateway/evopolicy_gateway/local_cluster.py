"""A cluster of this machine's own, for as long as a command runs: a coordinator and a worker as child processes."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.scratch import scratch_folder
from evopolicy_gateway.children import Child

START_PATIENCE_S = 60.0
END_GRACE_S = 10.0
_RESTART_PAUSE_S = 0.5
_MAX_DEATHS = 10
_USAGE_ERROR = 2


class Cluster(msgspec.Struct, frozen=True, kw_only=True):
    """Where a local cluster can be reached; the coordinator's `--ready-file`."""

    cluster: str
    endpoints: tuple[str, ...]
    credentials: dict[str, str]
    """Paths of the credentials files by role."""
    state: str

    @property
    def operator_file(self) -> Path:
        return Path(self.credentials["operator"])


@contextlib.asynccontextmanager
async def local_cluster(
    env_ids: Sequence[str],
    *,
    slots: int,
    state: Path | None = None,
    data: Path | None = None,
    allow_packages: Sequence[str] = (),
    audit: float = 0.0,
) -> AsyncIterator[tuple[Cluster, asyncio.Task[None]]]:
    """The cluster inside the `async with`; everything is taken down at its end, whatever happens.

    `state` None: a folder that is thrown away. The task ends only with an error: a process of the cluster cannot be kept
    up. ConfigError when it does not come up. `audit`: share of the episodes that a second worker, brought up beside the
    first, plays again; the two divide the slots between them.
    """
    with contextlib.ExitStack() as folders:
        root = folders.enter_context(scratch_folder("local")) if state is None else state
        logs = root / "logs"
        ready_file = root / "ready.json"
        ready_file.unlink(missing_ok=True)
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        coordinator = [
            *_module("evopolicy_coordinator.cli"),
            "--state",
            str(root),
            "--ready-file",
            str(ready_file),
        ]
        if data is not None:
            coordinator += ["--data", str(data)]
        for package in allow_packages:
            coordinator += ["--allow-package", package]
        if audit:
            coordinator += ["--audit", str(audit)]
        held: list[Child] = []
        keepers: list[asyncio.Task[None]] = []
        try:
            keepers.append(asyncio.create_task(_keep(coordinator, logs / "coordinator.log", held)))
            cluster = await _ready(ready_file, keepers[0])
            # Who starts this cluster is the one who chooses the tiers of its runs.
            worker = [*_module("evopolicy_worker.cli"), "--grace", "1", "--unsandboxed"]
            worker += ["--credentials", cluster.credentials["worker"]]
            for env_id in env_ids:
                worker += ["--env", env_id]
            for package in allow_packages:
                worker += ["--allow-package", package]
            second = max(1, slots // 2) if audit else 0
            for name, n in (("worker", max(1, slots - second)), ("worker-2", second)):
                if n:
                    program = [*worker, "--slots", str(n)]
                    keepers.append(asyncio.create_task(_keep(program, logs / f"{name}.log", held)))
            failed = asyncio.create_task(_first_error(keepers))
            keepers.append(failed)
            yield cluster, failed
        finally:
            for task in keepers:
                task.cancel()
            await asyncio.gather(*keepers, return_exceptions=True)
            # The worker first: it hands back what it holds.
            for child in reversed(held):
                await child.end(END_GRACE_S)


async def _keep(program: list[str], log: Path, held: list[Child]) -> None:
    """Runs a program, again when it dies: both sides of a cluster go on where they were."""
    for _ in range(_MAX_DEATHS):
        child = await Child.start(program, log)
        held.append(child)
        code = await child.ended()
        held.remove(child)
        if code == _USAGE_ERROR:
            raise ConfigError(_said(child))
        await asyncio.sleep(_RESTART_PAUSE_S)
    raise ConfigError(f"{log.stem} ends again and again: {_said(child)}")


async def _ready(ready_file: Path, keeper: asyncio.Task[None]) -> Cluster:
    try:
        async with asyncio.timeout(START_PATIENCE_S):
            while not ready_file.exists():
                if keeper.done():
                    keeper.result()
                await asyncio.sleep(0.02)
    except TimeoutError as error:
        raise ConfigError(f"the local coordinator did not start within {START_PATIENCE_S:g} s") from error
    return msgspec.json.decode(ready_file.read_bytes(), type=Cluster)


async def _first_error(keepers: list[asyncio.Task[None]]) -> None:
    done, _ = await asyncio.wait(list(keepers), return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()


def _module(name: str) -> list[str]:
    return [sys.executable, "-P", "-m", name]


def _said(child: Child) -> str:
    return child.last_words() or f"see {child.log}"
