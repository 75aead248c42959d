"""What an operator sees of a sweep: a live table on a terminal, a line for each thing that happens elsewhere, or JSON events.

All three are told the same things; a view keeps them by run.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from evopolicy_common.messages.gateway import FREE_SLOT
from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.terminal import Terminal, say_json
from evopolicy_gateway.operator.control import AgentDoing, Progress
from evopolicy_gateway.operator.watch import PHASES, first_line
from evopolicy_gateway.suite.suite_index import FINISHED, Entry

_SHOWN_ROWS = 24
_WIDTHS = {"budget": 7, "submits": 7, "best mean": 9, "tokens": 6, "state": 30}
_LEAST_NAME, _LEAST_ACTION, _GAP = 20, 11, 2
_STYLES = ("bold", "red", "dim", "dim", "")
"""Of rows by `_order`: running, failed, with another host, waiting, ended."""


class Row:
    """What is known of one run."""

    def __init__(self) -> None:
        self.state = "waiting"
        self.attempt = 1
        self.progress: Progress | None = None
        self.phase: RunProgress | None = None
        self.action = ""
        self.waits_for = ""
        self.tokens: dict[str, Any] | None = None
        self.entry: Entry | None = None


def _ignore(_: str, __: AgentDoing) -> None:
    pass


class SuiteView:
    """Keeps the rows and tells nobody; the others say what they are told."""

    def __init__(self, names: list[str], parallel: int) -> None:
        self.rows = {name: Row() for name in names}
        self.on_doing: Callable[[str, AgentDoing], None] = _ignore
        self._parallel = parallel
        self._said: dict[str, object] = {}

    # What the sweep tells.

    def kept(self, name: str, entry: Entry | None) -> None:
        """It is finished already."""
        self.rows[name].state = "completed" if entry is None else entry.state
        self.rows[name].entry = entry
        self.rows[name].tokens = None if entry is None else entry.tokens

    def started(self, name: str, attempt: int) -> None:
        self.rows[name].state, self.rows[name].attempt = "running", attempt
        self.event("started", name, attempt=attempt)

    def finished(self, name: str, entry: Entry) -> None:
        row = self.rows[name]
        row.state, row.entry, row.action = entry.state, entry, ""
        row.tokens = entry.tokens or row.tokens
        self.event(
            "finished", name, state=entry.state, score=entry.score, random=entry.random, error=entry.error
        )

    def elsewhere(self, name: str, host: str) -> None:
        """Another host plays it."""
        self.rows[name].state = f"on {host}"
        if self._said.get(f"{name} host") != host:
            self._said[f"{name} host"] = host
            self.event("elsewhere", name, host=host)

    def waits(self, name: str) -> None:
        """It was ended here, and may go on."""
        self.rows[name].state, self.rows[name].action = "waiting", ""

    def say(self, text: str) -> None:
        """Something about the sweep as a whole."""
        self.event("note", "", text=text)

    # What a run tells: `watch.Watch`.

    def note(self, run: str, text: str) -> None:
        self.event("note", run, text=text)

    def progress(self, run: str, progress: Progress) -> None:
        row = self.rows[run]
        row.progress = progress
        self._waits_for(run, progress.waits_for)
        if progress.last_submit_id is not None and self._said.get(f"{run} submit") != progress.last_submit_id:
            self._said[f"{run} submit"] = progress.last_submit_id
            self.event(
                "submit",
                run,
                submit=progress.last_submit_id,
                status=progress.last_status,
                mean=progress.last_mean,
                best=progress.best_mean,
                budget_left=progress.remaining_budget,
            )

    def held(self, run: str, what: str) -> None:
        self._waits_for(run, what)

    def turn(self, run: str, turn: int, text: str) -> None:
        self.rows[run].action = first_line(text)
        self.event("turn", run, turn=turn, text=first_line(text))

    def doing(self, run: str, doing: AgentDoing) -> None:
        row = self.rows[run]
        row.action = first_line(doing.action) or row.action
        row.tokens = doing.tokens or row.tokens
        self.on_doing(run, doing)
        if doing.note:
            self.note(run, doing.note)
        if doing.paused_s:
            self.event(
                "paused",
                run,
                provider=doing.provider,
                seconds=round(doing.paused_s),
                why=first_line(doing.action),
            )

    def phase(self, run: str, progress: RunProgress) -> None:
        self.rows[run].phase = progress
        if self._said.get(f"{run} phase") != progress.phase:
            self._said[f"{run} phase"] = progress.phase
            self.event("phase", run, phase=progress.phase)
        self._waits_for(run, progress.waits_for)

    def _waits_for(self, run: str, what: str) -> None:
        self.rows[run].waits_for = what
        if what not in ("", FREE_SLOT) and self._said.get(f"{run} waits") != what:
            self._said[f"{run} waits"] = what
            self.event("waits", run, what=what)

    def event(self, kind: str, run: str, **more: Any) -> None:
        """Says that something happened."""

    def totals(self) -> str:
        """How far the sweep is, in one line."""
        rows = self.rows.values()
        done = [row for row in rows if row.state in FINISHED]
        running = [row for row in rows if row.state == "running"]
        failed = [row for row in rows if row.state == "error"]
        parts = [f"{len(done)} of {len(self.rows)} runs done", f"{len(running)} running"]
        if failed:
            parts.append(f"{len(failed)} failed")
        if cancelled := sum(row.state == "cancelled" for row in rows):
            parts.append(f"{cancelled} cancelled")
        if tokens := sum(_tokens(row.tokens) for row in rows):
            parts.append(f"{_short(tokens)} tokens")
        cost = sum(float((row.tokens or {}).get("cost") or 0.0) for row in rows)
        if cost:
            parts.append(f"${cost:.2f}")
        eta = self._eta()
        return ", ".join(parts) + ("" if eta is None else f", about {_duration(eta)} left")

    def _eta(self) -> float | None:
        """Seconds that are left, from what finished runs took; None before there is one."""
        rows = self.rows.values()
        walls = [
            row.entry.wall_s
            for row in rows
            if row.entry is not None and row.entry.state in FINISHED and row.entry.wall_s
        ]
        left = sum(row.state not in FINISHED and row.state not in ("error", "cancelled") for row in rows)
        if not walls or not left:
            return None
        return sum(walls) / len(walls) * left / min(self._parallel, left)


class JsonView(SuiteView):
    """One JSON object a line on stdout."""

    def event(self, kind: str, run: str, **more: Any) -> None:
        document = {"event": kind, "at": round(time.time(), 3), **({"run": run} if run else {}), **more}
        say_json(document, indent=False)


class LinesView(SuiteView):
    """A line for each event; the totals with every finished run."""

    def __init__(self, names: list[str], parallel: int, console: Terminal) -> None:
        super().__init__(names, parallel)
        self._console = console

    def event(self, kind: str, run: str, **more: Any) -> None:
        text = words(kind, more)
        if text:
            self._print(f"{run}: {text}" if run else text)
        if kind == "finished":
            self._print(self.totals())

    def _print(self, text: str) -> None:
        self._console.print(text, soft_wrap=True)


class TableView(LinesView):
    """A table with a row for each run that goes on and the last that ended; notes scroll by above it."""

    @contextlib.contextmanager
    def shown(self) -> Iterator[TableView]:
        with Live(console=self._console, get_renderable=self.render, refresh_per_second=4, transient=True):
            yield self

    def event(self, kind: str, run: str, **more: Any) -> None:
        if kind in ("finished", "note", "paused", "waits", "elsewhere"):
            self._print(f"{run}: {words(kind, more)}" if run else words(kind, more))

    def render(self) -> Group:
        """The table as it is now."""
        table = Table(box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
        # Of those that ended, the last come first.
        newest = sorted(self.rows, key=lambda name: _ended(self.rows[name]), reverse=True)
        names = sorted(newest, key=lambda name: _order(self.rows[name]))
        # Names and actions share what the other columns leave.
        room = self._console.width - sum(_WIDTHS.values()) - _GAP * (len(_WIDTHS) + 1)
        longest = max((len(name) for name in names[:_SHOWN_ROWS]), default=0)
        for_names = max(_LEAST_NAME, min(longest, room - _LEAST_ACTION))
        columns = {"run": for_names, **_WIDTHS, "last action": max(_LEAST_ACTION, room - for_names)}
        for title, width in columns.items():
            table.add_column(title, no_wrap=True, overflow="ellipsis", justify="left", width=width)
        for name in names[:_SHOWN_ROWS]:
            style = _STYLES[_order(self.rows[name])]
            table.add_row(*(Text(cell, style) for cell in (name, *_cells(self.rows[name]))))
        hidden = len(names) - _SHOWN_ROWS
        more = [Text(f"… and {hidden} more")] if hidden > 0 else []
        return Group(table, *more, Text(self.totals()))


def words(kind: str, told: dict[str, Any]) -> str:
    """An event as people read it."""
    if kind == "started":
        return "begins" + (f", attempt {told['attempt']}" if told["attempt"] > 1 else "")
    if kind == "finished":
        if told["state"] == "completed":
            return f"completed, score {_number(told['score'])} (random {_number(told['random'])})"
        if told["state"] == "cancelled":
            return str(told["error"] or "cancelled")
        why = f": {told['error']}" if told["error"] else ""
        return str(told["state"]).replace("_", " ") + why
    if kind == "submit":
        mean = "" if told["mean"] is None else f", mean return {_number(told['mean'])}"
        return f"{told['submit']} {told['status']}{mean}; {told['budget_left']} episodes left"
    if kind == "phase":
        return "" if told["phase"] in ("open", "finished") else PHASES[told["phase"]]
    if kind == "turn":
        return f"turn {told['turn']}: {told['text']}"
    if kind == "paused":
        return f"{told['provider']} is away, waits {told['seconds']} s ({told['why']})"
    if kind == "waits":
        return f"waiting for {told['what']}"
    if kind == "elsewhere":
        return f"is played on {told['host']}"
    return str(told.get("text", ""))


@contextlib.contextmanager
def viewing(names: list[str], parallel: int, console: Terminal, *, as_json: bool) -> Iterator[SuiteView]:
    """The view that fits where the output goes."""
    if as_json:
        yield JsonView(names, parallel)
    elif console.is_terminal:
        with TableView(names, parallel, console).shown() as view:
            yield view
    else:
        yield LinesView(names, parallel, console)


def results_table(entries: list[Entry]) -> Table:
    """What the runs came to."""
    table = Table(box=None, pad_edge=False)
    for title in ("run", "state", "score", "random", "budget used", "tokens"):
        table.add_column(title, justify="right" if title in ("score", "random", "tokens") else "left")
    for entry in entries:
        tokens = _tokens(entry.tokens)
        table.add_row(
            Text(entry.name),
            entry.state.replace("_", " ")
            + (f" on {entry.host}" if entry.host and not entry.directory else ""),
            _number(entry.score),
            _number(entry.random),
            str(entry.budget_used),
            _short(tokens) if tokens else "",
        )
    return table


def _order(row: Row) -> int:
    kinds = {"running": 0, "error": 1, "cancelled": 1, "waiting": 3}
    return kinds.get(row.state, 2 if row.state.startswith("on ") else 4)


def _ended(row: Row) -> str:
    return "" if row.entry is None else row.entry.finished_at


def _cells(row: Row) -> tuple[str, ...]:
    progress, tokens = row.progress, _tokens(row.tokens)
    state = row.state.replace("_", " ")
    if row.state == "running" and row.phase is not None:
        state = f"{PHASES[row.phase.phase]} {row.phase.done}/{row.phase.total}"
    elif row.state == "running" and progress is not None and progress.submit_id is not None:
        state = f"{progress.submit_id}: {progress.n_done}/{progress.n_episodes}"
    if row.entry is not None and row.entry.score is not None:
        state = f"score {_number(row.entry.score)} (random {_number(row.entry.random)})"
    used = submits = ""
    if progress is not None:
        used = f"{progress.episode_budget - progress.remaining_budget}/{progress.episode_budget}"
        submits = str(progress.n_submits)
    elif row.entry is not None:
        used, submits = str(row.entry.budget_used), str(row.entry.n_submits)
    return (
        used,
        submits,
        "" if progress is None else _number(progress.best_mean),
        _short(tokens) if tokens else "",
        state,
        f"waiting for {row.waits_for}" if row.state == "running" and row.waits_for else row.action,
    )


def _tokens(told: dict[str, Any] | None) -> int:
    kinds = ("input_noncached", "cache_read", "cache_creation", "output")
    return 0 if told is None else sum(int(told.get(kind) or 0) for kind in kinds)


def _short(number: int) -> str:
    return (
        f"{number / 1e6:.2f}M"
        if number >= 1_000_000
        else f"{number / 1e3:.1f}k"
        if number >= 1000
        else str(number)
    )


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{max(1, minutes)} min"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
