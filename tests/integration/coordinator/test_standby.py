"""Several coordinators on one PostgreSQL database: one leads, the others wait."""

from __future__ import annotations

import asyncio
import contextlib
import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from coordinator_harness import (
    Coordinator,
    GatewayClient,
    InstantWorker,
    OperatorClient,
    bundle_of,
    comparable,
    operator_of,
    run,
    working,
)
from cryptography.fernet import Fernet
from machines.own_certs import CLUSTER, DAYS, free_port, now, of
from machines.postgres import Server
from machines.weak_link import WeakLink
from prometheus_client import CollectorRegistry
from rich.console import Console

from evopolicy_common.errors import RefusedError, TransportError
from evopolicy_common.messages import gateway
from evopolicy_common.messages.operator import RunCreated
from evopolicy_common.messages.status import StatusReply, StatusRequest
from evopolicy_common.wire.credentials import Credentials, Role
from evopolicy_common.wire.transport import connect
from evopolicy_coordinator.cli.status import render
from evopolicy_coordinator.pki import machines
from evopolicy_coordinator.storage.engines import connect as connect_to_database
from evopolicy_coordinator.web.content.metrics import StatusCollector

pytestmark = pytest.mark.cluster

SUBMITS = (((0, 1, 1, 5), "# one"), ((2, 3), "# two"), ((7, 7, 7, 7, 8, 9), "# three"))
CHANGES = int(os.environ.get("EVOPOLICY_LEADER_CHANGES", "6"))
ROLES: tuple[Role, ...] = ("worker", "operator", "gateway")


def shown(status: StatusReply) -> str:
    console = Console(width=400, record=True, file=io.StringIO())
    console.print(render(status))
    return console.export_text()


class Pair:
    """Two coordinators with one key for the secrets, the same blobs, and a certificate each, and machines that know
    both. The second one's folder begins empty."""

    def __init__(self, root: Path, address: str) -> None:
        self.root, self.address = root, address
        self.endpoints = tuple(f"tls/127.0.0.1:{free_port()}" for _ in range(2))
        self.members: list[Coordinator] = []
        self.key = root / "seal-key"
        self.key.touch(mode=0o600)
        self.key.write_bytes(Fernet.generate_key())

    def start(self, secret: Path) -> None:
        root = self.root
        for index in range(2):
            folder = root / f"state-{index}"
            folder.mkdir(mode=0o700)
            if index == 0:
                shutil.copy(secret, folder / "secret")
            else:
                self._join(folder)
                (folder / "blobs").symlink_to(root / "state-0" / "blobs")
            machines.init(folder, CLUSTER, ("127.0.0.1",), now(), DAYS, anew=False)
            if index == 0:
                for role in ("worker", "operator"):
                    machines.issue(folder, CLUSTER, role, "m", self.endpoints, root / role, now(), DAYS)
            self.members.append(self.started(index, wait=index == 0))

    def _join(self, folder: Path) -> None:
        """As the guide says: the first start takes the secrets, and names the command for a certificate."""
        command = [sys.executable, "-m", "evopolicy_coordinator.cli", "--state", str(folder)]
        command += ["--store", self.address, "--listen", self.endpoints[1]]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "name the file with their key by --seal-key" in done.stderr
        assert not (folder / "identity.json").exists()
        done = subprocess.run(
            [*command, "--seal-key", str(self.key)], capture_output=True, text=True, check=False
        )
        assert "certs init --state" in done.stderr
        assert (folder / "secret").read_bytes() == (self.root / "state-0" / "secret").read_bytes()

    def started(self, index: int, *, wait: bool = False, address: str | None = None) -> Coordinator:
        options = ("--store", address or self.address, "--listen", self.endpoints[index])
        options += ("--seal-key", str(self.key))
        return Coordinator(self.root / f"state-{index}", *options, wait=wait)

    def credentials(self, role: Role) -> Credentials:
        return of(self.root / ("worker" if role == "worker" else "operator"), role)

    def await_standby(self) -> None:
        """Returns once one waits for the lock. A killed coordinator is back after the start of a process."""
        with contextlib.closing(connect_to_database(self.address, "ro", 10.0)) as db:
            while all(leads for _, leads in db.coordinators()):
                time.sleep(0.02)

    def leads_after(self, index: int) -> float:
        """Wall time until that coordinator serves, seconds."""
        began = time.monotonic()
        self.members[index].await_ready()
        return time.monotonic() - began

    def close(self) -> None:
        for each in self.members:
            each.kill()


