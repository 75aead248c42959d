"""The runs of `run` and `local`: a sweep without a file, an index on disk or other hosts."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from evopolicy_common.console import Terminal, table
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import unless_failed
from evopolicy_common.records.run_record import Outcome, RunRecord
from evopolicy_common.records.suite_folder import Index, SweepRun
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import number
from evopolicy_gateway.operator.cluster import ChosenCluster, connected
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.watch import RunView
from evopolicy_gateway.suite.decisions import Decision
from evopolicy_gateway.suite.suite_file import Parallel
from evopolicy_gateway.suite.suite_index import entry_of, next_step
from evopolicy_gateway.suite.sweep import Sweep

if TYPE_CHECKING:
    from evopolicy_common.statistics.intervals import Estimate


class PlayedRuns(msgspec.Struct, frozen=True):
    plans: Sequence[Plan]
    index: Index
    """Of this command alone; not saved."""
    records: dict[str, RunRecord]
    """The existing `run.json` records, by run name."""
    wrong: set[str]
    """Names of runs that were never opened because of a wrong option."""


class _Runs(Sweep):
    results: PlayedRuns

    async def _record(self, decision: Decision, begun: SweepRun) -> SweepRun:
        run = decision.run
        record = self.results.records[run.name] = await self._played(decision, run)
        entry, outcome = entry_of(run, record), record.outcome
        # Unlike a suite, this never repeats a run whose agent did not play, so the run keeps its own status.
        return msgspec.structs.replace(entry, state=outcome.status, error=outcome.error)

    def _why(self, run: Plan, error: Exception) -> str:
        if isinstance(error, ConfigError) and run.name not in self._scored:
            self.results.wrong.add(run.name)
            return str(error)
        why = super()._why(run, error)
        self._watch.note(run.name, f"failed: {why}")
        return why


async def play_plans(
    plans: Sequence[Plan], where: ChosenCluster, parallel: int, console: Terminal
) -> PlayedRuns:
    """Plays all plans, `parallel` agents at once; a failed run does not stop the others.

    Raises ConfigError when an option is wrong for every run.
    """
    played = PlayedRuns(plans, Index(suite=""), {}, set())
    decided = [Decision(run=plan, kind="resume" if plan.resume else "new", attempt=1) for plan in plans]
    with RunView(console).shown() as watch:
        settings = [plan.settings for plan in plans]
        where.check_cases(settings)
        wanted = [one.env for one in settings], {one.sandbox_tier for one in settings}
        async with connected(where, *wanted) as (operations, gateway, failed):
            runs = _Runs(Parallel(machine=parallel), played.index, operations, gateway, watch)
            # A temporary cluster takes its runs with it.
            runs.leaves = "nothing" if where.local is not None and where.local.state is None else "ended"
            runs.results = played
            await unless_failed(asyncio.create_task(runs.play_runs(decided)), failed)
    if played.wrong == set(played.index.runs):
        raise ConfigError(played.index.runs[plans[0].name].error or "")
    return played


def documents(played: PlayedRuns) -> list[dict[str, Any]]:
    """The results of the runs, for scripts."""
    return [_document(run, played) for run in played.plans]


def _document(run: Plan, played: PlayedRuns) -> dict[str, Any]:
    entry, record = played.index.runs[run.name], played.records.get(run.name)
    return {
        "env": entry.env,
        "run_directory": str(run.folder.root),
        "status": entry.state,
        "error": entry.error,
        "final_score": entry.score,
        "random_score": entry.random,
        "above_random": None if record is None else _above_random(record.outcome),
        "best_submit_index": None if record is None else record.outcome.best_submit_index,
        "n_submits": 0 if record is None else len(list(run.folder.checkpoints.glob("submit_*"))),
        "budget_used": entry.budget_used,
        "closed_reason": entry.closed_reason,
        "wall_s": entry.wall_s,
        "wrong_option": run.name in played.wrong,
    }


def _above_random(outcome: Outcome) -> Estimate | None:
    """Score minus the mean return of uniform random actions, paired by held-out case, with the 95 % interval over
    cases that a report has of one run. None without a score, or if random actions were not played."""
    returns, reference = outcome.heldout_returns, outcome.random_reference
    if outcome.score is None or not returns or reference is None or len(reference.returns) != len(returns):
        return None
    # With numpy, which nothing else in this command needs.
    import numpy as np

    from evopolicy_common.statistics.intervals import over_cases

    played, random = np.array(returns), np.array(reference.returns)
    return over_cases(played - random, (played, random))


def _against_random(difference: Estimate) -> str:
    if difference.low is None or difference.high is None:
        return f"score − random = {number(difference.value)}, without an interval: {difference.reason}"
    word, least, most = "better", difference.low, difference.high
    if difference.value < 0.0:
        word, least, most = "worse", -most, -least
    interval = f"{number(abs(difference.value))} (95 % interval {number(least)} to {number(most)}) {word}"
    return f"{interval} than random" if least > 0.0 else f"not distinguishable from random: {interval}"


def report(played: PlayedRuns, runs: Path, console: Terminal) -> None:
    """Prints a table of the results, the run directories, and the next command for the folder `runs`."""
    headings = ("environment", "score", "random", "best submit", "budget used", "ended")
    made = table(*headings, right=("score", "random"))
    results = documents(played)
    for one in results:
        best = "" if one["best_submit_index"] is None else f"submit {one['best_submit_index']}"
        shown = in_words(one["closed_reason"] if one["status"] == "completed" else one["status"])
        score, random = number(one["final_score"]), number(one["random_score"])
        made.add_row(one["env"], score, random, best, str(one["budget_used"]), shown)
    console.print(made)
    for one in results:
        if one["above_random"] is not None:
            console.print(f"{one['env']}: {_against_random(one['above_random'])}", soft_wrap=True)
        console.print(f"run directory: {one['run_directory']}", soft_wrap=True)
    if any(one["status"] == "completed" for one in results):
        console.print(next_step(runs), soft_wrap=True)
