"""What reaches a terminal: text as it is, never markup, never what steers the terminal."""

from __future__ import annotations

import io
import json

import pytest
from rich.live import Live
from rich.table import Table
from rich.text import Text

from evopolicy_common.cli.conventions import fail, setup_logging, setup_notices
from evopolicy_common.console import Terminal
from evopolicy_common.logs import structlog
from evopolicy_common.terminal import one_line, say, say_json, say_lines

STEERING = [
    "\x1b[2J\x1b[1;1Hscore 100",  # clears the screen
    "\x1b]8;;http://evil\x1b\\link\x1b]8;;\x1b\\",  # a link
    "\x9b31mred\x9d8;;http://evil\x9c",  # the same by single control characters
    "abc\u202edef\u2028\u200b",  # writes backwards, breaks lines
    "\udcff\ud800",  # bytes of a file name that are no UTF-8
]
MARKUP = "[/x] [bold]b[/bold] [link=http://evil]l[/link] :smile:"


def is_plain(text: str) -> bool:
    return all(letter.isprintable() or letter == "\n" for letter in text)


def test_a_warning_reaches_people_as_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    try:
        setup_notices()
        log = structlog.get_logger()
        log.warning("still waiting for the coordinator", waited_s=28, why="no answer to 'poll'", detail="")
        log.warning("the event loop was blocked", first_seen=3)
    finally:
        structlog.reset_defaults()
    assert capsys.readouterr().err.splitlines() == [
        "still waiting for the coordinator (28 s): no answer to 'poll'",
        "the event loop was blocked (first seen 3)",
    ]


def on_terminal() -> tuple[Terminal, io.StringIO]:
    out = io.StringIO()
    return Terminal(file=out, width=200, force_terminal=True, color_system="truecolor"), out


@pytest.mark.parametrize("text", STEERING)
def test_nothing_printed_steers_the_terminal(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(text)
    say(text, err=True)
    say_lines([text])
    with pytest.raises(SystemExit):
        fail(text)
    captured = capsys.readouterr()
    assert is_plain(captured.out + captured.err)
    assert "error: " in captured.err
    console, out = on_terminal()
    table = Table(title=text, box=None)
    table.add_column(text)
    table.add_row(text)
    table.add_row(Text(text))
    for shown in (text, Text(text), table):
        console.print(shown)
    assert is_plain(out.getvalue().replace("\x1b[0m", "").replace("\x1b[1m", "").replace("\x1b[3m", ""))


def test_a_live_table_still_moves_the_cursor() -> None:
    console, out = on_terminal()
    with Live("a\nb", console=console, auto_refresh=False) as live:
        live.update("c", refresh=True)
    assert "\x1b[1A" in out.getvalue()


def test_square_brackets_are_no_markup() -> None:
    console, out = on_terminal()
    table = Table(box=None)
    table.add_column("x")
    table.add_row(MARKUP)
    console.print(MARKUP)
    console.print(table)
    assert out.getvalue().count(MARKUP) == 2


def test_a_line_cannot_pass_for_several(capsys: pytest.CaptureFixture[str]) -> None:
    say_lines(["a\nno difference", "b\tc"])
    assert capsys.readouterr().out == "a no difference\nb c\n"
    assert one_line("a\r\n\x0bb") == "a\ufffd \ufffdb"


@pytest.mark.parametrize("text", [*STEERING, "plain – ü 漢"])
@pytest.mark.parametrize("indent", [True, False])
def test_json_escapes_what_is_not_printable_and_stays_the_same_value(
    text: str, indent: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    say_json({"text": [text]}, indent=indent)
    printed = capsys.readouterr().out
    assert is_plain(printed)
    assert json.loads(printed) == {"text": [text]}


@pytest.mark.parametrize("text", STEERING)
def test_log_lines_on_a_terminal_are_harmless(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import structlog

    stderr = io.StringIO()
    monkeypatch.setattr(stderr, "isatty", lambda: True)
    monkeypatch.setattr("sys.stderr", stderr)
    try:
        setup_logging()
        structlog.get_logger().info("said", text=text, other=[text])
    finally:
        structlog.reset_defaults()
    output = stderr.getvalue()
    assert "said" in output
    assert not any(piece in output for piece in ("\x1b[2J", "\x1b]", "\x9b", "\x9d", "\u202e", "\udcff"))