@contextlib.contextmanager
def pair_of(root: Path, secret: Path, address: str) -> Iterator[Pair]:
    pair = Pair(root, address)
    try:
        pair.start(secret)
        yield pair
    finally:
        pair.close()


@contextlib.asynccontextmanager
async def clients(pair: Pair) -> AsyncIterator[tuple[OperatorClient, Callable[[RunCreated], GatewayClient]]]:
    """An operator, gateways and a worker that know both endpoints, each with one session for the whole test."""
    async with contextlib.AsyncExitStack() as opened:
        links = {role: await opened.enter_async_context(connect(pair.credentials(role))) for role in ROLES}
        task = asyncio.create_task(InstantWorker(links["worker"], pause_s=0.02).work())
        try:
            yield (
                OperatorClient(links["operator"]),
                lambda created: GatewayClient(links["gateway"], created.run, created.capability),
            )
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, TransportError):
                await task


async def patiently(ask: Callable[[], Any]) -> Any:
    """As a gateway asks: again while a coordinator cannot write."""
    while True:
        try:
            return await ask()
        except RefusedError as error:
            if error.status != "unavailable":
                raise
            await asyncio.sleep(0.05)


async def played(
    operator: OperatorClient, gateway_of: Callable[[RunCreated], GatewayClient]
) -> dict[str, Any]:
    """A run of three submits, and its result."""
    created = await patiently(operator.create)
    client = gateway_of(created)
    with contextlib.suppress(RefusedError):
        await patiently(lambda: client.permit("agents"))
    for number, (ids, source) in enumerate(SUBMITS):
        await patiently(lambda: client.submit(bundle_of(source), ids, f"submit-{number}"))  # noqa: B023
        episodes, done = await patiently(lambda: client.results(number))  # noqa: B023
        assert len({episode.index for episode in episodes}) == done.n_kept == len(ids)
    state: gateway.RunState = await patiently(client.state)
    assert state.n_submits == len(SUBMITS)
    assert state.remaining_budget == 16 - sum(len(ids) for ids, _ in SUBMITS)
    await patiently(client.close)
    return comparable(await patiently(lambda: operator.finished(created.run)))


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The secret of a coordinator on SQLite, and the result of an undisturbed run there."""
    state = tmp_path_factory.mktemp("calm") / "state"
    coordinator, found = Coordinator(state), list[dict[str, Any]]()

    async def scenario() -> None:
        async with (
            working(coordinator),
            operator_of(coordinator) as operator,
            connect(coordinator.credentials("gateway")) as link,
        ):
            found.append(await played(operator, lambda made: GatewayClient(link, made.run, made.capability)))

    try:
        run(scenario, 120)
    finally:
        coordinator.kill()
    return state / "secret", found[0]


def test_a_killed_leader_costs_time_and_nothing_else(
    tmp_path: Path, server: Server, calm: tuple[Path, dict[str, Any]]
) -> None:
    """A run plays while leaders are killed one after the other, as often as it lasts, at least three times."""
    secret, expected = calm
    took: list[float] = []

    async def scenario(pair: Pair) -> None:
        async with clients(pair) as (operator, gateway_of):
            ended = threading.Event()
            killing = asyncio.create_task(asyncio.to_thread(kill, pair, ended))
            runs = [await played(operator, gateway_of)]
            while len(took) < 3:
                await asyncio.sleep(0.2)
            ended.set()
            await killing
            assert runs == [expected]

    def kill(pair: Pair, ended: threading.Event) -> None:
        leader = 0
        while not ended.wait(0.4):
            pair.await_standby()
            pair.members[leader].kill()
            took.append(pair.leads_after(1 - leader))
            pair.members[leader] = pair.started(leader)
            leader = 1 - leader

    with pair_of(tmp_path, secret, server.new()) as pair:
        while "standby: waiting to lead" not in pair.members[1].log.read_text():
            time.sleep(0.05)
        assert not pair.members[1].ready_file.exists()
        run(lambda: scenario(pair), 180)
    print("another coordinator led after", [round(each, 2) for each in took], "s")


@pytest.mark.timeout(120 + 10 * CHANGES)
def test_many_leader_changes_lose_and_repeat_no_request(
    tmp_path: Path, server: Server, calm: tuple[Path, dict[str, Any]]
) -> None:
    """Leaders are killed or stopped in turn, as soon as they have answered three requests."""
    created: dict[str, str] = {}
    changes = 0

    async def scenario(pair: Pair) -> None:
        nonlocal changes
        async with clients(pair) as (operator, _):
            leader = 0
            while changes < CHANGES:
                for _ in range(3):
                    key = f"run-{len(created)}"
                    created[key] = (await patiently(lambda: operator.create(key))).run  # noqa: B023
                await asyncio.to_thread(pair.await_standby)
                end = pair.members[leader].kill if changes % 2 else pair.members[leader].stop
                # This one is sent while the leader ends.
                key = f"run-{len(created)}"
                asking = asyncio.create_task(patiently(lambda: operator.create(key)))  # noqa: B023
                await asyncio.to_thread(end)
                created[key] = (await asking).run
                pair.members[leader] = await asyncio.to_thread(pair.started, leader)
                leader, changes = 1 - leader, changes + 1

    with pair_of(tmp_path, calm[0], server.new()) as pair:
        run(lambda: scenario(pair), 60 + 10 * CHANGES)
        stored = server.query(pair.address, "SELECT key, run FROM runs")
        assert dict(stored) == created
        assert len(stored) == len(set(created.values())) == 4 * changes
    print(changes, "changes of the leader,", len(created), "requests")


def test_a_paused_leader_that_wakes_up_writes_nothing(
    tmp_path: Path, server: Server, calm: tuple[Path, dict[str, Any]]
) -> None:
    secret, expected = calm

    async def scenario(pair: Pair) -> None:
        first, second = pair.members
        async with clients(pair) as (operator, gateway_of):
            playing = asyncio.create_task(played(operator, gateway_of))
            await asyncio.sleep(0.3)
            os.kill(first.process.pid, signal.SIGSTOP)
            print(
                "another coordinator led after", round(await asyncio.to_thread(pair.leads_after, 1), 1), "s"
            )
            term = server.query(pair.address, "SELECT value FROM meta WHERE name = 'incarnation'")
            os.kill(first.process.pid, signal.SIGCONT)
            while first.log.read_text().count("standby: waiting to lead") < 1:
                await asyncio.sleep(0.05)
            assert await playing == expected
            assert server.query(pair.address, "SELECT value FROM meta WHERE name = 'incarnation'") == term
            # It became a standby, which leads when the other one is gone.
            first.ready_file.unlink(missing_ok=True)
            second.kill()
            await asyncio.to_thread(first.await_ready)
            status = await operator.status()
            assert status.host == socket.gethostname()
            assert status.store_latency_s is not None
            assert " ms, standby: none) ·" in shown(status)
            pair.members[1] = await asyncio.to_thread(pair.started, 1)
            while not (status := await operator.status()).standbys:
                await asyncio.sleep(0.1)
            assert f" ms, standby: {socket.gethostname()}) ·" in shown(status)
            sample = CollectorRegistry()
            sample.register(StatusCollector(lambda: status))
            assert sample.get_sample_value("evopolicy_standby", {"host": socket.gethostname()}) == 1

    with pair_of(tmp_path, secret, server.new()) as pair:
        run(lambda: scenario(pair), 180)


def test_a_leader_cut_from_the_database_stops_answering(
    tmp_path: Path, server: Server, calm: tuple[Path, dict[str, Any]]
) -> None:
    """All its packets to the server are held on the way; its clients still reach it."""
    secret, expected = calm

    held = WeakLink(("127.0.0.1", 0), ("127.0.0.1", server.port))
    with contextlib.closing(held), pair_of(tmp_path, secret, server.new()) as pair:
        pair.members[0].kill()
        pair.leads_after(1)
        pair.members[1].kill()
        through = pair.address.replace(f":{server.port}/", f":{held.port}/")
        server.passfile.write_text(server.passfile.read_text().replace(str(server.port), "*", 1))
        (tmp_path / "state-0" / "store").write_text(f"{through}\n")
        pair.members[0] = pair.started(0, wait=True, address=through)

        async def scenario() -> None:
            async with clients(pair) as (operator, gateway_of):
                created = await patiently(operator.create)
                client = gateway_of(created)
                assert (await client.state()).remaining_budget > 0
                with held.weak("stalled"):
                    with contextlib.suppress(TransportError):
                        while True:
                            await operator.ask.once(
                                "status", StatusRequest(token=operator.token), StatusReply
                            )
                            await asyncio.sleep(0.2)
                    while "has not confirmed the lead" not in pair.members[0].log.read_text():
                        await asyncio.sleep(0.05)
                assert await played(operator, gateway_of) == expected

        run(scenario, 180)
