"""A coordinator whose rows are in PostgreSQL: a killed server, a moved state, commands, passwords."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from coordinator_harness import Coordinator, bundle_of, comparable, gateway_of, operator_of, run, working
from machines.postgres import Server

from evopolicy_common.errors import ConfigError, LeadLostError, RefusedError, StorageError
from evopolicy_common.messages.operator import RunCreated
from evopolicy_coordinator.storage import backup, disk_use
from evopolicy_coordinator.storage.engines import DATABASE, connect, place_of
from evopolicy_coordinator.storage.moving import MOVED, move
from evopolicy_coordinator.storage.store import TABLES, Reader, Store

pytestmark = pytest.mark.cluster

GOLDEN_STATE = Path(__file__).parents[2] / "conformance" / "protocol" / "golden_state" / "state"
SUBMITS = (((0, 1, 1, 5), "# one"), ((2, 3), "# two"), ((7, 7, 7, 7, 8, 9), "# three"))


@pytest.fixture
def golden(tmp_path: Path) -> Path:
    """The golden state, to be changed."""
    shutil.copytree(GOLDEN_STATE, tmp_path / "golden")
    (tmp_path / "golden").chmod(0o700)
    (tmp_path / "golden" / "signing-key").chmod(0o600)
    return tmp_path / "golden"


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The secret of a coordinator on SQLite, and the result of a run there."""
    state = tmp_path_factory.mktemp("calm") / "state"
    coordinator, found = Coordinator(state), list[dict[str, Any]]()

    async def scenario() -> None:
        async with working(coordinator), operator_of(coordinator) as operator:
            created = await operator.create()
            for number in range(3):
                await submit(coordinator, created, number)
            found.append(await ended(coordinator, created))

    try:
        run(scenario, 120)
    finally:
        coordinator.kill()
    return state / "secret", found[0]


@contextlib.contextmanager
def serving(state: Path, secret: Path, *args: str) -> Iterator[Coordinator]:
    """A coordinator with the cases of another."""
    if not state.exists():
        state.mkdir(mode=0o700)
        shutil.copy(secret, state / "secret")
    coordinator = Coordinator(state, *args)
    try:
        yield coordinator
    finally:
        coordinator.kill()


async def submit(coordinator: Coordinator, created: RunCreated, number: int) -> None:
    ids, source = SUBMITS[number]
    async with gateway_of(coordinator, created) as gateway:
        await gateway.submit(bundle_of(source), ids, f"submit-{number}")
        episodes, done = await gateway.results(number)
        assert len({episode.index for episode in episodes}) == done.n_kept == len(ids)


async def patiently(coordinator: Coordinator, created: RunCreated, number: int) -> None:
    """As `submit`, again after each refusal, as a gateway asks."""
    while True:
        try:
            return await submit(coordinator, created, number)
        except RefusedError as error:
            if error.status != "unavailable":
                raise
            await asyncio.sleep(0.05)


async def ended(coordinator: Coordinator, created: RunCreated) -> dict[str, Any]:
    async with operator_of(coordinator) as operator:
        async with gateway_of(coordinator, created) as gateway:
            await gateway.close()
        return comparable(await operator.finished(created.run))


