"""One connection to the store's database: SQLite in the state folder, or PostgreSQL.

Rules that this module owns:
- Both engines get the same statements. Placeholders are `?`, texts compare by their UTF-8 bytes, truth values are the
  integers 0 and 1.
- A disk or server that refuses may accept a write later (StorageError); contradicting rows and missing tables stay as
  they are (DamagedStoreError).
- PostgreSQL's writing connection holds an advisory lock of the database for as long as it lives, so that one
  coordinator leads (LeadLostError for the others). A lost connection is opened anew by the next operation, never
  within a transaction.
- Passwords come from libpq's files and environment variables. An address that contains one is refused.
"""

from __future__ import annotations

import abc
import contextlib
import os
import socket
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from evopolicy_common.errors import ConfigError, DamagedStoreError, LeadLostError, StorageError, raised_as
from evopolicy_common.installation import add_extra
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.wire.credentials import no_state

if TYPE_CHECKING:
    import psycopg

Place = Path | str
"""A SQLite file or a folder of blobs, or the address of a PostgreSQL database or an object store."""

Mode = Literal["ro", "rw", "rwc"]

DATABASE = "coordinator.sqlite"
"""Name of the SQLite file in a state folder."""


class StatePart(NamedTuple):
    """A part of the state: the file or folder that has it in the state folder, the file there that says where it is
    instead, and the options of `evopolicy-coordinator` and its `move` that name the place."""

    content: str
    own: str
    note: str
    option: str
    move: str


ROWS = StatePart("rows", DATABASE, "store", "--store", "--to")
BLOBS = StatePart("blobs", "blobs", "blob-store", "--blobs", "--blobs")

LOCK_WAIT_S = 4.0
"""Longest wait for the database's lock in one attempt."""

_NO_CHANGE = "the journal is only appended to"
_LINK = {
    "connect_timeout": "10",
    "application_name": f"evopolicy {socket.gethostname()}",
    "tcp_user_timeout": "6000",
    "keepalives_idle": "3",
    "keepalives_interval": "1",
    "keepalives_count": "3",
}
"""libpq's settings where the address has none: a lost server is noticed within about six seconds."""
_SESSION = (
    "SET tcp_keepalives_idle = 3",
    "SET tcp_keepalives_interval = 1",
    "SET tcp_keepalives_count = 3",
    "SET tcp_user_timeout = 6000",
    "SET idle_in_transaction_session_timeout = '20s'",
    f"SET lock_timeout = '{LOCK_WAIT_S:.0f}s'",
)
"""The server's side of it: the lock of a lost machine is free after as long."""
_ONE_WRITER = (
    "SELECT pg_advisory_lock(hashtext('evopolicy'), hashtext(current_schema()))",
    # A paused coordinator sends nothing, and the server ends its session with the lock.
    "SET idle_session_timeout = '20s'",
)


_COORDINATORS = (
    "SELECT a.application_name, l.granted FROM pg_locks l JOIN pg_stat_activity a USING (pid)"
    " WHERE l.locktype = 'advisory' AND a.datname = current_database()"
    " AND l.classid::bigint = hashtext('evopolicy')::bigint & 4294967295"
    " AND l.objid::bigint = hashtext(current_schema())::bigint & 4294967295 ORDER BY 2 DESC, 1"
)


