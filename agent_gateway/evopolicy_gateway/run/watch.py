"""The operator's view of running runs: a live table on a terminal, plain lines elsewhere.

A view stores the reports of each run and derives events from them. On a terminal the table shows the stored state, and
a few kinds of events scroll by above it; elsewhere every event with a text is printed as a line.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Self

import msgspec
from rich.console import RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from evopolicy_common.console import NarrowTable, Terminal
from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.records.suite_folder import SweepRun
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import harmless
from evopolicy_gateway.processes.child_messages import AgentDoing, TrainProgress

PHASES = {
    "open": "train",
    "validation": "validating",
    "heldout": "held-out",
    "random": "random reference",
    "finished": "finished",
}


_BAR_WIDTH = 12


class RunLine(msgspec.Struct):
    """The known state of one run."""

    progress: TrainProgress | None = None
    phase: RunProgress | None = None
    action: str = ""
    held: str = ""
    """The reason why it waits to start or to close; also in `waits_for`."""
    waits_for: str = ""
    state: str = "waiting"
    """In a sweep: a state of its index, or `on HOST`; so are the next two."""
    tokens: dict[str, Any] | None = None
    entry: SweepRun | None = None


class RunsView(ABC):
    """Receives the reports of runs, by their short names, and shows a row for each."""

    no_news: tuple[str, ...] = ("",)
    """Reasons for waiting that produce no event."""
    above: tuple[str, ...]
    """Kinds of events that are printed above the table."""

    def __init__(self, console: Terminal | None) -> None:
        """`console` None: prints nothing."""
        self.rows: dict[str, RunLine] = {}
        self._console = console
        self._drawn = console is not None and console.is_terminal
        self._last: dict[tuple[str, str], object] = {}

    @contextlib.contextmanager
    def shown(self) -> Iterator[Self]:
        """Shows the table inside the `with` if the console is a terminal."""
        with contextlib.ExitStack() as stack:
            if self._drawn:
                stack.enter_context(Live(console=self._console, get_renderable=self.render, transient=True))
            yield self

    @abstractmethod
    def render(self) -> RenderableType:
        """Returns the current table."""

    def event_text(self, kind: str, run: str, details: dict[str, Any]) -> str:
        """The event's text for people; empty if it is not worth a line."""
        if kind == "phase":
            return PHASES[details["phase"]]
        if kind == "turn":
            return f"turn {details['turn']}: {details['text']}"
        if kind in ("waits", "held"):
            return f"waiting for {details['what']}"
        return str(details.get("text", ""))

    def event(self, kind: str, run: str, **more: object) -> None:
        if self._console is None or (self._drawn and kind not in self.above):
            return
        if text := self.event_text(kind, run, more):
            self._print(f"{run}: {text}" if run else text)

    # Reports of a run.

    def note(self, run: str, text: str) -> None:
        self.row(run)
        self.event("note", run, text=text)

    def progress(self, run: str, progress: TrainProgress) -> None:
        self.row(run).progress = progress
        last = progress.last_submit_id
        if last is not None and self.is_new(run, "submit", last):
            known = {"submit": last, "status": progress.last_status, "mean": progress.last_mean}
            known |= {"best": progress.best_mean, "budget_left": progress.remaining_budget}
            self.event("submit", run, **known)
        self.waits_for(run, progress.waits_for)

    def run_held(self, run: str, what: str) -> None:
        """The run may not start, or may not be closed, before `what`; empty: it may now."""
        self.row(run).held = what
        self.waits_for(run, what, "held")

    def turn(self, run: str, turn: int, text: str) -> None:
        self.row(run).action = first_line(text)
        self.event("turn", run, turn=turn, text=first_line(text))

    def doing(self, run: str, doing: AgentDoing) -> None:
        """The agent's activity changed, or it used more tokens."""
        row, action = self.row(run), first_line(doing.action)
        row.action = action or row.action
        if doing.note:
            self.note(run, doing.note)
        if doing.paused_s:
            seconds = round(doing.paused_s)
            self.event("paused", run, provider=doing.provider, seconds=seconds, why=action)

    def phase(self, run: str, progress: RunProgress) -> None:
        self.row(run).phase = progress
        if self.is_new(run, "phase", progress.phase):
            self.event("phase", run, phase=progress.phase)
        self.waits_for(run, progress.waits_for)

    def waits_for(self, run: str, what: str, kind: str = "waits") -> None:
        """Stores the reason for the run's wait; reports each reason once."""
        self.row(run).waits_for = what
        if what not in self.no_news and self.is_new(run, f"waits for {what}", True):
            self.event(kind, run, what=what)

    def row(self, run: str) -> RunLine:
        return self.rows.setdefault(run, RunLine())

    def is_new(self, run: str, kind: str, value: object) -> bool:
        """Whether the last value of that kind for the run differs from `value`."""
        before, self._last[run, kind] = self._last.get((run, kind)), value
        return before != value

    def _print(self, text: str) -> None:
        if self._console is not None:
            self._console.print(text, soft_wrap=True)


class RunView(RunsView):
    """The view of `evopolicy run` and `evopolicy local`."""

    above = ("note", "held", "submit")

    def event_text(self, kind: str, run: str, details: dict[str, Any]) -> str:
        if kind == "submit":
            progress = self.rows[run].progress
            assert progress is not None
            mean = "" if details["mean"] is None else f", mean return {details['mean']:.4g}"
            left = f"{details['budget_left']} of {progress.episode_budget} episodes left"
            return f"{details['submit']} {in_words(details['status'])}{mean}; {left}"
        if kind == "paused":
            return f"{details['why']} (for {details['seconds']} s)"
        return "" if details.get("phase") == "finished" else super().event_text(kind, run, details)

    def render(self) -> Table:
        table = NarrowTable()
        for title in ("run", "budget used", "submits", "best mean", "now"):
            table.add_column(title, no_wrap=title != "now", overflow="ellipsis")
        for name, row in self.rows.items():
            table.add_row(name, *map(Text, _cells(row)))
        table.show_header = bool(self.rows)
        return table


def _cells(row: RunLine) -> tuple[str, ...]:
    progress = row.progress
    if progress is None:
        return ("", "", "", f"waiting for {row.held}" if row.held else "starting")
    budget = progress.episode_budget
    used = budget - progress.remaining_budget
    filled = round(_BAR_WIDTH * used / budget) if budget else 0
    return (
        f"{'━' * filled}{'╌' * (_BAR_WIDTH - filled)} {used}/{budget}",
        str(progress.n_submits),
        "" if progress.best_mean is None else f"{progress.best_mean:.4g}",
        _now(row, progress),
    )


def _now(row: RunLine, progress: TrainProgress) -> str:
    if row.held:
        return f"waiting for {row.held}"
    if row.phase is not None:
        doing, waits_for = PHASES[row.phase.phase], row.phase.waits_for
        if row.phase.total:
            doing += f" {row.phase.done}/{row.phase.total}"
    elif progress.submit_id is not None:
        doing = f"{progress.submit_id}: {progress.n_done}/{progress.n_episodes} episodes"
        waits_for = progress.waits_for
    else:
        return f"agent at work{f': {row.action}' if row.action else ''}"
    return doing + (f", waiting for {waits_for}" if waits_for else "")


def first_line(text: str) -> str:
    """The start of a text's first line, at most 120 characters, with unprintable characters replaced."""
    return harmless((text.strip().splitlines() or [""])[0][:120])
