"""Disk use of a state folder: its breakdown, its garbage collection, and an estimate for a sweep.

Rules:
- An operator finds everything about a finished run in its run directory. The coordinator keeps the run's outcome for
  good, and its episodes and bundles until they are collected.
- A blob is deleted when no row names it and it was last stored or held more than `UNNAMED_S` before: it may have been
  uploaded for a row that is about to be written. Which blobs are that old is read first, and which are named after it.
- Collection is safe beside a running coordinator; only shrinking the database file waits until none runs.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, StorageError
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.messages.status import DiskUse
from evopolicy_coordinator.core.contract.records import (
    BegunRow,
    EvaluationRow,
    OutcomeRow,
    RunRow,
    SubmitRow,
    evaluation_group,
)
from evopolicy_coordinator.storage.engines import DATABASE, Database, connect, place_of
from evopolicy_coordinator.storage.objects import ObjectBlobs, blobs_of
from evopolicy_coordinator.storage.state_folder import lock
from evopolicy_coordinator.storage.store import named_blobs, rows

Bounds = tuple[str, str]
"""Group ids from the first (inclusive) to the second (exclusive)."""

UNNAMED_S = 24 * 3600.0
BUSY_TIMEOUT_S = 30.0
_TRAIN = "%/train"
GUESS_BYTES = 1 << 20
"""Bytes assumed for an episode when nothing is stored of any environment."""


class Collected(msgspec.Struct, frozen=True, kw_only=True):
    """The removed data, or the data to be removed."""

    runs: int
    evaluations: int
    episodes: int
    blobs: int
    bytes: int
    """Size of the episodes' rows and the blobs."""
    shrunk: bool
    """Whether the database file was shrunk; otherwise later rows reuse its free space."""
    free_bytes: int


class EnvironmentUse(msgspec.Struct):
    """Disk use of the stored runs of one environment."""

    env: str
    runs: int = 0
    train_episodes: int = 0
    bytes: int = 0
    """Rows and blobs, including hidden episodes."""

    @property
    def bytes_per_episode(self) -> float:
        """Bytes per train episode, including its share of the hidden ones."""
        return self.bytes / self.train_episodes


class DiskEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """Estimated disk use of a sweep on the coordinator."""

    bytes: int
    free_bytes: int
    guessed: tuple[str, ...]
    """Environments without stored episodes: assumed to be like the largest known one."""

    @property
    def fits(self) -> bool:
        return self.bytes <= self.free_bytes


def collect(
    state: Path, older_than_s: float, *, dry_run: bool = False, now: float | None = None
) -> Collected:
    """Removes episodes and bundles of runs and evaluations older than `older_than_s` seconds, then unnamed blobs.

    The age of a run counts from its end, that of a finished evaluation from its creation. `now`: Unix time. Raises
    ConfigError when `state` is no state folder, StorageError when the database refuses.
    """
    now = time.time() if now is None else now
    with _database(state) as db:
        blobs = blobs_of(state, place_of(state))
        unheld = blobs.unheld(UNNAMED_S, now, dry_run=dry_run)  # before it is read which ones are named
        old_runs = [row.run for row in rows(db, RunFinished) if row.finished_at < now - older_than_s]
        old = (
            row
            for row in rows(db, EvaluationRow, "WHERE finished = 1")
            if row.created_at < now - older_than_s
        )
        old_evaluations = [row.evaluation for row in old]
        groups = [evaluation_group(evaluation) for evaluation in old_evaluations]
        gone = [*map(_of_run, old_runs), *((group, f"{group}\x01") for group in groups)]
        named = _named(db, frozenset(old_runs), frozenset(old_evaluations))
        sizes = [_size(db, bounds) for bounds in gone]
        unnamed = {digest: found for digest, found in unheld.items() if digest not in named}
        stored = blobs.sizes() if unnamed else {}
        bytes_ = sum(size for _, size in sizes) + sum(stored.get(digest, 0) for digest in unnamed)
        shrunk = False
        if not dry_run:
            for bounds in gone:
                # Deletes these rows in one short transaction, so that a running coordinator never waits long.
                with db.transaction():
                    for table in ("outcomes", "begun"):
                        db.execute(f"DELETE FROM {table} WHERE grp >= ? AND grp < ?", bounds)
            for run in old_runs:
                db.execute("DELETE FROM train_blobs WHERE run = ?", (run,))
            for digest, found in unnamed.items():
                blobs.delete(digest, found)
            if isinstance(blobs, ObjectBlobs):
                blobs.sweep()
            shrunk = _shrink(state, db)
    return Collected(
        runs=sum(n > 0 for n, _ in sizes[: len(old_runs)]),
        evaluations=sum(n > 0 for n, _ in sizes[len(old_runs) :]),
        episodes=sum(n for n, _ in sizes),
        blobs=len(unnamed),
        bytes=bytes_,
        shrunk=shrunk,
        free_bytes=shutil.disk_usage(state).free,
    )


