"""A worker with an old version is refused, or gets no work of a run of another version, with the reason.

The coordinator and the workers are the real processes, the sandbox too; `programs/old_worker.py` makes a worker old.
"""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from commands import process
from coordinator_harness import Coordinator, OperatorClient, bundle_of, gateway_of, operator_of
from typer.testing import CliRunner
from waiting import eventually

from evopolicy_common.messages import operator
from evopolicy_coordinator.cli.status import status_app

pytestmark = pytest.mark.system

EPISODES = 6
HIDDEN = 2

POLICY = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return [0.0]
"""


class Workers:
    """Worker processes of one coordinator, by name."""

    def __init__(self, coordinator: Coordinator, root: Path) -> None:
        self._coordinator = coordinator
        self._root = root
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.running = ExitStack()

    def start(self, name: str, how: str = "current") -> None:
        script = Path(__file__).with_name("programs") / "old_worker.py"
        options = ["--env", "toy/line", "--slots", "1", "--grace", "1", "--name", name]
        options += ["--credentials", self._coordinator.ready["credentials"]["worker"]]
        running = process(self._root / f"{name}.log", str(script), how, *options)
        self._processes[name] = self.running.enter_context(running)

    def log_of(self, name: str) -> str:
        return (self._root / f"{name}.log").read_text()

    async def ended(self, name: str) -> int:
        """The exit code, once there is one."""
        await eventually(lambda: self._processes[name].poll() is not None, f"{name} ends")
        return self._processes[name].wait()


@contextmanager
def cluster(root: Path) -> Iterator[tuple[Coordinator, Workers]]:
    coordinator = Coordinator(root / "state")
    workers = Workers(coordinator, root)
    try:
        with workers.running:
            yield coordinator, workers
    finally:
        coordinator.stop()


async def created(client: OperatorClient, name: str) -> operator.RunCreated:
    return await client.create(name, budget=EPISODES, n_validation=HIDDEN, n_heldout=HIDDEN)


async def shown(coordinator: Coordinator) -> str:
    """What `evopolicy status` prints."""
    arguments = ["--credentials", coordinator.ready["credentials"]["operator"]]
    return (await asyncio.to_thread(CliRunner().invoke, status_app, arguments)).stdout


async def test_worker_of_an_old_protocol_is_refused_with_the_reason(tmp_path: Path) -> None:
    with cluster(tmp_path) as (_, workers):
        workers.start("ancient", "old-protocol")
        assert await workers.ended("ancient") == 1
        assert "speaks wire version 0, the coordinator" in workers.log_of("ancient").splitlines()[-1]


async def test_a_worker_of_old_code_gets_no_work_and_is_told_why(tmp_path: Path) -> None:
    with cluster(tmp_path) as (coordinator, workers):
        async with operator_of(coordinator) as client:
            run = await created(client, "versions")
            async with gateway_of(coordinator, run) as gateway:
                workers.start("current")
                await gateway.submit(bundle_of(POLICY), (0,), "first")
                await gateway.results(0)
                workers.start("old", "old-code")
                why = "1.1+old here"
                await eventually(lambda: why in workers.log_of("old"), "it is told why")
                await gateway.submit(bundle_of(POLICY), (0, 1, 2), "second")
                await gateway.results(1)
                workers_shown = {one.worker: one for one in (await client.status()).workers}
                assert why in workers_shown["old"].refused[run.run]
                assert workers_shown["old"].held == 0
                assert why in await shown(coordinator)
                await gateway.close()
            finished = await client.finished(run.run)
            assert finished.fingerprint is not None
            assert finished.fingerprint.code_version == "current"
