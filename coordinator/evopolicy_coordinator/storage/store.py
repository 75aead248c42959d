"""The database: every row that the core persists, and nothing else.

Rules that this module owns:
- When `write` returns, its rows are as durable as the engine makes them; when it raises, the caller loads the rows
  again, since a lost connection leaves open whether they are stored.
- Every transaction checks the incarnation that `load` has set, so that a coordinator that lost the database to another
  writes nothing.
- One connection writes (`Store`, from one thread at a time); any number read (`Reader`, one connection per thread).
- A row is its msgpack bytes plus its lookup columns. A database of another schema is refused.
- A disk that refuses may accept a write later (StorageError); an unreadable row stays unreadable (DamagedStoreError).
- The digests that a gateway may fetch (`train_blobs`) are stored in the same transaction as the outcome that names
  them.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import operator
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar, get_args

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, DamagedStoreError, LeadLostError, StorageError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.records.splits import SPLITS
from evopolicy_coordinator.core.contract import records
from evopolicy_coordinator.storage.engines import Database, Place, connect

T = TypeVar("T")

BUSY_TIMEOUT_S = 10.0
"""How long to wait for another process's transaction: `evopolicy gc` runs beside a coordinator."""

_PAGE_ROWS = 10_000
SCHEMA = 8
"""Version of the tables and of the rows in them."""
_NAMED_AT_ONCE = 500
NAMED, CONDEMNED = -1, -2
"""Marks of blobs in an object store: a row names it; its object is deleted. 0: no row has named it yet. Positive: a
collection's."""
TABLES = {
    "meta": "name TEXT PRIMARY KEY, value INTEGER NOT NULL",
    "runs": "run TEXT PRIMARY KEY, key TEXT NOT NULL UNIQUE, data BLOB NOT NULL",
    "run_states": "run TEXT PRIMARY KEY, phase TEXT NOT NULL, data BLOB NOT NULL",
    "submits": "run TEXT NOT NULL, submit_index INTEGER NOT NULL, key TEXT NOT NULL, data BLOB NOT NULL,"
    " PRIMARY KEY (run, submit_index), UNIQUE (run, key)",
    "outcomes": "grp TEXT NOT NULL, idx INTEGER NOT NULL, seq INTEGER NOT NULL, head BLOB NOT NULL,"
    " data BLOB NOT NULL, PRIMARY KEY (grp, idx), UNIQUE (grp, seq)",
    "train_blobs": "run TEXT NOT NULL, digest TEXT NOT NULL, PRIMARY KEY (run, digest)",
    "begun": "grp TEXT NOT NULL, first INTEGER NOT NULL, data BLOB NOT NULL, PRIMARY KEY (grp, first)",
    "evaluations": "evaluation TEXT PRIMARY KEY, key TEXT NOT NULL UNIQUE, finished INTEGER NOT NULL,"
    " data BLOB NOT NULL",
    "finished": "run TEXT PRIMARY KEY, data BLOB NOT NULL",
    "workers": "worker TEXT PRIMARY KEY, data BLOB NOT NULL",
    "claims": "suite TEXT NOT NULL, name TEXT NOT NULL, data BLOB NOT NULL, PRIMARY KEY (suite, name)",
    "permits": "run TEXT NOT NULL, boot_id TEXT NOT NULL, ended INTEGER NOT NULL, data BLOB NOT NULL,"
    " PRIMARY KEY (run, boot_id)",
    "kernels": "worker TEXT PRIMARY KEY, data BLOB NOT NULL",
    "journal": "seq INTEGER PRIMARY KEY, reveals TEXT NOT NULL, data BLOB NOT NULL",
    "documents": "run TEXT NOT NULL, kind TEXT NOT NULL, data BLOB NOT NULL, PRIMARY KEY (run, kind)",
    "objects": "digest TEXT PRIMARY KEY, name TEXT NOT NULL, size INTEGER NOT NULL, since INTEGER NOT NULL,"
    " mark INTEGER NOT NULL",
}

