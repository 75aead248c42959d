"""Moves the rows of a stopped coordinator from one engine to the other, and its blobs to another place.

Rules:
- The rows are copied in one transaction and read back before it is committed: every table has as many rows with the
  same bytes, and the journal's heads follow from its entries. Until then the state folder names the old place.
- The target has no rows of its own. The source keeps its rows; a SQLite file is renamed, so that no coordinator
  starts on it by mistake.
- Each blob is checked where it is read, and read back from its new place before the state folder names that. The old
  place keeps its blobs.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, DamagedStoreError
from evopolicy_common.records import journal
from evopolicy_common.records.blobs import fsync_directory
from evopolicy_coordinator.core.contract.records import JournalRow
from evopolicy_coordinator.storage.engines import (
    BLOBS,
    DATABASE,
    ROWS,
    Database,
    checked_address,
    connect,
    place_of,
    record_place,
)
from evopolicy_coordinator.storage.objects import ObjectBlobs, blobs_of, checked_blobs
from evopolicy_coordinator.storage.state_folder import held_folder, identity_of
from evopolicy_coordinator.storage.store import SCHEMA, TABLES, Store, rows

_CHUNK_BYTES = 4 << 20
_TIMEOUT_S = 30.0
MOVED = f"{DATABASE}.moved"
"""The file from which rows were moved to a server."""


class Moved(msgspec.Struct, frozen=True, kw_only=True):
    """Rows that are in another place now."""

    source: str
    target: str
    rows: dict[str, int]
    """Number by table."""
    head: str
    """Of the journal."""


def move(root: Path, to: str) -> Moved:
    """Moves the rows of the state folder `root` to a server's address, or with `sqlite` into the folder's file.

    Raises ConfigError when a coordinator is running or `to` has rows, StorageError and DamagedStoreError when a
    database refuses or the copy differs; the folder then names the old place.
    """
    source = place_of(root)
    target = root / DATABASE if to == "sqlite" else checked_address(to)
    if source == target:
        raise ConfigError(f"--to {to}: the rows are there already")
    partial = root / f".{DATABASE}.partial"
    with held_folder(root):
        if isinstance(target, Path):
            if target.exists():
                raise ConfigError(f"--to {to}: {target} exists; rename it first")
            partial.unlink(missing_ok=True)
        place = partial if isinstance(target, Path) else target
        Store(place).close()
        with (
            # As a writer: a server then refuses it while a coordinator is connected.
            contextlib.closing(connect(source, "rwc", _TIMEOUT_S)) as old,
            contextlib.closing(connect(place, "rwc", _TIMEOUT_S)) as new,
        ):
            counts, head = copy_rows(old, new)
        if isinstance(target, Path):
            os.replace(partial, target)
            fsync_directory(root)
            record_place(root, ROWS, target)
        else:
            record_place(root, ROWS, target)
            os.replace(root / DATABASE, root / MOVED)
        fsync_directory(root)
    return Moved(source=str(source), target=str(target), rows=counts, head=head)


def move_blobs(root: Path, to: str) -> int:
    """Moves the blobs of the state folder `root` to an object store or a folder, and returns their number.

    Raises ConfigError when a coordinator is running or `to` cannot be used, StorageError when a disk or object store
    refuses or a blob is damaged; the folder then names the old place.
    """
    known, wanted = place_of(root, BLOBS), checked_blobs(to)
    if known == wanted:
        raise ConfigError(f"--blobs {to}: the blobs are there already")
    if isinstance(known, str) and isinstance(wanted, str):
        raise ConfigError(f"--blobs {to}: the blobs are in {known}; move them to a folder first")
    place = place_of(root)
    with held_folder(root), contextlib.closing(connect(place, "rwc", _TIMEOUT_S)):
        old, new = blobs_of(root, place, known), blobs_of(root, place, wanted)
        if isinstance(new, ObjectBlobs):
            new.claim(identity_of(root).operator_token)
            new.forget_all()
        moved = [new.put(old.read_blob(digest)) for digest in tuple(old.digests())]
        new.drop_unfinished()  # the copies too, so that the object store is read
        for digest in moved:
            new.read_blob(digest)
        record_place(root, BLOBS, wanted)
    return len(moved)


def copy_rows(source: Database, target: Database) -> tuple[dict[str, int], str]:
    """Copies all rows as of one instant into empty tables, and reads them back. Returns the number of rows by table,
    and the journal's head."""
    counts = {}
    with source.errors(), target.errors(), source.transaction(source.begin_reading), target.transaction():
        target.execute("DELETE FROM meta")
        for table in TABLES:
            if target.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone() is not None:
                raise ConfigError(f"{target.place} has rows in table {table}: name an empty database")
            copied = hashlib.sha256()
            counts[table] = 0
            for chunk in _chunks(_ordered(source, table)):
                marks = ", ".join("?" * len(chunk[0]))
                target.execute_many(f"INSERT INTO {table} VALUES ({marks})", chunk)
                counts[table] += len(chunk)
                for row in chunk:
                    copied.update(repr(row).encode())
            found = hashlib.sha256()
            for row in _ordered(target, table):
                found.update(repr(row).encode())
            if found.digest() != copied.digest():
                raise DamagedStoreError(f"table {table} differs after copying it from {source.place}")
        schema = target.execute("SELECT value FROM meta WHERE name = 'schema'").fetchone()
        if schema != (SCHEMA,):
            raise ConfigError(f"{source.place} has schema {schema}, not {SCHEMA}")
        return counts, _checked_head(target)


def _checked_head(db: Database) -> str:
    """The journal's head. Raises DamagedStoreError when one does not follow from the entries."""
    entries = tuple(rows(db, JournalRow, "ORDER BY seq"))
    heads = list(journal.heads([row.entry for row in entries]))
    for row, head in zip(entries, heads, strict=True):
        if row.head != head:
            raise DamagedStoreError(
                f"the journal's entry {row.seq} has head {row.head}, and its bytes have {head}"
            )
    return heads[-1] if heads else journal.EMPTY_HEAD


def _ordered(db: Database, table: str) -> Iterator[tuple[object, ...]]:
    """All rows of a table, in the order of their first two columns."""
    return db.stream(f"SELECT * FROM {table} ORDER BY 1, 2")


def _chunks(found: Iterator[tuple[object, ...]]) -> Iterator[list[tuple[object, ...]]]:
    chunk: list[tuple[object, ...]] = []
    size = 0
    for row in found:
        chunk.append(row)
        size += sum(len(value) for value in row if isinstance(value, bytes))
        if size > _CHUNK_BYTES or len(chunk) == 1000:
            yield chunk
            chunk, size = [], 0
    if chunk:
        yield chunk
