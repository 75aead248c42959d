"""The operator's view of running runs: a live table on a terminal, plain lines elsewhere.

A view stores the reports of each run and derives events from them. On a terminal the table shows the stored state, and
a few kinds of events scroll by above it; elsewhere every event with a text is printed as a line.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Self

from rich.console import RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from evopolicy_common.console import NarrowTable, Terminal
from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.records.suite_folder import Entry
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import harmless
from evopolicy_gateway.processes.child_messages import AgentDoing, Progress

PHASES = {
    "open": "train",
    "validation": "validating",
    "heldout": "held-out",
    "random": "random reference",
    "finished": "finished",
}


class Row:
    """The known state of one run."""

    def __init__(self) -> None:
        self.progress: Progress | None = None
        self.phase: RunProgress | None = None
        self.action = ""
        self.held = ""
        """The reason why it waits to start or to close; also in `waits_for`."""
        self.waits_for = ""
        self.state = "waiting"
        """In a sweep: a state of its index, or `on HOST`; so are the next two."""
        self.tokens: dict[str, Any] | None = None
        self.entry: Entry | None = None


class View(ABC):
    """Receives the reports of runs, by their short names, and shows a row for each."""

    no_news: tuple[str, ...] = ("",)
    """Reasons for waiting that produce no event."""
    above: tuple[str, ...]
    """Kinds of events that are printed above the table."""

    def __init__(self, console: Terminal | None) -> None:
        """`console` None: prints nothing."""
        self.rows: dict[str, Row] = {}
        self._console = console
        self._drawn = console is not None and console.is_terminal
        self._last: dict[str, object] = {}

    @contextlib.contextmanager
    def shown(self) -> Iterator[Self]:
        """Shows the table inside the `with` if the console is a terminal."""
        shown: contextlib.AbstractContextManager[object] = contextlib.nullcontext()
        if self._drawn:
            render = self.render
            shown = Live(console=self._console, get_renderable=render, refresh_per_second=4, transient=True)
        with shown:
            yield self

    @abstractmethod
    def render(self) -> RenderableType:
        """Returns the current table."""

    def words(self, kind: str, run: str, details: dict[str, Any]) -> str:
        """The event's text for people; empty if it is not worth a line."""
        if kind == "phase":
            return PHASES[details["phase"]]
        if kind == "turn":
            return f"turn {details['turn']}: {details['text']}"
        if kind in ("waits", "held"):
            return f"waiting for {details['what']}"
        return str(details.get("text", ""))

    def event(self, kind: str, run: str, **more: Any) -> None:
        """Reports an event."""
        if self._console is None or (self._drawn and kind not in self.above):
            return
        if text := self.words(kind, run, more):
            self._print(f"{run}: {text}" if run else text)

    # Reports of a run.

    def note(self, run: str, text: str) -> None:
        """Something worth a line."""
        self.row(run)
        self.event("note", run, text=text)

    def progress(self, run: str, progress: Progress) -> None:
        """The train side has progressed."""
        self.row(run).progress = progress
        last = progress.last_submit_id
        if last is not None and self.is_new(run, "submit", last):
            means = {"mean": progress.last_mean, "best": progress.best_mean}
            known = {"submit": last, "status": progress.last_status, **means}
            self.event("submit", run, **known, budget_left=progress.remaining_budget)
        self.waits_for(run, progress.waits_for)

    def held(self, run: str, what: str) -> None:
        """The run may not start, or may not be closed, before `what`; empty: it may now."""
        self.row(run).held = what
        self.waits_for(run, what, "held")

    def turn(self, run: str, turn: int, text: str) -> None:
        """The agent has sent a message."""
        self.row(run).action = first_line(text)
        self.event("turn", run, turn=turn, text=first_line(text))

    def doing(self, run: str, doing: AgentDoing) -> None:
        """The agent's activity changed, or it used more tokens."""
        row = self.row(run)
        row.action = first_line(doing.action) or row.action
        if doing.note:
            self.note(run, doing.note)
        if doing.paused_s:
            seconds, why = round(doing.paused_s), first_line(doing.action)
            self.event("paused", run, provider=doing.provider, seconds=seconds, why=why)

    def phase(self, run: str, progress: RunProgress) -> None:
        """The finalisation has progressed."""
        self.row(run).phase = progress
        if self.is_new(run, "phase", progress.phase):
            self.event("phase", run, phase=progress.phase)
        self.waits_for(run, progress.waits_for)

    def waits_for(self, run: str, what: str, kind: str = "waits") -> None:
        """Stores the reason for the run's wait; reports it once."""
        self.row(run).waits_for = what
        if what not in self.no_news and self.is_new(run, "waits", what):
            self.event(kind, run, what=what)

    def row(self, run: str) -> Row:
        return self.rows.setdefault(run, Row())

    def is_new(self, run: str, kind: str, value: object) -> bool:
        """Whether the last value of that kind for the run differs from `value`."""
        key = f"{run} {kind}"
        if self._last.get(key) == value:
            return False
        self._last[key] = value
        return True

    def _print(self, text: str) -> None:
        if self._console is not None:
            self._console.print(text, soft_wrap=True)


class RunView(View):
    """The view of `evopolicy run` and `evopolicy local`."""

    above = ("note", "held", "submit")

    def words(self, kind: str, run: str, details: dict[str, Any]) -> str:
        if kind == "submit":
            progress = self.rows[run].progress
            assert progress is not None
            mean = "" if details["mean"] is None else f", mean return {details['mean']:.4g}"
            left = f"{details['budget_left']} of {progress.episode_budget} episodes left"
            return f"{details['submit']} {in_words(details['status'])}{mean}; {left}"
        if kind == "paused":
            return f"{details['why']} (for {details['seconds']} s)"
        return "" if details.get("phase") == "finished" else super().words(kind, run, details)

    def render(self) -> Table:
        table = NarrowTable()
        for title in ("run", "budget used", "submits", "best mean", "now"):
            table.add_column(title, no_wrap=title != "now", overflow="ellipsis")
        for name, row in self.rows.items():
            table.add_row(name, *map(Text, _cells(row)))
        table.show_header = bool(self.rows)
        return table


def _cells(row: Row) -> tuple[str, ...]:
    progress = row.progress
    if progress is None:
        return ("", "", "", f"waiting for {row.held}" if row.held else "starting")
    used = progress.episode_budget - progress.remaining_budget
    return (
        f"{_bar(used, progress.episode_budget)} {used}/{progress.episode_budget}",
        str(progress.n_submits),
        "" if progress.best_mean is None else f"{progress.best_mean:.4g}",
        _now(row, progress),
    )


def _now(row: Row, progress: Progress) -> str:
    if row.held:
        return f"waiting for {row.held}"
    if row.phase is not None:
        done = f" {row.phase.done}/{row.phase.total}" if row.phase.total else ""
        waits = f", waiting for {row.phase.waits_for}" if row.phase.waits_for else ""
        return PHASES[row.phase.phase] + done + waits
    if progress.submit_id is not None:
        waits = f", waiting for {progress.waits_for}" if progress.waits_for else ""
        return f"{progress.submit_id}: {progress.n_done}/{progress.n_episodes} episodes{waits}"
    return f"agent at work{f': {row.action}' if row.action else ''}"


def _bar(part: int, whole: int, width: int = 12) -> str:
    filled = round(width * part / whole) if whole else 0
    return "━" * filled + "╌" * (width - filled)


def first_line(text: str) -> str:
    """The start of a text's first line, at most 120 characters, with unprintable characters replaced."""
    return harmless((text.strip().splitlines() or [""])[0][:120])
