"""A worker that reports what did not happen is caught by audits and named, next to honest ones that are not; and one
with an old version is refused with the reason.

The coordinator and the workers are the real processes, the sandbox too; what a worker cheats with is in
`programs/cheating_worker.py`.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from commands import evopolicy, process
from coordinator_harness import Coordinator, OperatorClient, bundle_of, gateway_of, operator_of
from typer.testing import CliRunner
from waiting import eventually

from evopolicy_common.messages import operator
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_coordinator.cli.status import status_app

pytestmark = pytest.mark.system

EPISODES = 6
HIDDEN = 2

CLOCK_POLICY = """
import os, random, time

class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.random = random.Random(os.urandom(8))

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return [(time.time_ns() % 1000) / 500.0 - self.random.random()]
"""


class Workers:
    """Worker processes of one coordinator, by name."""

    def __init__(self, coordinator: Coordinator, root: Path) -> None:
        self._coordinator = coordinator
        self._root = root
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.running = ExitStack()

    def start(self, name: str, how: str = "honest") -> None:
        script = Path(__file__).with_name("programs") / "cheating_worker.py"
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
def cluster(root: Path, *args: str) -> Iterator[tuple[Coordinator, Workers]]:
    coordinator = Coordinator(root / "state", *args)
    workers = Workers(coordinator, root)
    try:
        with workers.running:
            yield coordinator, workers
    finally:
        coordinator.stop()


async def created(client: OperatorClient, name: str) -> operator.RunCreated:
    return await client.create(name, budget=EPISODES, n_validation=HIDDEN, n_heldout=HIDDEN)


async def registered(client: OperatorClient, *names: str) -> None:
    """Until these workers are there: a run does not wait long for one that nobody has heard of."""

    async def there() -> bool:
        return set(names) <= {one.worker for one in (await client.status()).workers}

    await eventually(there, f"{names} register")


async def shown(coordinator: Coordinator) -> str:
    """What `evopolicy status` prints."""
    arguments = ["--credentials", coordinator.ready["credentials"]["operator"]]
    return (await asyncio.to_thread(CliRunner().invoke, status_app, arguments)).stdout


@pytest.mark.parametrize("how", ["rewards", "return"])
async def test_forger_among_three_workers_is_caught_named_and_gets_no_more_work(
    tmp_path: Path, how: str
) -> None:
    with cluster(tmp_path, "--audit", "1") as (coordinator, workers):
        async with operator_of(coordinator) as client:
            run = await created(client, "forged")
            async with gateway_of(coordinator, run) as gateway:
                workers.start("forger", how)
                await gateway.submit(bundle_of(CLOCK_POLICY), tuple(range(EPISODES)), "key")
                forged, _ = await gateway.results(0)
                workers.start("honest-1")
                workers.start("honest-2")

                async def caught() -> bool:
                    return bool((await client.status()).quarantined)

                await eventually(caught, "a forger is named")
                assert list((await client.status()).quarantined) == ["forger"]
                assert "forger is quarantined: forged results" in await shown(coordinator)
                assert await workers.ended("forger") != 0
                assert "gets no more work here" in workers.log_of("forger")
                workers.start("forger", "honest")
                await workers.ended("forger")
                assert "gets no more work here" in workers.log_of("forger").splitlines()[-1]
                await gateway.close()
                again, _ = await gateway.results(0)
                assert [one.episode_return for one in again] == [one.episode_return for one in forged]
            finished = await client.finished(run.run)
        found = finished.audit
        assert found is not None
        assert list(found.forgers) == ["forger"]
        assert found.forgers["forger"] >= EPISODES
        assert found.disputed >= EPISODES
        assert {finding.forger for finding in found.findings} == {"forger"}
        assert found.in_question
        assert finished.status == "completed"
        assert finished.budget_used == EPISODES
        events = [
            json.loads(line) for line in coordinator.log.read_text().splitlines() if line.startswith("{")
        ]
        assert {event["worker"] for event in events if event["event"] == "forger_named"} == {"forger"}


async def test_honest_workers_with_a_policy_that_reads_clocks_are_not_accused(tmp_path: Path) -> None:
    with cluster(tmp_path, "--audit", "1") as (coordinator, workers):
        async with operator_of(coordinator) as client:
            run = await created(client, "honest")
            async with gateway_of(coordinator, run) as gateway:
                workers.start("honest-1")
                workers.start("honest-2")
                await registered(client, "honest-1", "honest-2")
                await gateway.submit(bundle_of(CLOCK_POLICY), tuple(range(EPISODES)), "key")
                await gateway.results(0)
                await gateway.close()
            finished = await client.finished(run.run)
            found = finished.audit
            assert found is not None
            assert found.agreed == found.sampled == EPISODES + 3 * HIDDEN
            assert (found.disputed, found.forgers, found.not_audited) == (0, {}, {})
            assert not found.in_question
            reply = await client.status()
            assert (reply.quarantined, reply.disputes) == ({}, ())


async def test_two_workers_of_which_one_forges_are_both_in_dispute(tmp_path: Path) -> None:
    with cluster(tmp_path, "--audit", "1") as (coordinator, workers):
        async with operator_of(coordinator) as client:
            run = await created(client, "disputed")
            async with gateway_of(coordinator, run) as gateway:
                workers.start("forger", "rewards")
                await gateway.submit(bundle_of(CLOCK_POLICY), tuple(range(EPISODES)), "key")
                await gateway.results(0)
                workers.start("honest")
                await registered(client, "honest")
                await gateway.close()
            finished = await client.finished(run.run)
            found = finished.audit
            assert found is not None
            assert found.disputed >= EPISODES
            assert found.forgers == {}
            assert found.in_question
            assert (await client.status()).quarantined == {}
            assert "forger and honest disagree" in await shown(coordinator)


def test_audits_go_on_after_the_coordinator_was_killed(tmp_path: Path) -> None:
    async def before(coordinator: Coordinator, workers: Workers) -> operator.RunCreated:
        async with operator_of(coordinator) as client:
            run = await created(client, "killed")
            async with gateway_of(coordinator, run) as gateway:
                workers.start("honest-1")
                await gateway.submit(bundle_of(CLOCK_POLICY), tuple(range(EPISODES)), "key")
                await gateway.results(0)

            async def drawn() -> bool:
                return (await client.status()).audits.get("open", 0) >= EPISODES

            await eventually(drawn, "the episodes are drawn")
        return run

    async def after(coordinator: Coordinator, workers: Workers, run: operator.RunCreated) -> None:
        async with operator_of(coordinator) as client, gateway_of(coordinator, run) as gateway:
            workers.start("honest-2")
            await registered(client, "honest-1", "honest-2")
            await gateway.close()
            found = (await client.finished(run.run)).audit
        assert found is not None
        assert found.agreed == found.sampled == EPISODES + 3 * HIDDEN

    with cluster(tmp_path, "--audit", "1") as (coordinator, workers):
        run = asyncio.run(before(coordinator, workers))
        coordinator.kill()
        # The share is the run's own: a coordinator that asks for none goes on with it.
        second = Coordinator(coordinator.state)
        try:
            asyncio.run(after(second, workers, run))
        finally:
            workers.running.close()
            second.stop()


def test_audits_of_a_local_run_are_in_its_run_json(tmp_path: Path) -> None:
    command = ["local", "--env", "toy/line", "--agent", "random", "--entry", "tester", "--exp-id", "audited"]
    command += ["--budget", "2", "--validation", "1", "--heldout", "1", "--audit", "1"]
    done = evopolicy(tmp_path, *command, "--runs", "runs")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs" / "tester" / "toy_line" / "audited"
    found = decode_run_record((folder / "run.json").read_bytes()).audit
    assert found is not None
    assert found.share == 1.0
    # The second worker may come up when all is over.
    assert found.agreed + found.not_audited.get("one worker only", 0) == found.sampled >= 4
    warnings = [
        path for path in (folder / "workspace").rglob("*") if path.is_file() and b"audit" in path.read_bytes()
    ]
    assert warnings == [], "an agent is told nothing of audits"


async def test_worker_of_an_old_protocol_is_refused_with_the_reason(tmp_path: Path) -> None:
    with cluster(tmp_path) as (coordinator, workers):
        workers.start("ancient", "old-protocol")
        assert await workers.ended("ancient") == 1
        assert "speaks wire version 0, the coordinator" in workers.log_of("ancient").splitlines()[-1]
        async with operator_of(coordinator) as client:
            (turned_away,) = (await client.status()).turned_away
            assert turned_away.worker == "ancient"
            assert "wire version 0" in turned_away.why
        text = await shown(coordinator)
        assert "ancient" in text
        assert "speaks wire version 0" in text


async def test_a_worker_of_old_code_gets_no_work_and_is_told_why(tmp_path: Path) -> None:
    with cluster(tmp_path) as (coordinator, workers):
        async with operator_of(coordinator) as client:
            run = await created(client, "versions")
            async with gateway_of(coordinator, run) as gateway:
                workers.start("honest")
                await gateway.submit(bundle_of(CLOCK_POLICY), (0,), "first")
                await gateway.results(0)
                workers.start("old", "old-code")
                why = "1.1+old here"
                await eventually(lambda: why in workers.log_of("old"), "it is told why")
                await gateway.submit(bundle_of(CLOCK_POLICY), (0, 1, 2), "second")
                await gateway.results(1)
                workers_shown = {one.worker: one for one in (await client.status()).workers}
                assert why in workers_shown["old"].refused[run.run]
                assert workers_shown["old"].held == 0
                assert why in await shown(coordinator)
                await gateway.close()
            finished = await client.finished(run.run)
            assert finished.fingerprint is not None
            assert finished.fingerprint.code_version == "cheats"
            assert finished.audit is None
