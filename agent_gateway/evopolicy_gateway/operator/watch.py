"""What an operator sees of runs while they go on: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol

from rich.live import Live
from rich.table import Table
from rich.text import Text

from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.terminal import Terminal, harmless
from evopolicy_gateway.operator.control import AgentDoing, Progress

PHASES = {
    "open": "train",
    "validation": "validating",
    "heldout": "held-out",
    "random": "random reference",
    "finished": "finished",
}


class Watch(Protocol):
    """Is told what happens to runs; `run` is a run's short name."""

    def held(self, run: str, what: str) -> None:
        """It may not begin, or not be closed, before `what`; empty: it may now."""

    def note(self, run: str, text: str) -> None:
        """Something worth a line."""

    def progress(self, run: str, progress: Progress) -> None:
        """The agent's side has moved."""

    def turn(self, run: str, turn: int, text: str) -> None:
        """The agent has said something."""

    def doing(self, run: str, doing: AgentDoing) -> None:
        """The agent is at something else, or has used more tokens."""

    def phase(self, run: str, progress: RunProgress) -> None:
        """Finalisation has moved."""


class Lines:
    """A line for each submit and phase: for logs and pipes."""

    def __init__(self, console: Terminal) -> None:
        self._console = console
        self._seen: dict[str, tuple[object, ...]] = {}

    def note(self, run: str, text: str) -> None:
        self._console.print(f"{run}: {text}", soft_wrap=True)

    def progress(self, run: str, progress: Progress) -> None:
        if progress.last_submit_id is not None and self._changed(f"{run} submit", progress.last_submit_id):
            mean = "" if progress.last_mean is None else f", mean return {progress.last_mean:.4g}"
            self.note(
                run,
                f"{progress.last_submit_id} {progress.last_status}{mean};"
                f" {progress.remaining_budget} of {progress.episode_budget} episodes left",
            )
        self._waits_for(run, progress.waits_for)

    def held(self, run: str, what: str) -> None:
        self._waits_for(run, what)

    def turn(self, run: str, turn: int, text: str) -> None:
        self.note(run, f"turn {turn}: {first_line(text)}")

    def doing(self, run: str, doing: AgentDoing) -> None:
        if doing.note:
            self.note(run, doing.note)
        if doing.paused_s:
            self.note(run, f"{first_line(doing.action)} (for {doing.paused_s:.0f} s)")

    def phase(self, run: str, progress: RunProgress) -> None:
        if self._changed(f"{run} phase", progress.phase) and progress.phase != "finished":
            self.note(run, PHASES[progress.phase])
        self._waits_for(run, progress.waits_for)

    def _waits_for(self, run: str, what: str) -> None:
        if what and self._changed(f"{run} waits", what):
            self.note(run, f"waiting for {what}")

    def _changed(self, key: str, *value: object) -> bool:
        if self._seen.get(key) == value:
            return False
        self._seen[key] = value
        return True


class LiveTable:
    """A table with a row a run, drawn anew as things happen; notes scroll by above it."""

    def __init__(self, console: Terminal) -> None:
        self._console = console
        self._rows: dict[str, _Row] = {}
        self._live = Live(console=console, get_renderable=self._table, refresh_per_second=4, transient=True)

    @contextlib.contextmanager
    def shown(self) -> Iterator[LiveTable]:
        with self._live:
            yield self

    def note(self, run: str, text: str) -> None:
        self._row(run)
        self._console.print(f"{run}: {text}")

    def progress(self, run: str, progress: Progress) -> None:
        row = self._row(run)
        if progress.last_submit_id not in (None, row.last_submit):
            row.last_submit = progress.last_submit_id
            row.last = f"{progress.last_status}" + (
                "" if progress.last_mean is None else f" {progress.last_mean:.4g}"
            )
        row.progress = progress

    def held(self, run: str, what: str) -> None:
        self._row(run).held = what
        if what:
            self.note(run, f"waiting for {what}")

    def turn(self, run: str, turn: int, text: str) -> None:
        self._row(run).said = first_line(text)

    def doing(self, run: str, doing: AgentDoing) -> None:
        if doing.note:
            self.note(run, doing.note)
        if doing.action:
            self._row(run).said = first_line(doing.action)

    def phase(self, run: str, progress: RunProgress) -> None:
        self._row(run).phase = progress

    def _row(self, run: str) -> _Row:
        return self._rows.setdefault(run, _Row())

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False)
        for title in ("run", "budget used", "submits", "last", "best visible mean", "now"):
            table.add_column(title, no_wrap=title != "now", overflow="ellipsis")
        for name, row in self._rows.items():
            table.add_row(name, *row.cells())
        return table


class _Row:
    """What the table tells of one run."""

    def __init__(self) -> None:
        self.progress: Progress | None = None
        self.phase: RunProgress | None = None
        self.last_submit: str | None = None
        self.last = ""
        self.said = ""
        self.held = ""

    def cells(self) -> tuple[Text, ...]:
        progress = self.progress
        if progress is None:
            return (Text(""),) * 4 + (Text(f"waiting for {self.held}" if self.held else "starting"),)
        used = progress.episode_budget - progress.remaining_budget
        best = "" if progress.best_mean is None else f"{progress.best_mean:.4g}"
        return (
            Text(f"{_bar(used, progress.episode_budget)} {used}/{progress.episode_budget}"),
            Text(str(progress.n_submits)),
            Text(self.last),
            Text(best),
            Text(self._now(progress)),
        )

    def _now(self, progress: Progress) -> str:
        if self.held:
            return f"waiting for {self.held}"
        if self.phase is not None:
            done = f" {self.phase.done}/{self.phase.total}" if self.phase.total else ""
            waits = f", waiting for {self.phase.waits_for}" if self.phase.waits_for else ""
            return PHASES[self.phase.phase] + done + waits
        if progress.submit_id is not None:
            waits = f", waiting for {progress.waits_for}" if progress.waits_for else ""
            return f"{progress.submit_id}: {progress.n_done}/{progress.n_episodes} episodes{waits}"
        return f"agent at work{f': {self.said}' if self.said else ''}"


@contextlib.contextmanager
def watching(console: Terminal) -> Iterator[Watch]:
    """A live table on a terminal, lines elsewhere."""
    if console.is_terminal:
        with LiveTable(console).shown() as table:
            yield table
    else:
        yield Lines(console)


def _bar(part: int, whole: int, width: int = 12) -> str:
    filled = round(width * part / whole) if whole else 0
    return "━" * filled + "╌" * (width - filled)


def first_line(text: str) -> str:
    """The start of a text's first line, harmless."""
    return harmless((text.strip().splitlines() or [""])[0][:120])
