"""All output of commands goes through this module.

Texts of policies, agents, exceptions and file names reach a terminal. An escape sequence in one of them could clear the
screen, forge a link or overwrite earlier output; square brackets could be taken for markup. So no markup is
interpreted, and every unprintable character is shown as U+FFFD. `tests/unit/test_rooms.py` enforces this in all rooms.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, TextIO

from evopolicy_common.installation import as_called

if TYPE_CHECKING:
    from typing_extensions import Buffer

_ODD = re.compile(r"[^\n\t -~]")
READER_GONE = 128 + signal.SIGPIPE
"""Exit status of a program whose reader is gone, as a shell reports it."""


def harmless(text: str) -> str:
    """Returns `text` with U+FFFD for every unprintable character; newlines and tabs stay."""
    return _ODD.sub(_shown, text)


def one_line(text: str) -> str:
    """As `harmless`, with spaces for newlines and tabs, so that no part of `text` can look like another line."""
    return harmless(text.replace("\n", " ").replace("\t", " "))


def shortened(text: str) -> str:
    """The text without the middle of each word of over 400 characters, and of a text that has over 4,000 even so."""
    text = re.sub(r"\S{401,}", lambda word: f"{word[0][:200]}…{word[0][-100:]}", text)
    return text if len(text) <= 4_000 else f"{text[:2_000]} … {text[-1_900:]}"


# A number, or two as in an interval: `-1.5`, `-1.5 to +2e3`.
_NUMBERS = re.compile(r"[-+]?[0-9][0-9.]*(?:e[-+]?[0-9]+)?(?: to [-+]?[0-9][0-9.]*(?:e[-+]?[0-9]+)?)?")


def csv_cell(value: object) -> object:
    """The value for a CSV file: empty for None; texts `harmless`, an apostrophe before formulas."""
    if value is None:
        return ""
    if not isinstance(value, str):
        return value
    text = harmless(value)
    formula = text.lstrip().startswith(("=", "+", "-", "@")) and not _NUMBERS.fullmatch(text)
    return f"'{text}" if formula else text


def event_text(event: str, values: Mapping[str, object]) -> str:
    """An event of a log as people read it: `slot was stopped from outside (2 s): …`. Values named `why`,
    `error` or `detail` are its reason, seconds (`…_s`) need no name, and empty ones are left out."""
    given = {name: value for name, value in values.items() if value not in ("", None)}
    reasons = [str(given.pop(name)) for name in ("why", "error", "detail") if name in given]
    details = ", ".join(
        f"{value} s" if name.endswith("_s") else f"{name.replace('_', ' ')} {value}"
        for name, value in given.items()
    )
    return ": ".join([event + (f" ({details})" if details else ""), *reasons])


def number(value: float | None) -> str:
    """Formats a number for a table: four digits, or a dash for None."""
    return "–" if value is None else f"{value:.4g}"


def counted(n: int, what: str) -> str:
    """A number of things: `1 run`, `2,000 runs`."""
    return f"{n:,} {what}{'s' * (n != 1)}"


def short(value: float) -> str:
    """A large number in few characters."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:g}"


def duration(seconds: float | None) -> str:
    """How long something takes, such as `5 min`; a dash for None."""
    if seconds is None:
        return "–"
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _shown(match: re.Match[str]) -> str:
    # Surrogates, which no stream can encode, are not printable either.
    return match[0] if match[0].isprintable() else "\N{REPLACEMENT CHARACTER}"


def say(text: str, *, err: bool = False) -> None:
    """Prints `text`, with our commands `as_called`, on stdout, or on stderr, whose reader may be gone."""
    with contextlib.suppress(BrokenPipeError) if err else contextlib.nullcontext():
        print(harmless(as_called(text)), file=sys.stderr if err else sys.stdout, flush=True)


def say_lines(lines: Iterable[str], *, err: bool = False) -> None:
    """Prints each of `lines` as exactly one line."""
    for line in lines:
        say(one_line(line), err=err)


def say_json(value: object, *, indent: bool = True) -> None:
    """Prints `value` as JSON on stdout, indented or on one line. Unprintable characters are escaped."""
    import json

    import msgspec

    try:
        data = msgspec.json.encode(value)
        text = (msgspec.json.format(data, indent=2) if indent else data).decode()
    except UnicodeEncodeError:
        # It contains a file name that is not UTF-8.
        text = json.dumps(msgspec.to_builtins(value), indent=2 if indent else None)
    print(_ODD.sub(_escaped, text), flush=True)


def _escaped(match: re.Match[str]) -> str:
    import json

    return match[0] if match[0].isprintable() else json.dumps(match[0])[1:-1]


class _WatchedStdout(io.FileIO):
    """Stdout that exits the program quietly and in order when its reader is gone, with the exit status of SIGPIPE."""

    def write(self, data: Buffer, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            import logging

            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.fileno())
            # SystemExit ends the loop, so asyncio must not report an unretrieved exception of the task.
            logging.getLogger("asyncio").addFilter(
                lambda record: not (record.exc_info and isinstance(record.exc_info[1], SystemExit))
            )
            raise SystemExit(READER_GONE) from None


def open_streams() -> None:
    """Opens `/dev/null` for missing stdin, stdout or stderr (`2>&-`): the next file that is opened, perhaps a
    database, would receive that output."""
    for fd, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(fd)
        except OSError:
            assert os.open(os.devnull, os.O_RDWR) == fd
            setattr(sys, name, os.fdopen(fd, mode, closefd=False))


class _LossyStderr(io.FileIO):
    """Stderr that loses what cannot be written (disk full, reader gone), so that it does not change the exit code."""

    def write(self, data: Buffer, /) -> int:
        try:
            return super().write(data)
        except OSError:
            return len(memoryview(data))


def end_without_reader() -> None:
    """Makes the program exit with `READER_GONE` when it prints to a closed pipe, as in `evopolicy status | head -1`.
    Stderr may be closed."""
    sys.stdout = _replaced(sys.stdout, _WatchedStdout)
    sys.stderr = _replaced(sys.stderr, _LossyStderr)


def _replaced(stream: TextIO, raw: type[io.FileIO]) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):
        return stream  # closed, or replaced by someone else
    return io.TextIOWrapper(
        io.BufferedWriter(raw(stream.fileno(), "wb", closefd=False)),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
    )
