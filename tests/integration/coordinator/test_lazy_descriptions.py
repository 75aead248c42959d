"""A worker that offers all environments at once: it starts without making one, and describes what a run waits for."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import STILL
from coordinator_harness import Coordinator
from waiting import wait_until

from evopolicy_common import catalogue
from evopolicy_common.messages.operator import DescribeEnvironment
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_common.wire import transport
from evopolicy_common.wire.operator_client import OperatorClient

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(400)]


class Cluster:
    """A coordinator that trusts nobody, and a worker."""

    program = (sys.executable, "-P", "-m", "evopolicy_gateway.cli")

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.coordinator = Coordinator(folder / "state", trust_workers=False)
        self.log = folder / "worker.log"
        self.worker: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        credentials = self.coordinator.ready["credentials"]["worker"]
        words = (
            "-P -m evopolicy_worker.cli --slots 1 --grace 1 --env classic_control --env toy_text --env mujoco"
        )
        command = [sys.executable, *words.split(), "--credentials", credentials]
        variables = {**os.environ, "XDG_CACHE_HOME": str(self.folder / "cache")}
        with self.log.open("wb") as log:
            self.worker = subprocess.Popen(command, env=variables, stdout=log, stderr=log)

    def stop(self) -> None:
        if self.worker is not None:
            self.worker.terminate()
            self.worker.wait(timeout=60)

    def says(self, *words: str) -> Any:
        credentials = self.coordinator.ready["credentials"]["operator"]
        done = subprocess.run(
            [*self.program, *words, "--json", "--credentials", credentials],
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=170,
        )
        assert done.returncode == 0, done.stderr + self.log.read_text()
        return json.loads(done.stdout)

    async def fingerprints(self, env: str) -> tuple[Fingerprint, ...]:
        """Of workers that offer the environment, as `rescore` asks for them."""
        async with transport.connect(self.coordinator.credentials("operator")) as link:
            found = await OperatorClient(link).describe(DescribeEnvironment(token="", env=env))
            assert not found.awaited
            return found.fingerprints

    def offered(self) -> tuple[set[str], set[str]]:
        """Ids that are described, and those that are not yet."""
        listed = self.says("envs")
        described = {each["description"]["env"] for each in listed if "description" in each}
        return described, {each["env"] for each in listed if each.get("described") is False}


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    found = Cluster(tmp_path)
    yield found
    found.stop()
    found.coordinator.stop()


def test_an_awaited_environment_is_described_and_kept_for_later_starts(cluster: Cluster) -> None:
    ids = {
        each
        for name in ("classic_control", "toy_text", "mujoco")
        for each in catalogue.suites()[name].environments
    }
    cluster.start()
    described, later = wait_until(lambda: found if any(found := cluster.offered()) else None)
    assert (described, later) == (set(), ids)
    env = "gymnasium/CartPole-v1"
    (scored,) = cluster.says("try", STILL, "--env", env, "--cases", "0,1")
    assert (scored["env"], scored["n_failed"]) == (env, 0)
    assert cluster.offered() == ({env}, ids - {env})
    # `verify` and `rescore` ask before they have anything played.
    asked = "gymnasium/Pendulum-v1"
    (fingerprint,) = asyncio.run(cluster.fingerprints(asked))
    assert "gymnasium" in fingerprint.packages
    assert asyncio.run(cluster.fingerprints("gymnasium/FetchReach-v4")) == ()
    known = {env, asked}
    assert cluster.offered() == (known, ids - known)
    cluster.stop()
    wait_until(lambda: not any(cluster.offered()))
    cluster.start()
    described, later = wait_until(lambda: found if env in (found := cluster.offered())[0] else None)
    assert (described, later) == (known, ids - known)
    listed = next(each for each in cluster.says("envs", "--env", env))
    assert listed["accepted"] == "ships"
    assert listed["description"]["step_us"] > 0