_encode = msgspec.msgpack.Encoder().encode


class _Place(NamedTuple):
    table: str
    key: tuple[str, ...]
    lookup: tuple[str, ...] = ()
    """Further columns of the table."""
    column: str = "data"
    """The column of the row's bytes."""
    replaced: bool = True
    """Whether a row replaces the one of the same key; otherwise a second one fails."""


_PLACES: dict[type, _Place] = {
    records.RunRow: _Place("runs", ("run",), ("key",)),
    records.RunStateRow: _Place("run_states", ("run",), ("phase",)),
    records.SubmitRow: _Place("submits", ("run", "submit_index"), ("key",)),
    records.OutcomeRow: _Place("outcomes", ("grp", "idx"), ("seq", "head")),
    records.OutcomeHead: _Place("outcomes", ("grp", "idx"), column="head"),
    records.BegunRow: _Place("begun", ("grp", "first")),
    records.EvaluationRow: _Place("evaluations", ("evaluation",), ("key", "finished")),
    RunFinished: _Place("finished", ("run",)),
    records.WorkerRow: _Place("workers", ("worker",)),
    records.PermitRow: _Place("permits", ("run", "boot_id"), ("ended",)),
    records.KernelRow: _Place("kernels", ("worker",)),
    records.JournalRow: _Place("journal", ("seq",), ("reveals",), replaced=False),
    records.DocumentRow: _Place("documents", ("run", "kind"), replaced=False),
}
_VALUES: dict[str, Callable[[Any], object]] = {
    "grp": lambda row: row.group,
    "idx": lambda row: row.index,
    "ended": lambda row: int(row.ended_at is not None),
    "finished": lambda row: int(row.finished),
    "head": lambda row: _encode(records.head_of(row)),
    "data": _encode,
}
"""The columns that do not hold the row's field of their name."""
_DECODERS: dict[type, msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in _PLACES
}


