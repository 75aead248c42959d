"""The store: all of a write or nothing, everything back after reopening, and damage told instead of guessed around."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace
from rigs.store_rows import blob, outcome_row, run_row, state_row, submit_row

from evopolicy_common.errors import ConfigError, DamagedStoreError, StorageError
from evopolicy_common.messages.episode import BlobRef, ResourceLimits
from evopolicy_coordinator.core.contract import records
from evopolicy_coordinator.core.contract.records import (
    DocumentRow,
    EvaluationRow,
    JournalRow,
    KernelRow,
    WorkerRow,
    head_of,
)
from evopolicy_coordinator.storage import disk_use
from evopolicy_coordinator.storage.engines import ROWS, Place, Sqlite, checked_address, connect, record_place
from evopolicy_coordinator.storage.store import SCHEMA, Reader, Store, train_run

TRAIN = records.submit_group("r-1", 0, "train")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "coordinator.sqlite"


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.cluster)])
def place(request: pytest.FixtureRequest, path: Path) -> Place:
    """Where the tests' rows are: on both engines the same tests."""
    return path if request.param == "sqlite" else str(request.getfixturevalue("server").new())


@pytest.fixture
def store(place: Place) -> Iterator[Store]:
    store = Store(place)
    yield store
    store.close()


def evaluation_row(finished: bool) -> EvaluationRow:
    return EvaluationRow(
        evaluation=f"e-{finished}",
        key=f"key-{finished}",
        env="toy/line",
        bundle=None,
        split="train",
        case_ids=(),
        cases=(),
        secret=b"",
        record="full",
        tier="none",
        limits=ResourceLimits(),
        created_at=0.0,
        finished=finished,
    )


def test_everything_written_is_loaded_again_after_reopening(place: Place) -> None:
    outcome = outcome_row(TRAIN, 1, 0)
    rows = [
        run_row(),
        state_row(),
        submit_row(),
        outcome,
        evaluation_row(False),
        WorkerRow(worker="w", state="draining"),
    ]
    store = Store(place)
    store.write(rows)
    store.close()
    store = Store(place)
    snapshot = store.load()
    store.close()
    assert snapshot.runs == (rows[0],)
    assert snapshot.states == (rows[1],)
    assert snapshot.submits == (rows[2],)
    assert snapshot.outcomes == (head_of(outcome),)
    assert snapshot.evaluations == (rows[4],)
    assert snapshot.workers == (rows[5],)


def test_a_row_may_name_more_blobs_than_a_statement_has_parameters(store: Store) -> None:
    named = tuple(BlobRef(digest=f"{number:064x}", size=1) for number in range(70_000))
    row = replace(evaluation_row(False), replays=named)
    store.write([row])
    assert store.load().evaluations == (row,)


def test_the_journal_can_only_grow(place: Place) -> None:
    """Attack: change or cut the journal. Defence: the heads that `run.json` and reports print no longer
    match."""
    store = Store(place)
    first = JournalRow(seq=0, head="a", entry=b"one")
    last = JournalRow(seq=1, head="b", entry=b"two", reveals="epoch")
    store.write([first, last, DocumentRow(run="r-1", kind="opening", data=b"{}")])
    with pytest.raises(StorageError, match="contradicts"):
        store.write([JournalRow(seq=1, head="c", entry=b"another")])
    snapshot = store.load()
    store.close()
    assert (snapshot.journal, snapshot.revealed) == (last, ("epoch",))
    for statement in ("DELETE FROM journal", "UPDATE journal SET reveals = ''"):
        db = connect(place, "rw", 1.0)
        with contextlib.closing(db), pytest.raises(DamagedStoreError, match="only appended to"), db.errors():
            db.execute(statement)
    with contextlib.closing(Reader(place)) as reader:
        assert reader.journal(0, 1) == (first,)
        assert reader.journal(0, 1000) == (first, last)
        assert reader.journal(2, 1000) == ()
        opening, result = (reader.one(DocumentRow, run="r-1", kind=kind) for kind in ("opening", "result"))
        assert opening is not None
        assert (opening.data, result) == (b"{}", None)


def test_incarnation_counts_every_load(place: Place) -> None:
    for expected in (1, 2, 3):
        store = Store(place)
        assert store.load().incarnation == expected
        store.close()


def test_row_is_replaced_under_its_key(store: Store) -> None:
    store.write([run_row(), state_row(), submit_row()])
    store.write([submit_row(released=2), state_row(phase="closed")])
    snapshot = store.load()
    assert [row.released for row in snapshot.submits] == [2]
    assert [row.phase for row in snapshot.states] == ["closed"]