class Database(abc.ABC):
    """One connection, for one thread at a time."""

    place: Place
    column_types: dict[str, str] = {}
    """Types of columns that have another name here."""
    guards: tuple[str, ...]
    """Statements that make the journal append-only."""
    begin = "BEGIN"
    begin_reading = "BEGIN"
    """Begins a transaction whose reads are of one instant."""
    shared = ""
    """Ends a SELECT whose rows must not change before the transaction ends."""
    exclusive = ""
    """Ends a SELECT whose rows no other transaction may keep from changing meanwhile."""
    clock: str
    """The database's Unix time, whole seconds."""

    @contextlib.contextmanager
    def errors(self) -> Iterator[None]:
        """Around every operation: connects again if necessary, translates the driver's errors into ours."""
        try:
            self._reconnect()
            yield
        except DamagedStoreError as error:
            raise DamagedStoreError(f"{self.place}: {error}") from error
        except self._driver_errors() as error:
            contradicts, passing = self._kind(error)
            if contradicts:
                text = f"{self.place} refuses a row that contradicts another: {error}"
                raise DamagedStoreError(text) from error
            if passing:
                raise StorageError(f"{self.place}: {error}") from error
            text = f"{self.place} cannot be used: {error}; restore it from a backup"
            raise DamagedStoreError(text) from error

    @contextlib.contextmanager
    def transaction(self, begin: str | None = None) -> Iterator[None]:
        """A transaction that is durable at the end of the `with`, and rolled back on an error."""
        try:
            self.execute(begin or self.begin)
            yield
            self.execute("COMMIT")
        except BaseException:
            if self._in_transaction():
                self.execute("ROLLBACK")
            raise

    def create(self, tables: dict[str, str]) -> None:
        """Creates these tables, within a transaction."""
        for name, columns in tables.items():
            for ours, theirs in self.column_types.items():
                columns = columns.replace(ours, theirs)
            self.execute(f"CREATE TABLE {name} ({columns})")
        for statement in self.guards:
            self.execute(statement)

    def batch(self) -> contextlib.AbstractContextManager[object]:
        """Statements inside need not wait for each other's result."""
        return contextlib.nullcontext()

    @abc.abstractmethod
    def execute(self, statement: str, args: Iterable[object] = ()) -> Any:
        """Returns a DB-API cursor."""

    @abc.abstractmethod
    def execute_many(self, statement: str, rows: list[tuple[object, ...]]) -> None:
        """Executes the statement with each row."""

    @abc.abstractmethod
    def stream(self, statement: str, args: Iterable[object] = ()) -> Iterator[tuple[Any, ...]]:
        """Rows of a SELECT, of which few are in memory at once. The connection does nothing else meanwhile."""

    @abc.abstractmethod
    def has_table(self, name: str) -> bool:
        """Whether the table is there."""

    @abc.abstractmethod
    def close(self) -> None:
        """Closes the connection."""

    def coordinators(self) -> list[tuple[str, bool]]:
        """The machines whose coordinators hold the database's lock or wait for it, and whether they lead."""
        return []

    def abort(self) -> None:  # noqa: B027 - a file has no connection
        """Ends the connection from another thread, so that the operation in flight fails."""

    @abc.abstractmethod
    def _reconnect(self) -> None: ...

    @abc.abstractmethod
    def _in_transaction(self) -> bool: ...

    @abc.abstractmethod
    def _driver_errors(self) -> tuple[type[Exception], ...]: ...

    @abc.abstractmethod
    def _kind(self, error: Exception) -> tuple[bool, bool]:
        """Whether a row contradicts another, and whether the error may pass."""


class Sqlite(Database):
    """A file, with WAL and synchronous=FULL."""

    guards = tuple(
        f"CREATE TRIGGER journal_{when} BEFORE {when} ON journal BEGIN SELECT RAISE(ABORT, '{_NO_CHANGE}'); END"
        for when in ("UPDATE", "DELETE")
    )
    begin = "BEGIN IMMEDIATE"
    clock = "CAST(strftime('%s', 'now') AS INTEGER)"

    def __init__(self, path: Path, mode: Mode, timeout_s: float) -> None:
        self.place = path
        self._mode = mode
        with raised_as(StorageError, f"cannot open {path}", sqlite3.Error):
            self.raw = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={mode}",
                uri=True,
                timeout=timeout_s,
                isolation_level=None,
                # One thread uses a connection at a time, but another may have opened it.
                check_same_thread=False,
            )
        if mode == "rwc":
            path.chmod(0o600)
            try:
                with self.errors():
                    self.execute("PRAGMA journal_mode=WAL")
                    self.execute("PRAGMA synchronous=FULL")
            except BaseException:
                self.raw.close()
                raise

    def execute(self, statement: str, args: Iterable[object] = ()) -> sqlite3.Cursor:
        return self.raw.execute(statement, tuple(args))

    def execute_many(self, statement: str, rows: list[tuple[object, ...]]) -> None:
        self.raw.executemany(statement, rows)

    def stream(self, statement: str, args: Iterable[object] = ()) -> Iterator[tuple[object, ...]]:
        return iter(self.raw.execute(statement, tuple(args)))

    def has_table(self, name: str) -> bool:
        return self.execute("SELECT 1 FROM sqlite_master WHERE name = ?", (name,)).fetchone() is not None

    def close(self) -> None:
        """Checkpoints the write-ahead log into the database if possible, and closes."""
        if self._mode == "rwc":
            with contextlib.suppress(
                sqlite3.Error
            ):  # all is durable in the log, which the next start checkpoints
                self.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self.raw.close()

    def _reconnect(self) -> None:
        pass

    def _in_transaction(self) -> bool:
        return self.raw.in_transaction

    def _driver_errors(self) -> tuple[type[Exception], ...]:
        return (sqlite3.DatabaseError,)

    def _kind(self, error: Exception) -> tuple[bool, bool]:
        # Operational errors are the machine's (full, locked, I/O), except for statements that do not fit the tables.
        code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF
        passing = isinstance(error, sqlite3.OperationalError) and code != sqlite3.SQLITE_ERROR
        return isinstance(error, sqlite3.IntegrityError), passing