class Store:
    """The writing connection. Threads must not use it at the same time."""

    def __init__(self, place: Place, owner: str = "") -> None:
        """Opens or creates the database. `owner`: a secret of the state folder, whose digest is kept.

        Raises ConfigError for another schema or the database of another state folder, LeadLostError while another
        coordinator leads, StorageError."""
        self._db = connect(place, "rwc", BUSY_TIMEOUT_S)
        self.incarnation = 0
        """Of the state that `load` has read last; 0 before."""
        try:
            with self._db.errors():
                self._prepare(
                    int.from_bytes(hashlib.sha256(owner.encode()).digest()[:6], "big") if owner else 0
                )
        except BaseException:
            self._db.close()
            raise

    def _prepare(self, owner: int) -> None:
        db = self._db
        with db.transaction():
            if not db.has_table("meta"):
                db.create(TABLES)
                db.execute("INSERT INTO meta VALUES ('incarnation', 0), ('schema', ?)", (SCHEMA,))
        found = dict(db.execute("SELECT name, value FROM meta").fetchall())
        if found.get("schema") != SCHEMA:
            raise ConfigError(
                f"{db.place} has schema {found.get('schema', 'unknown')}, and this version of evopolicy reads"
                f" {SCHEMA} only: use the version that wrote it, or another folder with --state"
            )
        if owner and found.get("owner", owner) != owner:
            raise ConfigError(
                f"{db.place} is of another state folder: name a database of its own with --store"
            )
        if owner and "owner" not in found:
            db.execute("INSERT INTO meta VALUES ('owner', ?)", (owner,))

    def write(self, changed: Iterable[records.Row]) -> None:
        """Writes all rows in one durable transaction. Raises StorageError when it fails; the caller then loads the rows
        again."""
        changed = tuple(changed)
        named = sorted({digest for row in changed for digest in named_blobs(row)})
        with self._transaction():
            self._name(named)
            with self._db.batch():
                for row in changed:
                    statement, values = _INSERTS[type(row)]
                    self._db.execute(statement, [value(row) for value in values])
                    if isinstance(row, records.OutcomeRow) and (run := train_run(row.group)) is not None:
                        insert = "INSERT INTO train_blobs VALUES (?, ?) ON CONFLICT DO NOTHING"
                        for ref in stored_blobs(row.outcome):
                            self._db.execute(insert, (run, ref.digest))

    def _name(self, digests: list[str]) -> None:
        """Keeps these blobs from being collected from an object store. Raises StorageError when one has been."""
        # In parts, since a statement has a limit of parameters.
        for some in (
            digests[first : first + _NAMED_AT_ONCE] for first in range(0, len(digests), _NAMED_AT_ONCE)
        ):
            among = f"digest IN ({', '.join('?' * len(some))})"
            self._db.execute(f"UPDATE objects SET mark = {NAMED} WHERE mark > {CONDEMNED} AND {among}", some)
            query = f"SELECT digest FROM objects WHERE mark = {CONDEMNED} AND {among}"
            if (gone := self._db.execute(query, some).fetchone()) is not None:
                raise StorageError(
                    f"blob {gone[0]} was collected before a row named it; it is to be uploaded again"
                )

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """A durable transaction. Raises LeadLostError when another coordinator has loaded the rows since `load`."""
        with self._db.errors(), self._db.transaction():
            query = f"SELECT value FROM meta WHERE name = 'incarnation'{self._db.shared}"
            if self.incarnation and self._db.execute(query).fetchone() != (self.incarnation,):
                raise LeadLostError(f"{self._db.place}: another coordinator has taken over")
            yield

    def confirm(self) -> float:
        """How long the database takes to confirm that this coordinator leads, seconds. Raises LeadLostError,
        StorageError."""
        began = time.monotonic()
        with self._transaction():
            pass
        return time.monotonic() - began

    def standbys(self) -> list[str]:
        """The machines whose coordinators wait for the lead."""
        with self._db.errors():
            return [name for name, leads in self._db.coordinators() if not leads]

    def abort(self) -> None:
        """Lets the operation of another thread fail."""
        self._db.abort()

    def forget_kernels(self, workers: Iterable[str]) -> None:
        """Durably deletes the records of the kernels on which these workers were: they are known to have ended."""
        with self._transaction():
            for worker in workers:
                self._db.execute("DELETE FROM kernels WHERE worker = ?", (worker,))

    def write_claim(self, suite: str, name: str, data: bytes) -> None:
        """Stores a sweep's claim durably. Raises StorageError when it fails."""
        replace = "ON CONFLICT (suite, name) DO UPDATE SET data = excluded.data"
        with self._transaction():
            self._db.execute(f"INSERT INTO claims VALUES (?, ?, ?) {replace}", (suite, name, data))

    def write_sealed(self, data: bytes) -> None:
        """Stores the sealed secrets of the cluster durably. Raises StorageError when it fails."""
        replace = "ON CONFLICT (run, kind) DO UPDATE SET data = excluded.data"
        with self._transaction():
            self._db.execute(f"INSERT INTO documents VALUES ('', 'secrets', ?) {replace}", (data,))

    def sealed(self) -> bytes | None:
        """The sealed secrets of the cluster; None without any."""
        return _sealed(self._db)

    def claims(self) -> list[tuple[str, str, bytes]]:
        """All claims of sweeps: suite, name and stored bytes."""
        with self._db.errors():
            return list(self._db.execute("SELECT suite, name, data FROM claims"))

    def load(self) -> records.Snapshot:
        """Durably increments the incarnation, then reads the state that a core starts from."""
        with self._db.errors():
            with self._db.transaction():
                self._db.execute("UPDATE meta SET value = value + 1 WHERE name = 'incarnation'")
                # Nothing that was decided before is written any more.
                self._db.execute(f"DELETE FROM objects WHERE mark = {CONDEMNED}")
            with self._db.transaction(self._db.begin_reading):
                snapshot = self._snapshot()
        self.incarnation = snapshot.incarnation
        return snapshot

    def _snapshot(self) -> records.Snapshot:
        db = self._db
        incarnation = db.execute("SELECT value FROM meta WHERE name = 'incarnation'").fetchone()[0]
        live_runs = "SELECT run FROM run_states WHERE phase != 'finished'"
        submits = tuple(rows(db, records.SubmitRow, f"WHERE run IN ({live_runs})"))
        evaluations = tuple(rows(db, records.EvaluationRow))
        places = [(row.run, row.submit_index) for row in submits]
        groups = [records.submit_group(*place, split) for place in places for split in SPLITS]
        groups += [records.random_group(run) for (run,) in db.execute(live_runs)]
        groups += [records.evaluation_group(row.evaluation) for row in evaluations if not row.finished]
        return records.Snapshot(
            incarnation=incarnation,
            runs=tuple(rows(db, records.RunRow)),
            states=tuple(rows(db, records.RunStateRow)),
            submits=submits,
            outcomes=tuple(
                head
                for group in groups
                for head in rows(db, records.OutcomeHead, "WHERE grp = ? ORDER BY seq", (group,))
            ),
            begun=tuple(
                row for group in groups for row in rows(db, records.BegunRow, "WHERE grp = ?", (group,))
            ),
            evaluations=evaluations,
            workers=tuple(rows(db, records.WorkerRow)),
            permits=tuple(rows(db, records.PermitRow, "WHERE ended = 0")),
            kernels=tuple(rows(db, records.KernelRow)),
            journal=_only(rows(db, records.JournalRow, "ORDER BY seq DESC LIMIT 1")),
            revealed=tuple(revealed(db)),
        )

    def close(self) -> None:
        self._db.close()