def test_a_run_survives_the_failover_to_another_server(
    tmp_path: Path, calm: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two servers with synchronous streaming replication. The first one is lost before a submit, and the other one
    promoted while its gateway asks: nothing that was answered is missing there."""
    secret, expected = calm
    with contextlib.ExitStack() as stack:
        first = Server()
        stack.callback(first.close)
        other = Server(follows=first)
        stack.callback(other.close)
        for each in (first, other):
            each.passfile.write_text(f"*:*:*:evopolicy:{first.password}\n")
        monkeypatch.setenv("PGPASSFILE", str(first.passfile))
        database = first.new().rpartition("/")[2]
        hosts = f"127.0.0.1:{first.port},127.0.0.1:{other.port}"
        address = f"postgresql://evopolicy@{hosts}/{database}?target_session_attrs=read-write"
        coordinator = stack.enter_context(serving(tmp_path / "state", secret, "--store", address))

        async def play() -> None:
            async with operator_of(coordinator) as operator, working(coordinator, pause_s=0.05):
                created = await operator.create()
                await submit(coordinator, created, 0)
                await asyncio.to_thread(first.kill)
                playing = asyncio.create_task(patiently(coordinator, created, 1))
                while "the store cannot write" not in coordinator.log.read_text():
                    await asyncio.sleep(0.05)
                await asyncio.to_thread(other.query, "postgres", "SELECT pg_promote()")
                await playing
                await submit(coordinator, created, 2)
                assert await ended(coordinator, created) == expected

        run(play, 150)
        assert "the store writes again" in coordinator.log.read_text()


def test_a_run_survives_kills_of_server_and_coordinator(
    tmp_path: Path, server: Server, calm: tuple[Path, dict[str, Any]]
) -> None:
    """The server is killed before a submit and started while its gateway asks; the coordinator is killed after it."""
    secret, expected = calm
    address = server.new()

    async def first(coordinator: Coordinator) -> RunCreated:
        async with operator_of(coordinator) as operator, working(coordinator, pause_s=0.05):
            created = await operator.create()
            await submit(coordinator, created, 0)
            await asyncio.to_thread(server.kill)
            playing = asyncio.create_task(patiently(coordinator, created, 1))
            while "the store cannot write" not in coordinator.log.read_text():
                await asyncio.sleep(0.05)
            await asyncio.to_thread(server.start)
            await playing
        return created

    async def second(coordinator: Coordinator, created: RunCreated) -> None:
        async with operator_of(coordinator), working(coordinator):
            await submit(coordinator, created, 2)
            assert await ended(coordinator, created) == expected

    found: list[RunCreated] = []

    async def begin(coordinator: Coordinator) -> None:
        found.append(await first(coordinator))

    with serving(tmp_path / "state", secret, "--store", address) as coordinator:
        run(lambda: begin(coordinator), 120)
        assert "the store writes again" in coordinator.log.read_text()
    # The folder names the database.
    with serving(tmp_path / "state", secret) as coordinator:
        run(lambda: second(coordinator, found[0]), 120)
    assert not (tmp_path / "state" / DATABASE).exists()


def test_an_open_run_continues_after_its_state_was_moved_and_moved_back(
    tmp_path: Path, server: Server, calm: tuple[Path, dict[str, Any]]
) -> None:
    secret, expected = calm
    state, address = tmp_path / "state", server.new()
    created: list[RunCreated] = []

    async def step(coordinator: Coordinator, number: int) -> None:
        async with operator_of(coordinator) as operator, working(coordinator):
            if not created:
                created.append(await operator.create())
            await submit(coordinator, created[0], number)
            if number == 2:
                assert await ended(coordinator, created[0]) == expected

    for number, to in enumerate((address, "sqlite", None)):
        with serving(state, secret) as coordinator:
            run(lambda: step(coordinator, number), 120)  # noqa: B023
            coordinator.stop()
        if to is not None:
            command = [sys.executable, "-m", "evopolicy_coordinator.cli", "move", "--to", to]
            done = subprocess.run(
                [*command, "--state", str(state)], capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stderr
            assert "next: start the coordinator" in done.stdout
            assert place_of(state) == (address if number == 0 else state / DATABASE)


def test_a_moved_state_has_the_same_rows_and_both_places_are_compared(golden: Path, server: Server) -> None:
    def rows_of(place: Any) -> dict[str, list[Any]]:
        with contextlib.closing(connect(place, "ro", 1.0)) as db:
            return {table: list(db.stream(f"SELECT * FROM {table} ORDER BY 1, 2")) for table in TABLES}

    address = server.new()
    before = rows_of(golden / DATABASE)
    moved = move(golden, address)
    assert rows_of(address) == rows_of(golden / MOVED) == before
    assert moved.rows == {table: len(found) for table, found in before.items()}
    assert not (golden / DATABASE).exists()
    (golden / "store").unlink()
    (golden / MOVED).rename(golden / DATABASE)
    with pytest.raises(ConfigError, match="has rows in table"):
        move(golden, address)
    assert place_of(golden) == golden / DATABASE


def test_a_copy_that_differs_is_refused_and_the_old_place_stays(golden: Path, server: Server) -> None:
    """A trigger of the server changes a row on its way, another breaks the journal's chain in the source."""
    address = server.new()
    Store(address).close()
    server.query(address, "CREATE FUNCTION bad() RETURNS trigger LANGUAGE plpgsql AS"
                 " $$ BEGIN NEW.phase = 'open'; RETURN NEW; END $$")  # fmt: skip
    server.query(
        address, "CREATE TRIGGER bad BEFORE INSERT ON run_states FOR EACH ROW EXECUTE FUNCTION bad()"
    )
    with pytest.raises(StorageError, match="table run_states differs"):
        move(golden, address)
    assert place_of(golden) == golden / DATABASE
    assert server.query(address, "SELECT * FROM runs") == []
    with contextlib.closing(connect(golden / DATABASE, "rw", 1.0)) as db:
        db.execute("DROP TRIGGER journal_UPDATE")
        db.execute("UPDATE journal SET data = (SELECT data FROM journal WHERE seq = 1) WHERE seq = 0")
    with pytest.raises(StorageError, match=r"the journal's entry \d has head"):
        move(golden, server.new())


def test_commands_on_a_state_in_postgresql(golden: Path, server: Server, tmp_path: Path) -> None:
    address = server.new()
    on_file = disk_use.use(golden)
    move(golden, address)
    assert [(each.env, each.train_episodes) for each in disk_use.use(golden)] == [
        (each.env, each.train_episodes) for each in on_file
    ]
    assert disk_use.sizes(golden).database > 1 << 20
    (golden / "approved-environments.json").write_text("{}")
    copied = backup.back_up(golden, tmp_path / "backup")
    assert copied.blobs == 4
    assert (tmp_path / "backup" / "approved-environments.json").read_text() == "{}"
    for command, expected in (
        (["epoch", "list"], "journal: 2 entries"),
        (["identity"], ""),
    ):
        words = [sys.executable, "-m", "evopolicy_coordinator.cli", *command, "--state", str(golden)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        assert expected in done.stdout
    assert disk_use.collect(golden, 0.0).episodes == 18
    assert disk_use.use(golden) == []
    # The backup is a state folder on SQLite, from before the collection.
    assert [each.train_episodes for each in disk_use.use(tmp_path / "backup")] == [8]
    with contextlib.closing(Reader(tmp_path / "backup" / DATABASE)) as reader:
        assert len(reader.journal(0, 1 << 20)) == 2


def test_doctor_checks_settings_and_names_coordinators(golden: Path, server: Server) -> None:
    def doctor(*words: str) -> tuple[int, str]:
        command = [sys.executable, "-m", "evopolicy_coordinator.cli", "doctor", *words]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "200"}
        )
        return done.returncode, done.stdout + done.stderr

    address = server.new()
    assert "the rows are in" in doctor("--state", str(golden))[1]
    code, text = doctor("--store", address)
    # The tests' own server is started with -F.
    assert (code, "set fsync = on" in text, "none is connected" in text) == (1, True, True)
    assert "on this server alone" in text
    move(golden, address)
    server.query("postgres", "ALTER ROLE evopolicy SET synchronous_commit = off")
    try:
        with contextlib.closing(Store(address)) as store:
            assert f"{socket.gethostname()} leads" in (text := doctor("--state", str(golden))[1])
            assert "loses accepted submits" in text
            assert store.standbys() == []
    finally:
        server.query("postgres", "ALTER ROLE evopolicy RESET synchronous_commit")