def test_only_the_workers_that_have_ended_are_forgotten(store: Store) -> None:
    store.write([KernelRow(worker=name, boot_id="k") for name in ("ended", "plays")])
    store.forget_kernels(["ended", "unknown"])
    assert [row.worker for row in store.load().kernels] == ["plays"]


def test_write_that_fails_leaves_nothing_behind(store: Store) -> None:
    store.write([run_row()])
    with pytest.raises(StorageError, match="contradicts"):
        store.write([state_row(), run_row("r-2", key="key-r-1")])
    snapshot = store.load()
    assert [row.run for row in snapshot.runs] == ["r-1"]
    assert snapshot.states == ()
    store.write([state_row()])


def test_full_disk_is_reported_and_writing_goes_on_when_there_is_room(path: Path) -> None:
    store = Store(path)
    store.write([run_row(), state_row(), submit_row()])
    pages = store._db.execute("PRAGMA page_count").fetchone()[0]
    store._db.execute(f"PRAGMA max_page_count={pages + 2}")
    big = outcome_row(TRAIN, 0, 0, trajectory=blob(b"x" * 100_000))
    with pytest.raises(StorageError, match="full"):
        store.write([big])
    assert store.load().outcomes == ()
    store._db.execute("PRAGMA max_page_count=1000000")
    store.write([big])
    assert len(store.load().outcomes) == 1
    store.close()


def test_two_outcomes_cannot_have_one_place_in_the_order_of_arrival(store: Store) -> None:
    store.write([outcome_row(TRAIN, 0, 0)])
    with pytest.raises(StorageError, match="contradicts"):
        store.write([outcome_row(TRAIN, 1, 0)])


def test_outcomes_of_finished_runs_and_evaluations_are_not_loaded(store: Store) -> None:
    group = records.evaluation_group("e-True")
    open_group = records.evaluation_group("e-False")
    store.write([run_row(), state_row(phase="finished"), submit_row(), outcome_row(TRAIN, 0, 0)])
    store.write(
        [evaluation_row(True), outcome_row(group, 0, 0), evaluation_row(False), outcome_row(open_group, 0, 0)]
    )
    snapshot = store.load()
    assert snapshot.submits == ()
    assert [head.group for head in snapshot.outcomes] == [open_group]
    assert [row.run for row in snapshot.runs] == ["r-1"]


def test_pages_hold_outcomes_in_order_of_arrival_as_many_as_fit(store: Store, place: Place) -> None:
    rows = [
        outcome_row(TRAIN, index, seq, blob(b"%d" % index * 1000)) for seq, index in enumerate((3, 0, 2, 1))
    ]
    store.write(reversed(rows))
    reader = Reader(place)
    assert reader.outcomes(TRAIN, 0, 3, 1 << 20) == tuple(rows[:3])
    assert reader.outcomes(TRAIN, 1, 4, 3500) == tuple(rows[1:3])
    assert reader.outcomes(TRAIN, 0, 4, 1) == (rows[0],)
    assert reader.outcomes(TRAIN, 4, 4, 1) == ()
    reader.close()


def test_a_run_may_fetch_the_blobs_of_its_own_train_feedback_only(store: Store, place: Place) -> None:
    stored, inline, hidden = (blob(b"stored", inline=False), blob(b"inline"), blob(b"hidden", inline=False))
    store.write(
        [
            outcome_row(TRAIN, 0, 0, stored),
            outcome_row(TRAIN, 1, 1, inline),
            outcome_row(records.submit_group("r-1", 0, "validation"), 0, 0, hidden),
        ]
    )
    reader = Reader(place)
    assert reader.names_blob("r-1", stored.digest)
    assert not reader.names_blob("r-1", hidden.digest)
    assert not reader.names_blob("r-2", stored.digest)
    reader.close()


def test_only_train_groups_belong_to_a_gateway() -> None:
    assert train_run(records.submit_group("r-1", 12, "train")) == "r-1"
    for group in (
        records.submit_group("r-1", 0, "validation"),
        records.submit_group("r-1", 0, "heldout"),
        records.random_group("r-1"),
        records.evaluation_group("train"),
    ):
        assert train_run(group) is None


@pytest.mark.parametrize(
    ("statement", "found"),
    [
        ("UPDATE meta SET value = value + 1 WHERE name = 'schema'", str(SCHEMA + 1)),
        ("DELETE FROM meta WHERE name = 'schema'", "unknown"),
    ],
)
def test_a_database_of_another_schema_is_refused(place: Place, statement: str, found: str) -> None:
    Store(place).close()
    with contextlib.closing(connect(place, "rw", 1.0)) as db:
        db.execute(statement)
    with pytest.raises(ConfigError, match=f"has schema {found}, .* reads {SCHEMA} only: use the version"):
        Store(place)


