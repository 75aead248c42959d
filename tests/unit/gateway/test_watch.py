"""What an operator's terminal is told of an agent holds nothing that steers it."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from evopolicy_gateway.control import AgentDoing
from evopolicy_gateway.suite.suite_view import LinesView
from evopolicy_gateway.watch import Lines, LiveTable, first_line, harmless

STEERING = (
    "\x1b[2J\x1b[1;1Hscore 100",  # clears the screen
    "\x1b]0;title\x07\x1b]52;c;cm0gLXJmIH4=\x1b\\",  # window title, clipboard
    "one\rtwo\b\b\b\x7f\x9b31m",
    "abc\u202edef\u2028\u200b",  # writes backwards, breaks lines
)


@pytest.mark.parametrize("text", STEERING)
def test_an_agents_words_do_not_steer_the_terminal(text: str) -> None:
    out = io.StringIO()
    console = Console(file=out, width=200)
    lines = Lines(console)
    lines.turn("run", 1, text)
    lines.note("run", f"agent failed: {text}")
    lines.doing("run", AgentDoing(action=text, paused_s=1.0))
    table = LiveTable(console)
    table.note("run", text)
    table.turn("run", 1, text)
    console.print(table._table())
    sweep = LinesView(["run"], 1, console)
    sweep.turn("run", 1, text)
    sweep.note("run", text)
    told = out.getvalue()
    assert "run" in told
    assert all(letter.isprintable() or letter == "\n" for letter in told)


def test_what_can_be_shown_is_shown_as_it_is() -> None:
    text = "Größe ×2, 日本 ✓\nline two"
    assert harmless(text) == text
    assert first_line(text) == "Größe ×2, 日本 ✓"