def test_one_coordinator_at_a_time_uses_a_database(
    tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: a copy of a state folder on another machine, or another cluster, writes to the same database.
    Defence: the writer's lock, and the owner's mark."""
    address = server.new()
    monkeypatch.setattr("evopolicy_coordinator.storage.engines._SESSION", ("SET lock_timeout = '100ms'",))
    with contextlib.closing(Store(address, "one")) as ours:
        with pytest.raises(LeadLostError, match="in use by another coordinator"):
            Store(address, "one")
        # Its session is gone, and another coordinator has the lock.
        ours.load()
        server.query(
            "postgres",
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name LIKE 'evopolicy %'",
        )
        with contextlib.closing(Store(address, "one")) as other:
            other.load()
            for _ in range(2):
                with pytest.raises(StorageError):
                    ours.write([])
        with pytest.raises(LeadLostError, match="another coordinator has taken over"):
            ours.write([])
    with pytest.raises(ConfigError, match="of another state folder"):
        Store(address, "two")


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("postgresql://evopolicy:hush-hush@127.0.0.1/x", "contains a password"),
        ("postgresql://evopolicy@127.0.0.1/x?password=hush-hush", "contains a password"),
        ("mysql://evopolicy:hush-hush@127.0.0.1/x", "'mysql' is unknown"),
        ("postgresql://evopolicy@127.0.0.1/x?sslpassword=hush-hush", "contains a sslpassword"),
        ("postgresql://evopolicy@127.0.0.1:1/x", "Connection refused"),
    ],
)
def test_an_unusable_address_is_refused_without_its_password(
    tmp_path: Path, address: str, expected: str
) -> None:
    words = [
        sys.executable,
        "-m",
        "evopolicy_coordinator.cli",
        "--state",
        str(tmp_path / "s"),
        "--store",
        address,
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert expected in done.stderr
    assert "hush-hush" not in done.stdout + done.stderr
    assert not (tmp_path / "s" / "store").exists()


def test_a_password_is_in_no_file_log_or_argument(
    tmp_path: Path, server: Server, calm: tuple[Path, Any]
) -> None:
    with serving(tmp_path / "state", calm[0], "--store", server.new()) as coordinator:
        arguments = Path(f"/proc/{coordinator.process.pid}/cmdline").read_bytes()
        written = [path for path in tmp_path.rglob("*") if path.is_file() and not path.is_symlink()]
        assert tmp_path / "state" / "store" in written
        for text in (arguments, *(path.read_bytes() for path in written)):
            assert server.password.encode() not in text
        other = server.new()
        coordinator.stop()
        with pytest.raises(AssertionError, match="move them there first"):
            Coordinator(tmp_path / "state", "--store", other)