class Postgres(Database):
    """A PostgreSQL database. Its durability is the server's `synchronous_commit`."""

    column_types = {"TEXT": 'TEXT COLLATE "C"', "INTEGER": "BIGINT", "BLOB": "BYTEA"}
    guards = (
        "CREATE FUNCTION journal_stays() RETURNS trigger LANGUAGE plpgsql AS"
        f" $$ BEGIN RAISE integrity_constraint_violation USING MESSAGE = '{_NO_CHANGE}'; END $$",
        "CREATE TRIGGER journal_rows BEFORE UPDATE OR DELETE ON journal FOR EACH ROW EXECUTE FUNCTION journal_stays()",
        "CREATE TRIGGER journal_all BEFORE TRUNCATE ON journal EXECUTE FUNCTION journal_stays()",
    )
    begin_reading = "BEGIN ISOLATION LEVEL REPEATABLE READ"
    shared = " FOR SHARE"
    exclusive = " FOR UPDATE"
    clock = "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS BIGINT)"

    def __init__(self, address: str, *, writes: bool) -> None:
        """Raises ConfigError for an address that cannot be used, LeadLostError when another coordinator keeps the lock,
        StorageError when the server cannot be reached."""
        driver = _psycopg()
        self.place = address
        self._writes = writes
        self._settings = _settings(address)
        self._driver = driver
        self.raw: psycopg.Connection[tuple[Any, ...]] | None = None
        with self.errors():
            pass

    def execute(self, statement: str, args: Iterable[object] = ()) -> psycopg.Cursor[tuple[Any, ...]]:
        return self._open.execute(_theirs(statement), tuple(args))

    def execute_many(self, statement: str, rows: list[tuple[object, ...]]) -> None:
        self._open.cursor().executemany(_theirs(statement), rows)

    def stream(self, statement: str, args: Iterable[object] = ()) -> Iterator[tuple[object, ...]]:
        return self._open.cursor().stream(_theirs(statement), tuple(args))

    def batch(self) -> contextlib.AbstractContextManager[object]:
        return self._open.pipeline()

    def has_table(self, name: str) -> bool:
        return bool(self.execute("SELECT to_regclass(?) IS NOT NULL", (name,)).fetchone() == (True,))

    def close(self) -> None:
        if self.raw is not None:
            self.raw.close()

    def coordinators(self) -> list[tuple[str, bool]]:
        found = self.execute(_COORDINATORS).fetchall()
        return [(name.removeprefix("evopolicy "), leads) for name, leads in found]

    def abort(self) -> None:
        raw = self.raw
        if raw is not None and not raw.closed:
            with contextlib.suppress(OSError), socket.socket(fileno=os.dup(raw.fileno())) as link:
                link.shutdown(socket.SHUT_RDWR)

    @property
    def _open(self) -> psycopg.Connection[tuple[Any, ...]]:
        if self.raw is None:
            raise self._driver.OperationalError("not connected")
        return self.raw

    def _reconnect(self) -> None:
        if self.raw is not None and not self.raw.closed:
            return
        self.raw = None
        raw = self._driver.connect(autocommit=True, **self._settings)
        try:
            for statement in (*_SESSION, *(_ONE_WRITER if self._writes else ())):
                raw.execute(statement)
        except self._driver.errors.LockNotAvailable as error:
            raw.close()
            raise LeadLostError(
                f"{self.place} is in use by another coordinator: stop it, or name another database"
            ) from error
        except BaseException:
            raw.close()
            raise
        self.raw = raw

    def _in_transaction(self) -> bool:
        idle = self._driver.pq.TransactionStatus.IDLE
        return self.raw is not None and not self.raw.closed and self.raw.info.transaction_status != idle

    def _driver_errors(self) -> tuple[type[Exception], ...]:
        return (self._driver.Error,)

    def _kind(self, error: Exception) -> tuple[bool, bool]:
        driver = self._driver
        passing = (driver.OperationalError, driver.InterfaceError, driver.errors.ReadOnlySqlTransaction)
        return isinstance(error, driver.IntegrityError), isinstance(error, passing)


