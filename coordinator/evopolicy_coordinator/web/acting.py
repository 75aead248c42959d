"""Actions of an operator on a page, the text of their confirmation, and their log.

Off unless the view was started with `--act`, and then only for holders of the acting token. Every action is written to
the log before it is requested, and again with its outcome.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.logs import structlog
from evopolicy_common.records.json_lines import objects
from evopolicy_common.records.suite_folder import PAUSED
from evopolicy_common.records.summary import utc_text
from evopolicy_common.wire.operator_client import OperatorClient
from evopolicy_coordinator.web.content.run_folders import Sweep

log: structlog.stdlib.BoundLogger = structlog.get_logger()

_TAIL = 64 << 10


class Act(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of act."""

    title: str
    happens: str
    """The act's effect, shown before it is confirmed."""
    needs: str = ""
    """Name of a text that the operator gives; empty for none."""


ACTS: Mapping[tuple[str, str], Act] = {
    ("worker", "pause"): Act(
        title="Pause a worker",
        happens="It gets no more work. It finishes what it holds, and stays until it is resumed.",
    ),
    ("worker", "drain"): Act(
        title="Drain a worker",
        happens="It gets no more work. It finishes what it plays, and then its process ends.",
    ),
    ("worker", "resume"): Act(
        title="Resume a worker",
        happens="It gets work again. A worker that an audit has put into quarantine is trusted again.",
    ),
    ("run", "cancel"): Act(
        title="Cancel a run",
        happens="It ends without a score. What of it is played stops, and its agent is ended. This cannot be undone.",
    ),
    ("run", "repin"): Act(
        title="Repin a run",
        happens="It goes on with workers of another fingerprint class. Its record names both classes and the"
        " reason, and reports tell that versions changed within it.",
        needs="reason",
    ),
    ("sweep", "pause"): Act(
        title="Pause a sweep",
        happens="No further run of it begins, on any host that shares its folder. Runs that have begun go"
        " on to their end.",
    ),
    ("sweep", "resume"): Act(title="Go on with a sweep", happens="Its next runs begin as its limits allow."),
}
_STATES: Mapping[str, Any] = {"pause": "paused", "drain": "draining", "resume": "active"}


class Log:
    """Acts, a JSON object a line, appended."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, **entry: Any) -> None:
        """One line, on the disk when it returns. OSError where the disk refuses: then nothing is done either."""
        self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        line = msgspec.json.encode({"at": utc_text(time.time()), **entry}) + b"\n"
        fd = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            os.write(fd, line)
            os.fsync(fd)
        finally:
            os.close(fd)
        log.info("act", **entry)

    def last(self) -> list[dict[str, Any]]:
        """The last acts, newest first."""
        try:
            with self.path.open("rb") as file:
                file.seek(max(0, self.path.stat().st_size - _TAIL))
                lines = file.read().splitlines()
        except OSError:
            return []
        return list(objects(lines))[::-1]


async def carry_out(
    operator: OperatorClient | None,
    kind: str,
    name: str,
    verb: str,
    sweep: Sweep | None,
    form: Mapping[str, str],
) -> None:
    """Does it. ConfigError for what cannot be asked, RefusedError where the coordinator says no."""
    if kind == "sweep":
        if sweep is None or sweep.root is None or not sweep.is_suite:
            raise ConfigError("there is no such sweep")
        file = sweep.root / PAUSED
        if verb == "pause":
            os.close(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644))
        else:
            file.unlink(missing_ok=True)
    elif operator is None:
        raise ConfigError("the coordinator does not answer now; try again")
    elif kind == "worker":
        await operator.set_worker(name, _STATES[verb])
    elif verb == "cancel":
        await operator.cancel(name)
    else:
        await operator.repin(name, form["class"], form["reason"])


async def logged(book: Log, work: Callable[[], Awaitable[None]], **what: str) -> None:
    """`work`, with its entries in the log."""
    write = partial(asyncio.to_thread, partial(book.write, **what))
    await write(outcome="asked")
    try:
        await work()
    except (EvopolicyError, OSError) as error:
        await write(outcome=f"refused: {error}")
        raise
    await write(outcome="done")
