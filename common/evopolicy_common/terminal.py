"""Everything that a command prints goes through here.

Texts of policies, agents, exceptions and file names reach a terminal. An escape sequence in one of them could clear the
screen, forge a link or write over what stands there; square brackets could be taken for markup. So no markup is read, and
every character that is not printable is shown as U+FFFD. `tests/unit/test_rooms.py` holds the rooms to it.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import re
import signal
import sys
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any

import msgspec
import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from typing_extensions import Buffer

_ODD = re.compile(r"[^\n\t -~]")
READER_GONE = 128 + signal.SIGPIPE
"""Exit status of a program that nobody reads any more, as a shell tells it."""
WIDTH = 200
"""Columns where there is no terminal: a table that is cut off is worse than a long line."""


def harmless(text: str) -> str:
    """`text` with U+FFFD for every character that is not printable; newlines and tabs stay."""
    return _ODD.sub(_shown, text)


def one_line(text: str) -> str:
    """As `harmless`, with spaces for newlines and tabs: nothing in it can pass for a further line."""
    return harmless(text.replace("\n", " ").replace("\t", " "))


def _shown(found: re.Match[str]) -> str:
    # Surrogates, which no stream can encode, are not printable either.
    return found[0] if found[0].isprintable() else "\N{REPLACEMENT CHARACTER}"


def say(text: str, *, err: bool = False) -> None:
    """Prints `text` and a newline on stdout, or on stderr, where it is lost if nobody reads that any more."""
    with contextlib.suppress(BrokenPipeError) if err else contextlib.nullcontext():
        print(harmless(text), file=sys.stderr if err else sys.stdout, flush=True)


def say_lines(lines: Iterable[str], *, err: bool = False) -> None:
    """Prints each of `lines` as exactly one line."""
    for line in lines:
        say(one_line(line), err=err)


def say_json(value: Any, *, indent: bool = True) -> None:
    """Prints `value` as JSON on stdout: over several lines, or on one. Characters that are not printable are escaped."""
    try:
        data = msgspec.json.encode(value)
        text = (msgspec.json.format(data, indent=2) if indent else data).decode()
    except UnicodeEncodeError:
        # A file name that is no UTF-8 is in it.
        text = json.dumps(msgspec.to_builtins(value), indent=2 if indent else None)
    print(_ODD.sub(_escaped, text), flush=True)


def _escaped(found: re.Match[str]) -> str:
    return found[0] if found[0].isprintable() else json.dumps(found[0])[1:-1]


class _WatchedStdout(io.FileIO):
    """Stdout that ends the program when its reader is gone: quietly, in order, and as SIGPIPE would have it."""

    def write(self, data: Buffer, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.fileno())
            raise SystemExit(READER_GONE) from None


def open_streams() -> None:
    """Gives a program that was started without stdin, stdout or stderr (`2>&-`) ones that lead nowhere.

    Else the next file that is opened, a database perhaps, gets what is written there.
    """
    for fd, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(fd)
        except OSError:
            assert os.open(os.devnull, os.O_RDWR) == fd
            setattr(sys, name, os.fdopen(fd, mode, closefd=False))


def end_without_reader() -> None:
    """From now on the program ends with `READER_GONE` when it prints what nobody reads, as in `evopolicy status | head -1`."""
    stream = sys.stdout
    if not isinstance(stream, io.TextIOWrapper):
        return  # closed, or not ours
    # The loop that a task ends with it is as good as told: asyncio need not complain that nobody looked at the task.
    logging.getLogger("asyncio").addFilter(_is_no_exit)
    raw = _WatchedStdout(stream.fileno(), "wb", closefd=False)
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
    )


def _is_no_exit(record: logging.LogRecord) -> bool:
    return not (record.exc_info and isinstance(record.exc_info[1], SystemExit))


class Terminal(rich.console.Console):
    """A console that takes texts as they are: no markup, no emoji codes, nothing that is not printable."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(harmless(text), **options)

    def on_broken_pipe(self) -> None:
        # Of stderr: the results are on stdout, which ends the program by itself.
        self.quiet = True

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            # Control segments are rich's own: they move the cursor of a live table.
            yield segment if segment.control else segment._replace(text=harmless(segment.text))


def table(*headings: str, right: Collection[str] = ()) -> Table:
    """A table that cuts nothing: where the terminal is narrow, cells fold, as other commands need what stands in them.

    `right`: headings of columns that are aligned at the right.
    """
    made = Table(box=None, pad_edge=False)
    for heading in headings:
        made.add_column(heading, overflow="fold", justify="right" if heading in right else "left")
    return made


def terminal(*, stderr: bool = False) -> Terminal:
    """For people: as wide as their terminal, and `WIDTH` columns where there is none."""
    found = Terminal(stderr=stderr)
    return found if found.is_terminal else Terminal(stderr=stderr, width=WIDTH)
