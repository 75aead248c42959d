"""Shared by all commands: options that name a cluster, logging to stderr, and our errors as one line and an exit code.

Help and completion import this module, so large modules are imported where they are used.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Coroutine, Iterable, Iterator, MutableMapping
from pathlib import Path
from typing import Annotated, Any, NoReturn, TextIO, TypeVar, cast

import typer

from evopolicy_common.errors import ConfigError, DamagedStoreError, EvopolicyError, MachineError
from evopolicy_common.installation import as_called
from evopolicy_common.processes.preflight import explained
from evopolicy_common.terminal import event_text, harmless, one_line, say_lines, shortened

T = TypeVar("T")

CLUSTER = "Cluster"
"""Heading of these options in a command's help."""
Connect = Annotated[
    list[str] | None,
    typer.Option(
        help="Endpoint of the coordinator, such as tls/10.0.0.5:7447; may be repeated. Default: this machine's own.",
        rich_help_panel=CLUSTER,
    ),
]
CredentialsFile = Annotated[
    Path | None,
    typer.Option(
        "--credentials",
        help="Folder of `evopolicy-coordinator certs issue operator`, or STATE/credentials of the"
        " coordinator.",
        rich_help_panel=CLUSTER,
    ),
]
"""Options by which an operator's command finds its cluster."""

State = Annotated[
    Path | None,
    typer.Option(
        "--state", help="The coordinator's state folder [$EVOPOLICY_STATE or the user's state home]."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]

USAGE_ERROR = 2
FAILURE = 1


class _Stderr:
    """Stream for log lines. Lines that cannot be written (disk full, reader gone) are lost without an error."""

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()


def bytes_text(n: float) -> str:
    """Formats a number of bytes for people, such as `3.4 GiB`."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if n < 1024:
            return f"{n:.0f} {unit}" if unit == "B" else f"{n:.1f} {unit}"
        n /= 1024
    return f"{n:.1f} TiB"


def setup_logging(level: str = "info") -> None:
    """Configures structured logs on stderr: readable on a terminal, JSON lines otherwise."""
    import logging

    from evopolicy_common.logs import structlog

    def harmless_values(_: object, __: str, event: MutableMapping[str, object]) -> MutableMapping[str, Any]:
        # Any value may contain text of a policy or an agent. JSON lines escape it.
        return {name: harmless(value) if isinstance(value, str) else value for name, value in event.items()}

    terminal = sys.stderr.isatty()
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso" if not terminal else "%H:%M:%S", utc=not terminal),
            structlog.processors.format_exc_info,
            *((harmless_values,) if terminal else ()),
            structlog.dev.ConsoleRenderer() if terminal else structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=structlog.PrintLoggerFactory(file=cast(TextIO, _Stderr())),
        cache_logger_on_first_use=True,
    )


def setup_notices() -> None:
    """For interactive commands and scripts: prints warnings as plain lines on stderr; stdout holds results only."""
    import logging

    from evopolicy_common.logs import structlog

    def plain(_: Any, __: str, event: Any) -> str:
        text, error = str(event.pop("event")), event.pop("exc_info", None)
        return one_line(as_called(event_text(text, event) + (f": {error!r}" if error else "")))

    structlog.configure(
        processors=[plain],
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING),
        logger_factory=structlog.PrintLoggerFactory(file=cast(TextIO, _Stderr())),
    )


def fail(message: str, code: int = USAGE_ERROR, notes: Iterable[str] = ()) -> NoReturn:
    """Ends the command with one line on stderr, of bearable length, and one for each note."""
    say_lines([f"error: {shortened(message)}", *notes], err=True)
    raise SystemExit(code)


def code_of(error: ConfigError | DamagedStoreError) -> int:
    """Exit code of a program that cannot start: one with wrong options or a damaged store is not restarted."""
    return FAILURE if isinstance(error, MachineError) else USAGE_ERROR


@contextlib.contextmanager
def fail_on_our_errors() -> Iterator[None]:
    """Turns our errors into a line, notes, and an exit code: 2 for wrong options and files, else 1."""
    try:
        yield
    except (ConfigError, DamagedStoreError) as error:
        fail(str(error), code_of(error), getattr(error, "__notes__", ()))
    except EvopolicyError as error:
        fail(str(error), FAILURE)
    except OSError as error:
        # Fallback for what the machine refuses after the preflight checks.
        text = explained(error)
        if text is None:
            raise
        fail(text, FAILURE)
    except UnicodeEncodeError as error:
        if not any(str(error.object) in word for word in sys.argv):
            raise
        fail(f"{harmless(str(error.object))!r} is not UTF-8, which names and messages are: choose another")
    except KeyboardInterrupt:
        fail("interrupted", 130)


def run_to_end(work: Coroutine[Any, Any, T]) -> T:
    """Runs `work` to its end; SIGTERM cancels it and ends the command as Ctrl-C does."""
    import asyncio

    try:
        return asyncio.run(work)
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None


def end_on_sigterm() -> None:
    """SIGTERM cancels the calling task, as Ctrl-C does; SIGHUP does not, as the run can be resumed."""
    import asyncio

    main = asyncio.current_task()
    assert main is not None
    with contextlib.suppress(RuntimeError, ValueError):  # no signal handlers outside the main thread
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, main.cancel)
