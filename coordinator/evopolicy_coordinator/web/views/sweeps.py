"""The page of all runs: a matrix for each sweep, and one table."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from evopolicy_common.cli.conventions import bytes_text
from evopolicy_common.terminal import counted, duration, number, short
from evopolicy_coordinator.web.content.cluster import ShownCluster
from evopolicy_coordinator.web.content.rendering import STATES, Words, ident, paged, part, state_words
from evopolicy_coordinator.web.content.run_folders import RunFacts, ShownRuns, ShownSweep
from evopolicy_results.html import Notice, PageView
from evopolicy_results.reading.environments import title_of
from evopolicy_results.studies.palette import Look, looks

MAX_CELLS = 300
"""Runs that the matrix shows; the rest is in the table."""
_TROUBLED = ("error", "unreadable", "no_ok_submit", "cancelled", "interrupted")


def sweeps_view(
    runs: ShownRuns, cluster: ShownCluster | None, words: Words, roots: Sequence[Path]
) -> PageView:
    """All runs: a matrix for each sweep, and one table."""
    every = [run for sweep in runs.sweeps for run in sweep.runs]
    agents = looks(runs.entries, None)
    view = PageView("matrices", "run-rows")
    cells = MAX_CELLS
    for sweep in runs.sweeps:
        name = ident("sweep", str(sweep.root))
        matrix, cells = _matrix(name, sweep, runs, agents, cells)
        view.row("matrices", name, matrix)
    shown, pages = paged(sorted(every, key=_order), words, _row_texts, "run")
    view.parts |= {
        "facts": part("facts", facts=_sweep_facts(every)),
        "notices": part("notices", notices=_run_notices(runs, every, cluster, roots)),
        "run-pages": pages,
    }
    for run in shown:
        may_show = runs.may_show(run)
        score, random = (run.score, run.random) if may_show else (None, None)
        hidden, name = run.finished and not may_show and run.state == "completed", ident("row", run.key)
        look = agents[run.entry]
        row = part("run_row", ident=name, run=run, look=look, score=score, random=random, hidden=hidden)
        view.row("run-rows", name, row)
    return view


def _row_texts(run: RunFacts) -> tuple[str, ...]:
    return run.entry, run.env, run.exp_id, run.host, state_words(run.state), run.run, run.origin


def _order(run: RunFacts) -> tuple[int, str, str, int]:
    place = (
        0 if run.state in ("error", "unreadable") else 1 if not run.finished and run.state != "pending" else 2
    )
    return (place + (run.state == "pending"), run.env, run.entry.casefold(), run.repeat)


def _sweep_facts(every: Sequence[RunFacts]) -> list[tuple[str, str]]:
    states = Counter(run.state for run in every)
    open_runs = [run for run in every if not run.finished and run.state not in ("pending", "interrupted")]
    walls = [run.wall_s for run in every if run.finished and run.wall_s]
    waiting = states["pending"] + states["interrupted"]
    rest = max((run.remaining_s for run in open_runs if run.remaining_s is not None), default=0.0)
    if walls and waiting:
        rest += sum(walls) / len(walls) * waiting / max(1, len(open_runs))
    facts = [
        ("completed", f"{states['completed']} of {len(every)}"),
        *((state_words(state), str(states[state])) for state in _TROUBLED if states[state]),
        ("open", str(len(open_runs))),
        ("waiting", str(states["pending"])),
        ("episodes used", short(sum(run.used for run in every))),
        ("tokens", short(sum(run.tokens for run in every))),
    ]
    if cost := sum(run.cost for run in every):
        facts.append(("cost", f"${cost:.2f}"))
    if rest:
        facts.append(("time left, about", duration(rest)))
    return facts


def _run_notices(
    runs: ShownRuns, every: Sequence[RunFacts], cluster: ShownCluster | None, roots: Sequence[Path]
) -> list[Notice]:
    notices: list[Notice] = []
    if cluster is not None and cluster.trouble:
        title = "The coordinator does not answer; this is the last that is known."
        notices.append(Notice(title, [cluster.trouble]))
    if runs.shut is None and any(run.finished for run in every):
        title = "Hidden scores are not shown: without the coordinator nobody knows which agents are alive."
        notices.append(Notice(title))
    elif hidden := sum(run.finished and run.state == "completed" and not runs.may_show(run) for run in every):
        shown = "1 finished run keeps its" if hidden == 1 else f"{hidden} finished runs keep their"
        notices.append(Notice(f"{shown} hidden scores until no agent of a related run is alive."))
    if waits := Counter(run.waits_for for run in every if run.waits_for):
        lines = [f"{counted(n, 'run')}: {reason}" for reason, n in waits.most_common(12)]
        notices.append(Notice("Runs wait", lines))
    for root in roots:
        try:
            disk = shutil.disk_usage(root)
        except OSError as error:
            notices.append(Notice(f"{root} cannot be read: {error.strerror}"))
            continue
        if disk.free < disk.total * 0.05:
            notices.append(Notice(f"The disk of {root} is nearly full: {bytes_text(disk.free)} are free."))
    if not every:
        notices.append(Notice("No run was found yet. New ones appear here by themselves."))
    return notices


def _matrix(
    name: str, sweep: ShownSweep, runs: ShownRuns, agents: Mapping[str, Look], most: int
) -> tuple[str, int]:
    cells: dict[tuple[str, str], list[RunFacts]] = {}
    shown = sorted(sweep.runs, key=lambda run: (_order(run)[0], run.repeat))[:most]
    for run in shown:
        cells.setdefault((run.entry, run.env), []).append(run)
    entries = sorted({run.entry for run in shown}, key=str.casefold)
    envs = sorted({run.env for run in shown})
    rows = [
        {
            "entry": entry,
            "look": agents[entry],
            "cells": [
                [
                    _chip(run, runs.may_show(run))
                    for run in sorted(cells.get((entry, env), []), key=lambda run: (run.repeat, run.exp_id))
                ]
                for env in envs
            ],
        }
        for entry in entries
    ]
    by_state = {run.state: run for run in shown}
    matrix = part(
        "matrix",
        ident=name,
        name=sweep.name,
        folder="" if sweep.root is None else str(sweep.root),
        legend=[
            {"symbol": symbol, "kind": _kind(by_state[state]), "words": words}
            for state, (symbol, words) in STATES.items()
            if state in by_state
        ],
        envs=[(env, title_of(env)) for env in envs],
        rows=rows,
        left_out=len(sweep.runs) - len(shown),
        paused=sweep.paused,
    )
    return matrix, most - len(shown)


def _chip(run: RunFacts, may_show: bool) -> dict[str, object]:
    symbol, words = STATES.get(run.state, ("?", run.state))
    facts = [f"repeat {run.repeat}", words]
    if run.budget:
        facts.append(f"{run.used} of {run.budget} episodes")
    if run.best is not None:
        facts.append(f"best train return {run.best:.4g}")
    value = ""
    if may_show and run.score is not None:
        facts.append(f"held-out score {run.score:.4g}, random {number(run.random)}")
        value = number(run.score)
    elif run.best is not None:
        value = number(run.best)
    facts += [each for each in (run.origin, run.error[:200]) if each]
    return {"key": run.key, "symbol": symbol, "value": value, "kind": _kind(run), "title": "; ".join(facts)}


def _kind(run: RunFacts) -> str:
    if run.state in _TROUBLED:
        return "bad"
    return "done" if run.finished else "idle" if run.state == "pending" else "live"
