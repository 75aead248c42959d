"""A coordinator's process and machines that reach it over TLS: a run through it, and a machine revoked in its midst.

Attacks, each with its defence:
- makes a command send its token over plain `tcp/` beyond loopback: refused by the coordinator and by every
  command.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import os
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Iterator
from pathlib import Path

import msgspec
import pytest
from commands import process
from coordinator_harness import (
    TIMEOUT_S,
    Coordinator,
    GatewayClient,
    InstantWorker,
    OperatorClient,
    bundle_of,
    comparable,
    operator_of,
)
from machines.own_certs import DAYS, OwnCerts, now, of

from evopolicy_common.errors import RefusedError, TransportError
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.wire import credentials
from evopolicy_common.wire.transport import connect

IDS = tuple(range(8))
POLICY = """
class Policy:
    def __init__(self, *spaces): pass
    def reset(self, episode_index): pass
    def act(self, obs): return 0
"""


@pytest.fixture
def certs(tmp_path: Path) -> OwnCerts:
    return OwnCerts(tmp_path)


@pytest.fixture
def coordinator(certs: OwnCerts) -> Iterator[Coordinator]:
    coordinator = Coordinator(certs.state, "--listen", certs.endpoint, "--hidden-isolation", "off")
    yield coordinator
    coordinator.kill()


@contextlib.asynccontextmanager
async def operators(folder: Path) -> AsyncIterator[OperatorClient]:
    async with connect(of(folder, "operator"), timeout_s=TIMEOUT_S) as link:
        yield OperatorClient(link)


@contextlib.asynccontextmanager
async def joined(folder: Path, name: str, slots: int = 4) -> AsyncIterator[InstantWorker]:
    """A worker on the machine of that folder, which has registered."""
    async with connect(of(folder), timeout_s=TIMEOUT_S) as link:
        worker = InstantWorker(link, name, slots)
        await worker.register()
        yield worker


@contextlib.asynccontextmanager
async def at_work(worker: InstantWorker) -> AsyncIterator[None]:
    task = asyncio.create_task(worker.work())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, TransportError):
            await task


async def play_run(operator: OperatorClient, gateway_folder: Path) -> RunFinished:
    created = await operator.create()
    async with connect(of(gateway_folder, "gateway"), timeout_s=TIMEOUT_S) as link:
        gateway = GatewayClient(link, created.run, created.capability)
        submit = await gateway.submit(bundle_of("policy"), IDS, "first")
        episodes, _ = await gateway.results(submit.submit_index)
        assert len(episodes) == len(IDS)
        await gateway.close()
    return await operator.finished(created.run)


async def refusal(answer: Awaitable[object]) -> str:
    """Why the coordinator does not do it."""
    with pytest.raises(RefusedError) as refused:
        await answer
    return refused.value.status


@pytest.mark.slow  # until the leases have run out
async def test_a_revoked_worker_loses_its_leases_to_an_honest_one(
    certs: OwnCerts, coordinator: Coordinator
) -> None:
    """Attack: uses a revoked machine's token or session on another path (a router, a socket of the
    coordinator's machine). Defence: every request is refused, its results are rejected, and its leases
    are played by others."""
    boss = certs.issue("operator", "boss")
    honest, cheat = certs.issue("worker", "honest"), certs.issue("worker", "cheat")
    async with operators(boss) as operator, joined(cheat, "cheat", slots=2) as revoked:
        playing = asyncio.create_task(play_run(operator, boss))
        leases = await revoked.lease(2, 30.0)
        assert leases
        certs.revoke("cheat")
        # Its results count no more, on whatever way they would come: here over this machine's own socket.
        async with connect(coordinator.credentials("worker")) as link:
            way_round = InstantWorker(link, "cheat")
            way_round.session = revoked.session
            assert await refusal(way_round.lease(1, 0.0)) == "revoked"
            assert await refusal(way_round.register(of(cheat).token)) == "bad_token"
            results = tuple(way_round.result(lease) for lease in leases)
            assert await refusal(way_round.report_results(results)) == "revoked"
            upload = way_round.ask.upload("cheat", revoked.session, "0" * 64, b"blob")
            assert await refusal(upload) == "revoked"
        async with joined(honest, "honest") as worker, at_work(worker):
            finished = await playing
        assert finished.status == "completed"
        stolen = {lease.job.job_id for lease in leases}
        assert stolen <= {job.job_id for job in worker.jobs}
    with pytest.raises(TransportError):
        async with connect(of(cheat), timeout_s=0.5):
            pass


async def test_a_revoked_operator_asks_for_nothing_more(certs: OwnCerts, coordinator: Coordinator) -> None:
    """Attack: uses a revoked machine's token or session on another path (a router, a socket of the
    coordinator's machine). Defence: every request is refused, its results are rejected, and its leases
    are played by others."""
    boss = certs.issue("operator", "boss")
    async with operators(boss) as operator:
        await operator.status()
    token = of(boss, "operator").token
    async with connect(msgspec.structs.replace(coordinator.credentials("operator"), token=token)) as link:
        await OperatorClient(link).status()
        certs.revoke("operator/boss")
        with pytest.raises(RefusedError, match="bad_token"):
            await OperatorClient(link).status()
    async with operator_of(coordinator) as own:
        await own.status()


async def test_machines_reconnect_after_an_issue_or_a_restart(certs: OwnCerts) -> None:
    boss, machine = certs.issue("operator", "boss"), certs.issue("worker", "w")
    first = Coordinator(certs.state, "--listen", certs.endpoint, "--hidden-isolation", "off")
    try:
        async with operators(boss) as operator, joined(machine, "w") as worker, at_work(worker):
            one = await play_run(operator, boss)
            assert (one.status, bool(worker.jobs)) == ("completed", True)
            certs.issue("worker", "late")
            first.kill()
            second = Coordinator(certs.state, "--listen", certs.endpoint, "--hidden-isolation", "off")
            try:
                created = await operator.create("again")
                async with connect(of(boss, "gateway"), timeout_s=TIMEOUT_S) as link:
                    gateway = GatewayClient(link, created.run, created.capability)
                    await gateway.submit(bundle_of("policy"), IDS, "first")
                    certs.issue("worker", "later")
                    await gateway.results(0)
                    await gateway.close()
                two = await operator.finished(created.run)
            finally:
                assert second.stop() == 0
        assert comparable(one)["submits"] == comparable(two)["submits"]
    finally:
        first.kill()


@pytest.mark.slow  # until the certificate is over, and the leases
@pytest.mark.system
async def test_a_worker_goes_on_with_a_renewed_certificate_in_a_run(
    certs: OwnCerts, coordinator: Coordinator
) -> None:
    boss = certs.issue("operator", "boss")
    machine = certs.issue("worker", "w")
    log = certs.root / "worker.log"
    arguments = ("--env", "toy/line", "--slots", "1", "--unsandboxed", "--credentials", str(machine))

    with process(log, "evopolicy_worker.cli", *arguments) as worker:
        async with operators(boss) as operator:
            created = await operator.create(sandbox_tier="none")
            async with connect(of(boss, "gateway"), timeout_s=TIMEOUT_S) as link:
                gateway = GatewayClient(link, created.run, created.capability)
                await gateway.submit(bundle_of(POLICY), IDS, "first")
                await gateway.results(0)
                soon = now() - dt.timedelta(days=DAYS) + dt.timedelta(seconds=8)
                certs.issue("worker", "w", soon, again=True)
                while (await operator.status()).workers[0].state != "lost":
                    assert worker.poll() is None, log.read_text()
                    await asyncio.sleep(0.2)
                await gateway.submit(bundle_of(POLICY), IDS, "second")
                certs.issue("worker", "w", again=True)
                episodes, _ = await gateway.results(1)
                assert len(episodes) == len(IDS)
                await gateway.close()
            assert (await operator.finished(created.run)).status == "completed"
        assert worker.poll() is None
    assert "renewed credentials are in use" in log.read_text()


def refused(*args: object) -> str:
    ended = subprocess.run(
        [sys.executable, "-m", "evopolicy_coordinator.cli", *map(str, args)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        env=os.environ,
    )
    assert ended.returncode == 2, ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    return ended.stderr


def test_listening_without_certificates_is_refused_with_the_remedy(tmp_path: Path) -> None:
    output = refused("--state", tmp_path / "state", "--listen", "tcp/0.0.0.0:7447")
    assert [text for text in ("certs init", "tls/0.0.0.0:7447", "--insecure-tcp") if text not in output] == []
    output = refused("--state", tmp_path / "state", "--listen", "tls/0.0.0.0:7447")
    assert f"certs init --state {tmp_path}/state" in output


def test_insecure_tcp_is_opt_in_and_announced(tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "state", "--listen", "tcp/0.0.0.0:0", "--insecure-tcp")
    try:
        found = coordinator.credentials("worker")
        assert found.insecure_tcp
        assert credentials.at(found, ("tcp/10.0.0.5:7447",)).endpoints == ("tcp/10.0.0.5:7447",)
        assert "unencrypted" in coordinator.log.read_text()
    finally:
        coordinator.kill()