def test_the_database_of_another_state_folder_is_refused(place: Place) -> None:
    for owner in ("one", "one", ""):
        Store(place, owner).close()
    with pytest.raises(ConfigError, match="of another state folder"):
        Store(place, "two")


def test_a_coordinator_writes_nothing_after_another_has_loaded_the_rows(store: Store, place: Place) -> None:
    """Attack: a paused coordinator wakes up after another has taken its place. Defence: every transaction
    checks the incarnation that its coordinator loaded."""
    store.write([run_row()])
    store.load()
    with contextlib.closing(connect(place, "rw", 1.0)) as other:
        other.execute("UPDATE meta SET value = value + 1 WHERE name = 'incarnation'")
    for write in (
        lambda: store.write([state_row()]),
        lambda: store.write_claim("suite", "name", b"data"),
        lambda: store.forget_kernels(["w"]),
    ):
        with pytest.raises(StorageError, match="another coordinator has taken over"):
            write()
    snapshot = store.load()
    assert (snapshot.states, snapshot.incarnation, store.claims()) == ((), 3, [])
    store.write([state_row()])


def test_a_store_without_its_client_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(ConfigError, match=r"client is not installed .* install .*cluster"):
        checked_address("postgresql://evopolicy@127.0.0.1/evopolicy")


def test_file_that_is_no_database_is_reported(path: Path) -> None:
    path.write_bytes(b"this is no database, whatever its name says" * 100)
    with pytest.raises(StorageError, match="restore it from a backup"):
        Store(path)


def test_row_that_cannot_be_read_is_reported(store: Store, place: Place) -> None:
    store.write([run_row(), state_row(), submit_row()])
    store._db.execute("UPDATE submits SET data = ?", (b"\0",))
    with pytest.raises(DamagedStoreError) as caught:
        store.load()
    for named in (str(place), "table submits", "('r-1', 0)", "Restore a backup", "newer version"):
        assert named in str(caught.value)


def test_an_outcome_that_cannot_be_read_is_named(store: Store, place: Place) -> None:
    store.write([run_row(), state_row(), submit_row(), outcome_row(TRAIN, 3, 0)])
    store._db.execute("UPDATE outcomes SET data = ?", (b"\0",))
    reader = Reader(place)
    for read in (
        lambda: reader.outcomes(TRAIN, 0, 9, 1 << 20),
        lambda: reader.one(records.OutcomeRow, grp=TRAIN, idx=3),
    ):
        with pytest.raises(DamagedStoreError, match=r"table outcomes, row .*'r-1/s0/train', 3"):
            read()
    reader.close()


def test_disk_use_of_what_is_no_state_folder_makes_nothing(tmp_path: Path) -> None:
    for disk_use_of in (
        lambda: disk_use.collect(tmp_path / "nowhere", 0.0),
        lambda: disk_use.use(tmp_path / "nowhere"),
    ):
        with pytest.raises(ConfigError, match="is not a coordinator's state folder"):
            disk_use_of()
    assert list(tmp_path.iterdir()) == []


def test_disk_use_names_the_row_that_it_cannot_read(store: Store, place: Place, path: Path) -> None:
    record_place(path.parent, ROWS, place)
    store.write([run_row(), state_row(), submit_row()])
    store._db.execute("UPDATE submits SET data = ?", (b"\0",))
    with pytest.raises(DamagedStoreError, match=f"{re.escape(str(place))}: table submits, row"):
        disk_use.collect(path.parent, 0.0)


def test_passing_disk_errors_are_told_from_lasting_ones(store: Store) -> None:
    store.write([run_row(), state_row(), submit_row(), outcome_row(TRAIN, 0, 0)])
    with pytest.raises(DamagedStoreError, match="contradicts another"):
        store.write([outcome_row(TRAIN, 1, 0)])
    off, on = (
        ("PRAGMA query_only=1", "PRAGMA query_only=0")
        if isinstance(store._db, Sqlite)
        else ("SET default_transaction_read_only = on", "SET default_transaction_read_only = off")
    )
    store._db.execute(off)
    with pytest.raises(StorageError) as refused:
        store.write([submit_row()])
    assert not isinstance(refused.value, DamagedStoreError)
    store._db.execute(on)
    store.write([submit_row()])
    store._db.execute("DROP TABLE workers")
    with pytest.raises(DamagedStoreError, match=r"no such table|does not exist"):
        store.load()


def test_file_is_durable_and_private(path: Path) -> None:
    store = Store(path)
    assert store._db.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    assert store._db.execute("PRAGMA synchronous").fetchone()[0] == 2
    assert path.stat().st_mode & 0o077 == 0
    store.close()
