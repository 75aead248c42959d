"""`evopolicy-coordinator doctor`: checks the PostgreSQL server of a store, and names the coordinators on it.

Exit codes: 0 a coordinator can use it, 1 not.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from evopolicy_common.cli.conventions import State
from evopolicy_common.console import filled_table, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.wire.credentials import default_state_dir
from evopolicy_coordinator.storage.engines import Postgres, checked_address, connect, place_of

_TRIES = 20
_SLOW_S = 0.05
"""A submit waits for a few commits, one after another."""
_OLDEST = 140000
"""PostgreSQL 14 has `idle_session_timeout`, which ends a paused coordinator's lead."""


def doctor(
    state: State = None,
    store: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="The database; default: that of the state folder."),
    ] = None,
) -> None:
    """Check a PostgreSQL database for a coordinator's rows: version, settings, latency, coordinators on it.

    Exit code 0 if a coordinator can use it, 1 if not.
    """
    place = place_of(state or default_state_dir()) if store is None else checked_address(store)
    if not isinstance(place, str):
        raise ConfigError(f"the rows are in {place}; name a PostgreSQL database with --store to check it")
    with contextlib.closing(connect(place, "ro", 10.0)) as db, db.errors():
        assert isinstance(db, Postgres)
        rows = list(_checks(db))
    terminal().print(filled_table(("check", "verdict", "found", "remedy"), rows))
    raise typer.Exit(int(any(verdict == "missing" for _, verdict, *_ in rows)))


def _checks(db: Postgres) -> Iterator[tuple[str, str, str, str]]:
    def one(query: str) -> Any:
        return (db.execute(query).fetchone() or (None,))[0]

    version, wanted = one("SHOW server_version"), int(one("SHOW server_version_num")) >= _OLDEST
    yield "version", "ok" if wanted else "missing", version, "" if wanted else "PostgreSQL 14 or later"
    for setting in ("fsync", "full_page_writes"):
        value = one(f"SHOW {setting}")
        advice = "" if value == "on" else f"set {setting} = on: a power cut may destroy the database"
        yield setting, "missing" if advice else "ok", value, advice
    commit, others = one("SHOW synchronous_commit"), one("SHOW synchronous_standby_names")
    if commit == "off":
        yield (
            "synchronous_commit",
            "missing",
            commit,
            "set it to on: the server's crash loses accepted submits",
        )
    elif others and commit != "remote_apply":
        yield (
            "synchronous_commit",
            "note",
            commit,
            f"remote_apply has a commit on {others} before it is confirmed",
        )
    else:
        where = f"; confirmed on {others}" if others else "; on this server alone"
        yield "synchronous_commit", "ok", commit + where, ""
    has_rows = db.has_table("meta")
    query = f"SELECT value FROM meta WHERE name = 'incarnation'{db.shared}" if has_rows else "SELECT 1"
    took = []
    for _ in range(_TRIES):
        began = time.monotonic()
        with db.transaction():
            one(query)
        took.append(time.monotonic() - began)
    middle = statistics.median(took)
    found = f"{1000 * middle:.1f} ms, at most {1000 * max(took):.1f} ms"
    found += "" if has_rows else " (without rows, and so without writing)"
    advice = "" if middle < _SLOW_S else "put the server nearer, or its log on a faster disk"
    yield "transaction", "note" if advice else "ok", found, advice
    there = db.coordinators()
    for name, leads in there:
        yield "coordinator", "note", f"{name} {'leads' if leads else 'waits'}", ""
    if not there:
        yield "coordinator", "note", "none is connected", ""