class Reader:
    """A reading connection for one thread; it sees durable rows."""

    def __init__(self, place: Place) -> None:
        self._db = connect(place, "ro", BUSY_TIMEOUT_S)

    def outcomes(self, group: str, cursor: int, upto: int, max_bytes: int) -> tuple[records.OutcomeRow, ...]:
        """Outcomes with cursor ≤ seq < upto in order of `seq`, up to `max_bytes` of rows but at least one."""
        where = "WHERE grp = ? AND seq >= ? AND seq < ? ORDER BY seq"
        return self._page(records.OutcomeRow, where, (group, cursor, upto), max_bytes)

    def one(self, kind: type[T], /, **key: object) -> T | None:
        """The row of a kind with this key, by column; None when it is missing."""
        where = " AND ".join(f"{column} = ?" for column in key)
        with self._db.errors():
            return _only(rows(self._db, kind, f"WHERE {where}", tuple(key.values())))

    def bundles(self, run: str) -> frozenset[str | None]:
        with self._db.errors():
            return frozenset(row.bundle for row in rows(self._db, records.SubmitRow, "WHERE run = ?", (run,)))

    def finished(self, run: str) -> RunFinished | None:
        """The result of a run; None while it is not finished."""
        return self.one(RunFinished, run=run)

    def journal(self, cursor: int, max_bytes: int) -> tuple[records.JournalRow, ...]:
        """Entries of the journal from `cursor` on, up to `max_bytes` but at least one; empty past the last entry."""
        return self._page(records.JournalRow, "WHERE seq >= ? ORDER BY seq", (cursor,), max_bytes)

    def revealed(self) -> frozenset[str]:
        """Epochs whose secret is revealed."""
        with self._db.errors():
            return frozenset(revealed(self._db))

    def names_blob(self, run: str, digest: str) -> bool:
        """Whether the train feedback of `run` names the blob."""
        query = "SELECT 1 FROM train_blobs WHERE run = ? AND digest = ?"
        with self._db.errors():
            return self._db.execute(query, (run, digest)).fetchone() is not None

    def sealed(self) -> bytes | None:
        """As of `Store`; None also for an empty database."""
        return _sealed(self._db)

    def _page(self, kind: type[T], where: str, args: tuple[object, ...], max_bytes: int) -> tuple[T, ...]:
        """Rows of up to `max_bytes`, but at least one if there is any."""
        place = _PLACES[kind]
        sizes = f"SELECT LENGTH({place.column}) FROM {place.table} {where} LIMIT {_PAGE_ROWS}"
        with self._db.errors():
            totals = itertools.accumulate(size for (size,) in self._db.execute(sizes, args).fetchall())
            n = max(1, sum(total <= max_bytes for total in totals))
            return tuple(rows(self._db, kind, f"{where} LIMIT {n}", args))

    def close(self) -> None:
        self._db.close()


