"""Environments that break on a real worker beside a sound one: told by name, charged to nobody, and the other slot goes
on."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from coordinator_harness import Coordinator, bundle_of, gateway_of, operator_of
from waiting import wait_until

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import operator

pytestmark = [pytest.mark.system, pytest.mark.slow]

PACKAGE = Path(__file__).parents[2] / "support" / "foreign_package"
POLICY = """
class Policy:
    def __init__(self, *spaces): pass
    def reset(self, episode_index): pass
    def act(self, obs): return [0.9]
"""
FILE = """
id = "acme/bad"
gymnasium_id = "acme_envs:Bad-v0"
[kwargs]
how = "{how}"
seeds_from = 100
"""
"""It keeps its word while it is tried out and measured, with small seeds, and breaks it in episodes that count."""
PROBLEMS = {
    "hang": "environment acme/bad, step 0: it has not returned for 4 s, the limit of one call",
    "hang in reset": "environment acme/bad, reset: it has not returned for 4 s",
    "exit": "environment acme/bad: its process ended while it played",
    "nan": "environment acme/bad, step 0, reward: it is nan",
    "raise in reset": "environment acme/bad, reset: it raised RuntimeError: no level of that seed",
    "change spaces": "environment acme/bad, reset, observation_space: it has changed",
}


@pytest.fixture
def worker(
    tmp_path: Path, coordinator: Coordinator, request: pytest.FixtureRequest
) -> Iterator[subprocess.Popen[bytes]]:
    home = tmp_path / "worker"
    home.mkdir()
    (home / "bad.toml").write_text(FILE.format(how=request.param))
    credentials = coordinator.ready["credentials"]["worker"]
    command = [sys.executable, "-P", "-m", "evopolicy_worker.cli", "--slots", "2", "--grace", "1"]
    command += ["--env", "bad.toml", "--env", "toy/line", "--env-timeout", "4", "--credentials", credentials]
    variables = {**os.environ, "PYTHONPATH": str(PACKAGE), "XDG_CACHE_HOME": str(home)}
    with (home / "log").open("wb") as log:
        process = subprocess.Popen(command, cwd=home, env=variables, stdout=log, stderr=log)
    yield process
    process.terminate()
    process.wait(timeout=60)


@pytest.mark.parametrize(("worker", "how"), [(how, how) for how in PROBLEMS], indirect=["worker"])
def test_a_broken_environment_is_reported_and_charges_nothing(
    tmp_path: Path, coordinator: Coordinator, worker: subprocess.Popen[bytes], how: str
) -> None:
    log = tmp_path / "worker" / "log"

    async def play() -> None:
        async with operator_of(coordinator) as ours:
            bad = await ours.create(key="bad", env="acme/bad", budget=4, exp_id="bad")
            good = await ours.create(key="good", budget=4, exp_id="good")
            async with gateway_of(coordinator, bad) as broken, gateway_of(coordinator, good) as sound:
                for each in (broken, sound):
                    while True:
                        try:
                            await each.open()
                            break
                        except RefusedError:  # until the worker has registered
                            await asyncio.sleep(0.2)
                await broken.submit(bundle_of(POLICY), (0, 1), "k")
                while coordinator.log.read_text().count("job_retried") < 4:
                    await asyncio.sleep(0.2)
                # Meanwhile the other slot plays.
                await sound.submit(bundle_of(POLICY), (0, 1, 2), "k")
                _, ended = await sound.results(0)
                assert ended.status == "ok"
                assert (await broken.page(0)).done is None
                assert (await broken.state()).remaining_budget == 2
                message = operator.CancelRun(token=ours.token, run=bad.run)
                await ours.ask.until_answered("cancel", message, operator.Done)
                finished = await ours.finished(bad.run)
                assert (finished.status, finished.budget_used, finished.submits) == ("cancelled", 0, ())
                assert (await sound.state()).remaining_budget == 1

    asyncio.run(play())
    assert PROBLEMS[how] in log.read_text()
    wait_until(lambda: PROBLEMS[how] in coordinator.log.read_text())
    assert worker.poll() is None