def connect(place: Place, mode: Mode, timeout_s: float) -> Database:
    """Opens a database: to read (`ro`), to change what is there beside a coordinator (`rw`), or as its only writer,
    which may create it (`rwc`). `timeout_s`: how long to wait for another process's transaction. Raises ConfigError,
    StorageError."""
    if isinstance(place, Path):
        return Sqlite(place, mode, timeout_s)
    return Postgres(place, writes=mode == "rwc")


def checked_address(address: str) -> str:
    """The address of a PostgreSQL database. Raises ConfigError when it cannot be used."""
    _psycopg()
    _settings(address)
    return address


def place_of(root: Path, part: StatePart = ROWS) -> Place:
    """Where this part of a state folder is. Raises ConfigError when the folder has no rows."""
    with contextlib.suppress(FileNotFoundError):
        noted = (root / part.note).read_text().strip()
        return noted if "://" in noted else Path(noted)
    if part is ROWS and not (root / DATABASE).is_file():
        raise no_state(root, DATABASE)
    return root / part.own


def chosen_place(root: Path, part: StatePart, named: Place | None) -> Place:
    """Where this part of a state folder is, or for a new one shall be. `named`: by the operator, checked; None: as the
    folder says, else its own. Raises ConfigError when they contradict each other."""
    own = root / part.own
    known = place_of(root, part) if own.exists() or (root / part.note).exists() else None
    if None not in (known, named) and known != named:
        raise ConfigError(
            f"{part.option} {named}: the {part.content} of {root} are in {known}; move them there first with"
            f" evopolicy-coordinator move {part.move} {named} --state {root}"
        )
    return known or named or own


def record_place(root: Path, part: StatePart, place: Place) -> None:
    """Durably notes in the state folder where this part is."""
    if place == root / part.own:
        (root / part.note).unlink(missing_ok=True)
    else:
        write_atomically(root / part.note, f"{place}\n".encode(), mode=0o600)


def _psycopg() -> Any:
    try:
        import psycopg
        import psycopg.conninfo
    except ImportError as error:
        raise ConfigError(
            f"the store is a PostgreSQL database, and its client is not installed ({error}): {add_extra('cluster')}"
        ) from error
    return psycopg


def _settings(address: str) -> dict[str, object]:
    """libpq's settings. Raises ConfigError without the address's password in it."""
    scheme = address.partition(":")[0]
    if scheme not in ("postgresql", "postgres"):
        raise ConfigError(
            f"a store of kind {scheme[:32]!r} is unknown: use postgresql://USER@HOST:PORT/DATABASE"
        )
    try:
        found = _psycopg().conninfo.conninfo_to_dict(address)
    except _psycopg().Error as error:
        raise ConfigError(
            "the store's address cannot be read: use postgresql://USER@HOST/DATABASE"
        ) from error
    if named := [name for name in ("password", "sslpassword") if name in found]:
        raise ConfigError(
            f"the store's address contains a {named[0]}, which other users of this machine can read: remove it, and put"
            " the password into ~/.pgpass, into a file that PGPASSFILE names, or into PGPASSWORD"
        )
    return {**_LINK, **found}


def _theirs(statement: str) -> str:
    return statement.replace("?", "%s")