def rows(db: Database, kind: type[T], where: str = "", args: tuple[object, ...] = ()) -> Iterator[T]:
    """The rows of a kind; until they are exhausted, `db` does nothing else. Raises DamagedStoreError with the
    unreadable row's key."""
    place = _PLACES[kind]
    key = ", ".join(place.key)
    decode = _DECODERS[kind].decode
    for *values, data in db.stream(f"SELECT {key}, {place.column} FROM {place.table} {where}", args):
        try:
            row = decode(data)
        except DECODE_ERRORS as error:
            raise DamagedStoreError(
                f"table {place.table}, row ({key}) = {tuple(values)}: {unreadable(error)}"
            ) from error
        yield row


def _sealed(db: Database) -> bytes | None:
    with db.errors():
        if not db.has_table("documents"):
            return None
        found = db.execute("SELECT data FROM documents WHERE run = '' AND kind = 'secrets'").fetchone()
        return None if found is None else bytes(found[0])


def _only(found: Iterator[T]) -> T | None:
    return next(iter(tuple(found)), None)


def revealed(db: Database) -> Iterator[str]:
    """Epochs that the journal records as revealed."""
    return (epoch for (epoch,) in db.execute("SELECT reveals FROM journal WHERE reveals != ''").fetchall())


def unreadable(error: Exception) -> str:
    """Describes the damage of a row's bytes, and the remedy."""
    return (
        f"this row cannot be read: {error}. Restore a backup of the state folder; if a newer version wrote the row,"
        " use that version"
    )


def _insert_of(place: _Place) -> tuple[str, tuple[Callable[[Any], object], ...]]:
    """The statement that stores a row, and its parameters. It fails when another unique column clashes."""
    columns = (*place.key, *place.lookup, place.column)
    statement = f"INSERT INTO {place.table} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"
    if place.replaced:
        changed = ", ".join(f"{name} = excluded.{name}" for name in (*place.lookup, place.column))
        statement += f" ON CONFLICT ({', '.join(place.key)}) DO UPDATE SET {changed}"
    return statement, tuple(_VALUES.get(name) or operator.attrgetter(name) for name in columns)


_INSERTS = {kind: _insert_of(_PLACES[kind]) for kind in get_args(records.Row)}


def train_run(group: str) -> str | None:
    """The run whose train episodes `group` holds; None for every other group."""
    head, _, kind = group.rpartition("/")
    return (head.rpartition("/")[0] or None) if kind == "train" else None


def named_blobs(row: records.Row) -> Iterable[str]:
    """Digests of the blobs that a row names without carrying their bytes."""
    if isinstance(row, records.SubmitRow | records.EvaluationRow) and row.bundle is not None:
        yield row.bundle
    refs: Iterable[BlobRef] = ()
    if isinstance(row, records.EvaluationRow):
        refs = row.replays
    elif isinstance(row, records.BegunRow):
        refs = () if row.begun is None else (row.begun,)
    elif isinstance(row, records.OutcomeRow):
        refs = stored_blobs(row.outcome)
    yield from (ref.digest for ref in refs if ref.inline is None)


def stored_blobs(outcome: EpisodeOutcome) -> tuple[BlobRef, ...]:
    """The blobs that the outcome names without carrying their bytes."""
    return tuple(ref for ref in (outcome.trajectory, outcome.video) if ref is not None and ref.inline is None)
