"""Backups of a state folder, also of one whose coordinator is running.

Rules:
- The database is copied first, as of one instant (SQLite's online backup, a server's rows into a SQLite file), the
  blobs after it. A blob is durable before any row names it, so the copy contains every blob that its rows name.
- A backup is built under a temporary name and renamed at the end, so an existing backup is complete, durable and
  checked.
- A backup is a state folder. To restore it, copy it to the old state's path and start a coordinator on it. Workers
  and gateways find the same passwords and tokens and continue; work done after the backup is played again.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, StorageError, raised_as
from evopolicy_common.records.blobs import BlobStore, fsync_directory, write_atomically
from evopolicy_coordinator.storage.engines import DATABASE, Place, connect, place_of
from evopolicy_coordinator.storage.moving import copy_rows
from evopolicy_coordinator.storage.objects import blobs_of
from evopolicy_coordinator.storage.sealing import SHARED_FILES
from evopolicy_coordinator.storage.store import Store

_TIMEOUT_S = 30.0
KEPT_FILES = (*SHARED_FILES, "certs/coordinator.pem", "certs/coordinator-key.pem")
"""The cluster's identity, besides its database and blobs. A start creates everything else again."""


class Backup(msgspec.Struct, frozen=True, kw_only=True):
    path: str
    blobs: int
    bytes: int
    """Size of the database and the blobs."""


def back_up(state: Path, target: Path) -> Backup:
    """Copies the state folder to `target`, which must be missing or empty.

    Raises ConfigError when there is no state or no place for the copy, StorageError when the disk refuses or the copy
    is damaged; nothing is then left at `target`.
    """
    source = place_of(state)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError(f"{target} already exists; name a new folder for the backup")
    partial = target.with_name(f".{target.name}.partial")
    try:
        if partial.exists():
            shutil.rmtree(partial)
        partial.mkdir(parents=True, mode=0o700)
        blobs, size = _copy(state, source, partial)
        os.replace(partial, target)
        fsync_directory(target.parent)
    except OSError as error:
        raise StorageError(f"cannot back up to {target}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Backup(path=str(target), blobs=blobs, bytes=size)


def _copy(state: Path, place: Place, folder: Path) -> tuple[int, int]:
    """Returns the number of blobs, and the bytes of database and blobs."""
    for name in KEPT_FILES:
        # Splits from files need no secret, a single machine no certificates.
        with contextlib.suppress(FileNotFoundError):
            data = (state / name).read_bytes()
            (folder / name).parent.mkdir(mode=0o700, exist_ok=True)
            write_atomically(folder / name, data, mode=0o600)
    database = folder / DATABASE
    _copy_database(place, database)
    source, blobs = blobs_of(state, place), BlobStore(folder / "blobs")
    count, total = 0, database.stat().st_size
    for digest in source.digests():
        data = source.read_blob(digest)
        blobs.put(data)
        count, total = count + 1, total + len(data)
    return count, total


def _copy_database(source: Place, target: Path) -> None:
    """Makes a consistent copy while others write: readable by its owner only, durable, checked."""
    if isinstance(source, str):
        Store(target).close()
        old, new = connect(source, "ro", _TIMEOUT_S), connect(target, "rwc", _TIMEOUT_S)
        with contextlib.closing(old), contextlib.closing(new):
            copy_rows(old, new)
            return
    with (
        raised_as(StorageError, f"cannot copy {source}", sqlite3.Error),
        contextlib.closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=ro", uri=True)) as reader,
        contextlib.closing(sqlite3.connect(target, isolation_level=None)) as writer,
    ):
        target.chmod(0o600)
        # In one step: a copy in several steps would restart at every write of the coordinator.
        reader.backup(writer)
        writer.execute("PRAGMA journal_mode=DELETE")
        (verdict,) = writer.execute("PRAGMA integrity_check").fetchone()
    if verdict != "ok":
        raise StorageError(f"{source} is damaged: {verdict}")
    with target.open("rb") as file:
        os.fsync(file.fileno())