def sizes(state: Path) -> DiskUse:
    """Size of the database, and the state folder's disk. Raises OSError."""
    disk = shutil.disk_usage(state)
    with contextlib.suppress(ConfigError):
        if isinstance(place_of(state), str):
            return DiskUse(database=_server_bytes(state), free=disk.free, total=disk.total)
    with os.scandir(state) as entries:
        database = sum(entry.stat().st_size for entry in entries if entry.name.startswith(DATABASE))
    return DiskUse(database=database, free=disk.free, total=disk.total)


def _server_bytes(state: Path) -> int:
    try:
        with _database(state) as db:
            return int(db.execute("SELECT pg_database_size(current_database())").fetchone()[0])
    except StorageError as error:
        raise OSError(str(error)) from error


def use(state: Path) -> list[EnvironmentUse]:
    """Disk use of the stored runs by environment, largest first; runs whose episodes were collected are left out."""
    by_env: dict[str, EnvironmentUse] = {}
    with _database(state) as db:
        stored = blobs_of(state, place_of(state)).sizes()
        for run in tuple(rows(db, RunRow)):
            train = db.execute(
                "SELECT COUNT(*) FROM outcomes WHERE grp >= ? AND grp < ? AND grp LIKE ?",
                (*_of_run(run.run), _TRAIN),
            ).fetchone()[0]
            if not train:
                continue
            _, size = _size(db, _of_run(run.run))
            digests = db.execute("SELECT digest FROM train_blobs WHERE run = ?", (run.run,)).fetchall()
            size += sum(stored.get(digest, 0) for (digest,) in digests)
            one = by_env.setdefault(run.settings.env, EnvironmentUse(run.settings.env))
            one.runs += 1
            one.train_episodes += train
            one.bytes += size
    return sorted(by_env.values(), key=lambda each: -each.bytes)


def estimate(state: Path, planned: dict[str, int]) -> DiskEstimate:
    """Estimates the disk use of `planned` train episodes by environment, from the stored episodes of each."""
    known = {each.env: each.bytes_per_episode for each in use(state)}
    guess = max(known.values(), default=float(GUESS_BYTES))
    return DiskEstimate(
        bytes=round(sum(n * known.get(env, guess) for env, n in planned.items())),
        free_bytes=shutil.disk_usage(state).free,
        guessed=tuple(env for env in planned if env not in known),
    )


@contextlib.contextmanager
def _database(state: Path) -> Iterator[Database]:
    db = connect(place_of(state), "rw", BUSY_TIMEOUT_S)
    with contextlib.closing(db), db.errors():
        yield db


def _of_run(run: str) -> Bounds:
    return f"{run}/", f"{run}0"  # "0" is the character after "/"


def _size(db: Database, bounds: Bounds) -> tuple[int, int]:
    """Number and bytes of the outcomes of these groups."""
    query = "SELECT COUNT(*), COALESCE(SUM(LENGTH(head) + LENGTH(data)), 0) FROM outcomes WHERE grp >= ? AND grp < ?"
    n, size = db.execute(query, bounds).fetchone()
    return n, int(size)


def _named(db: Database, old_runs: frozenset[str], old_evaluations: frozenset[str]) -> set[str]:
    """Digests of all blobs that the remaining rows name."""
    named: set[str] = set()
    for submit in rows(db, SubmitRow):
        if submit.run not in old_runs:
            named.update(named_blobs(submit))
    for evaluation in rows(db, EvaluationRow):
        if evaluation.evaluation not in old_evaluations:
            named.update(named_blobs(evaluation))
    train_blobs = db.stream("SELECT run, digest FROM train_blobs")
    named |= {digest for run, digest in train_blobs if run not in old_runs}
    for begun in rows(db, BegunRow):
        named.update(named_blobs(begun))
    for row in rows(db, OutcomeRow, "WHERE grp NOT LIKE ?", (_TRAIN,)):
        head, _, tail = row.group.partition("/")
        if head not in old_runs and not (head == "evaluation" and tail in old_evaluations):
            named.update(named_blobs(row))
    return named


def _shrink(state: Path, db: Database) -> bool:
    """Returns a file's free pages to the disk, unless a coordinator would have to wait for it. A server does so by
    itself."""
    if not isinstance(db.place, Path):
        return False
    try:
        fd = lock(state)
    except ConfigError:
        return False
    try:
        db.execute("VACUUM")
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    finally:
        os.close(fd)
    return True
