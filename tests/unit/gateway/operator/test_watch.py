"""The operator's terminal shows why runs wait, and nothing of an agent's that steers it.

Attacks, each with its defence:
- prints terminal escape sequences: shown as plain characters.
"""

from __future__ import annotations

import io

import msgspec
import pytest

from evopolicy_common.console import Terminal
from evopolicy_common.messages.gateway import FREE_SLOT
from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.terminal import harmless
from evopolicy_gateway.processes.child_messages import AgentDoing, TrainProgress
from evopolicy_gateway.run.watch import RunView, first_line
from evopolicy_gateway.suite.suite_view import SuiteView

STEERING = (
    "\x1b[2J\x1b[1;1Hscore 100",  # clears the screen
    "\x1b]0;title\x07\x1b]52;c;cm0gLXJmIH4=\x1b\\",  # window title, clipboard
    "one\rtwo\b\b\b\x7f\x9b31m",
    "abc\u202edef\u2028\u200b",  # writes backwards, breaks lines
)


@pytest.mark.parametrize("text", STEERING)
def test_an_agents_words_do_not_steer_the_terminal(text: str) -> None:
    out = io.StringIO()
    console = Terminal(file=out, width=200)
    lines = RunView(console)
    lines.turn("run", 1, text)
    lines.note("run", f"agent failed: {text}")
    lines.doing("run", AgentDoing(action=text, paused_s=1.0))
    console.print(lines.render())
    sweep = SuiteView(["run"], 1, console)
    sweep.turn("run", 1, text)
    sweep.note("run", text)
    output = out.getvalue()
    assert "run" in output
    assert all(letter.isprintable() or letter == "\n" for letter in output)


def test_printable_text_is_shown_as_it_is() -> None:
    text = "Größe ×2, 日本 ✓\nline two"
    assert harmless(text) == text
    assert first_line(text) == "Größe ×2, 日本 ✓"


def test_a_runs_wait_is_told_once() -> None:
    out = io.StringIO()
    console = Terminal(file=out, width=200)
    missing = "a worker that offers toy/line with sandbox tier bwrap"
    for view in (RunView(console), SuiteView(["run"], 1, console)):
        for what in (missing, missing, "", "an agent to end", missing):
            view.phase("run", RunProgress(phase="heldout", done=0, total=4, waits_for=what))
    assert out.getvalue().count(f"waiting for {missing}") == 2
    sweep = SuiteView(["run"], 1, console)
    sweep.rows["run"].state = "running"
    progress = TrainProgress(
        episode_budget=8, remaining_budget=4, n_submits=1, submit_id="submit_000", n_episodes=4
    )
    sweep.progress("run", msgspec.structs.replace(progress, waits_for=FREE_SLOT))
    assert FREE_SLOT not in out.getvalue()
    console.print(sweep.render())
    assert f"waiting for {FREE_SLOT}" in out.getvalue()


@pytest.mark.parametrize("width", [20, 40, 80, 160])
def test_names_of_runs_are_never_cut_in_the_live_table(width: int) -> None:
    names = ["evolve/toy/line/0", "a-long-entry/gymnasium_MiniGrid-FourRooms-v0/12"]
    console = Terminal(file=io.StringIO(), width=width)
    view = SuiteView(names, 2, console)
    with console.capture() as shown:
        console.print(view.render())
    lines = shown.get().splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in shown.get()
    column = "".join(line[: max(16, width - 16)].split("  ")[0].strip() for line in lines)
    for name in names:
        assert name in column
