"""The operator's view of a sweep: a live table on a terminal, one line per event elsewhere, or JSON events.

All three receive the same reports and store them by run.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from evopolicy_common.console import Terminal, table
from evopolicy_common.messages.gateway import FREE_SLOT
from evopolicy_common.records.suite_folder import FINISHED, SweepRun
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import duration, number, say_json, short
from evopolicy_gateway.processes.child_messages import AgentDoing
from evopolicy_gateway.relay.usage import tokens_in
from evopolicy_gateway.run.watch import PHASES, RunLine, RunsView

_SHOWN_ROWS = 24
_WIDTHS = {"budget": 7, "submits": 7, "best mean": 9, "tokens": 6, "state": 30, "last action": 11}
_TITLES = ("run", *_WIDTHS)
_ORDER = ("state", "budget", "best mean", "last action", "submits", "tokens")
"""Columns beside the name, the most important first."""
_LEAST_NAME, _LEAST_STATE, _GAP = 16, 14, 2
_ENDED_OTHERWISE = {"error": "failed", "cancelled": "cancelled"}
_STYLES = ("bold", "red", "dim", "dim", "")
"""Styles of rows by `_order`: running, failed, on another host, waiting, ended."""


class SuiteView(RunsView):
    """The view of a sweep's runs: a table with the running ones and the last ended ones."""

    no_news = ("", FREE_SLOT)
    above = ("finished", "note", "paused", "waits", "elsewhere")

    def __init__(self, names: list[str], parallel: int, console: Terminal | None = None) -> None:
        super().__init__(console)
        self.rows = {name: RunLine() for name in names}
        self.on_doing: Callable[[str, AgentDoing], object] = lambda run, doing: None
        self._parallel = parallel

    # Reports of the sweep.

    def kept(self, name: str, entry: SweepRun | None) -> None:
        """The run is finished already."""
        row = self.rows[name]
        row.state, row.entry = "completed" if entry is None else entry.state, entry
        row.tokens = None if entry is None else entry.tokens

    def started(self, name: str, attempt: int) -> None:
        self.rows[name].state = "running"
        self.event("started", name, attempt=attempt)

    def finished(self, name: str, entry: SweepRun) -> None:
        row = self.rows[name]
        row.state, row.entry, row.action = entry.state, entry, ""
        row.tokens = entry.tokens or row.tokens
        self.event(
            "finished", name, state=entry.state, score=entry.score, random=entry.random, error=entry.error
        )

    def elsewhere(self, name: str, host: str) -> None:
        self.rows[name].state = f"on {host}"
        if self.is_new(name, "host", host):
            self.event("elsewhere", name, host=host)

    def waits(self, name: str) -> None:
        """The run was ended here and may resume."""
        self.rows[name].state, self.rows[name].action = "waiting", ""

    def say(self, text: str) -> None:
        """Reports a text about the sweep as a whole."""
        self.event("note", "", text=text)

    # Reports of a run.

    def run_held(self, run: str, what: str) -> None:
        self.waits_for(run, what)

    def doing(self, run: str, doing: AgentDoing) -> None:
        row = self.rows[run]
        row.tokens = doing.tokens or row.tokens
        self.on_doing(run, doing)
        super().doing(run, doing)

    def event(self, kind: str, run: str, **more: object) -> None:
        super().event(kind, run, **more)
        if kind == "finished" and not self._drawn:
            self._print(self.totals())

    def totals(self) -> str:
        """The sweep's progress in one line."""
        rows = self.rows.values()
        count = Counter(row.state for row in rows)
        parts = [f"{sum(count[state] for state in FINISHED)} of {len(self.rows)} runs done"]
        parts.append(f"{count['running']} running")
        parts += [f"{count[state]} {word}" for state, word in _ENDED_OTHERWISE.items() if count[state]]
        if tokens := sum(tokens_in(row.tokens) for row in rows):
            parts.append(f"{short(tokens)} tokens")
        if cost := sum(float((row.tokens or {}).get("cost") or 0.0) for row in rows):
            parts.append(f"${cost:.2f}")
        eta = self._eta()
        return ", ".join(parts) + ("" if eta is None else f", about {duration(eta)} left")

    def _eta(self) -> float | None:
        """Estimated seconds left, from the durations of finished runs; None before the first."""
        rows = self.rows.values()
        ended = [row.entry for row in rows if row.entry is not None and row.entry.state in FINISHED]
        walls = [entry.wall_s for entry in ended if entry.wall_s]
        n_open = sum(row.state not in (*FINISHED, *_ENDED_OTHERWISE) for row in rows)
        if not walls or not n_open:
            return None
        return sum(walls) / len(walls) * n_open / min(self._parallel, n_open)

    def event_text(self, kind: str, run: str, details: dict[str, Any]) -> str:
        if kind == "started":
            return "begins" + (f", attempt {details['attempt']}" if details["attempt"] > 1 else "")
        if kind == "finished":
            state, why = details["state"], details["error"]
            if state == "completed":
                return f"completed, score {number(details['score'])} (random {number(details['random'])})"
            if state == "cancelled":
                return str(why or state)
            return in_words(state) + (f": {why}" if why else "")
        if kind == "submit":
            mean = "" if details["mean"] is None else f", mean return {number(details['mean'])}"
            status = in_words(details["status"])
            return f"{details['submit']} {status}{mean}; {details['budget_left']} episodes left"
        if kind == "paused":
            return f"{details['provider']} is away, waits {details['seconds']} s ({details['why']})"
        if kind == "elsewhere":
            return f"is played on {details['host']}"
        return "" if details.get("phase") in ("open", "finished") else super().event_text(kind, run, details)

    def render(self) -> Group:
        """The table as it is now."""
        assert self._console is not None
        table = Table(box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
        # The runs that ended last come first among the ended ones.
        ended = sorted(
            self.rows.items(), key=lambda one: getattr(one[1].entry, "finished_at", ""), reverse=True
        )
        rows = sorted(ended, key=lambda one: _order(one[1]))
        hidden = len(rows) - _SHOWN_ROWS
        shown = rows[:_SHOWN_ROWS]
        columns = _columns(self._console.width, max((len(name) for name, _ in shown), default=0))
        for title, width in columns.items():
            # A run's name is never cut: `--only` takes it.
            cut = title != "run"
            table.add_column(title, width=width, no_wrap=cut, overflow="ellipsis" if cut else "fold")
        for name, row in shown:
            cells = dict(zip(_TITLES, (name, *_cells(row)), strict=True))
            table.add_row(*(Text(cells[title], _STYLES[_order(row)]) for title in columns))
        more = [Text(f"… and {hidden} more")] if hidden > 0 else []
        return Group(table, *more, Text(self.totals()))


class JsonView(SuiteView):
    """Prints one JSON object per line on stdout."""

    def event(self, kind: str, run: str, **more: object) -> None:
        document = {"event": kind, "at": round(time.time(), 3), **({"run": run} if run else {}), **more}
        say_json(document, indent=False)


def results_table(entries: list[SweepRun]) -> Table:
    headings = ("run", "state", "score", "random", "budget used", "tokens")
    made = table(*headings, right=("score", "random", "tokens"))
    for entry in entries:
        tokens = tokens_in(entry.tokens)
        place = f" on {entry.host}" if entry.host and not entry.directory else ""
        cells = (number(entry.score), number(entry.random), str(entry.budget_used))
        shown = short(tokens) if tokens else ""
        made.add_row(Text(entry.name), in_words(entry.state) + place, *cells, shown)
    return made


def _columns(width: int, longest: int) -> dict[str, int]:
    """Columns of the live table with their widths. `width`: the terminal's; `longest`: length of the longest name.

    Names are whole if the terminal has room for them beside a state; otherwise they fold. A narrow terminal gets only
    the first columns of `_ORDER` that fit, and states get their full width before less important columns are added.
    """
    widths = {"run": min(longest, max(_LEAST_NAME, width - _LEAST_STATE - _GAP))}
    room = width - widths["run"]
    for title in _ORDER:
        if title == "last action":
            more = max(0, min(room, _WIDTHS["state"] - widths["state"]))
            widths["state"] += more
            room -= more
        least = min(_WIDTHS[title], _LEAST_STATE)
        if least + _GAP > room:
            break
        widths[title] = least
        room -= least + _GAP
    for title, most in (("state", _WIDTHS["state"]), ("last action", width)):
        if title in widths:
            more = max(0, min(room, most - widths[title]))
            widths[title] += more
            room -= more
    return {title: widths[title] for title in _TITLES if title in widths}


def _order(row: RunLine) -> int:
    kinds = {"running": 0, "error": 1, "cancelled": 1, "waiting": 3}
    return kinds.get(row.state, 2 if row.state.startswith("on ") else 4)


def _cells(row: RunLine) -> tuple[str, ...]:
    progress, tokens = row.progress, tokens_in(row.tokens)
    state = in_words(row.state)
    if row.state == "running" and row.phase is not None:
        state = f"{PHASES[row.phase.phase]} {row.phase.done}/{row.phase.total}"
    elif row.state == "running" and progress is not None and progress.submit_id is not None:
        state = f"{progress.submit_id}: {progress.n_done}/{progress.n_episodes}"
    if row.entry is not None and row.entry.score is not None:
        state = f"score {number(row.entry.score)} (random {number(row.entry.random)})"
    used = submits = ""
    if progress is not None:
        used = f"{progress.episode_budget - progress.remaining_budget}/{progress.episode_budget}"
        submits = str(progress.n_submits)
    elif row.entry is not None:
        used, submits = str(row.entry.budget_used), str(row.entry.n_submits)
    return (
        used,
        submits,
        "" if progress is None else number(progress.best_mean),
        short(tokens) if tokens else "",
        state,
        f"waiting for {row.waits_for}" if row.state == "running" and row.waits_for else row.action,
    )
