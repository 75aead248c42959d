"""Several runs on one cluster: an operator's cluster, or one of this machine brought up for them."""

from __future__ import annotations

import asyncio
import contextlib
import shlex
import traceback
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_common.cli import end_on_sigterm
from evopolicy_common.console import Terminal, table
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.operator import RunSettings
from evopolicy_common.processes.local_cluster import local_cluster, unless_failed
from evopolicy_common.processes.preflight import foreseen
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.terminal import say, say_lines
from evopolicy_common.wire import transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.operator.operations import Operations, find_credentials
from evopolicy_gateway.operator.watch import RunView, Watch
from evopolicy_gateway.run.lifecycle import RunLifecycle
from evopolicy_gateway.run.plan import Plan

EXIT_CODES = {"error": 1, "cancelled": 5, "agent_failed": 4, "no_ok_submit": 3}
_AGENT_FAILED = ("agent_failed", "silent")
"""Of a command that plays runs, the gravest first; 0 when every run completed."""


class Cluster(msgspec.Struct, frozen=True, kw_only=True):
    """Which cluster a command uses: a local one with so many slots, or the one that is named (or this machine's own)."""

    connect: tuple[str, ...] = ()
    file: Path | None = None
    """The operator's credentials."""
    local_slots: int | None = None
    state: Path | None = None
    """Of a local one: its folder; None for one that is thrown away."""
    unjailed: bool = False
    """Of a local one with a state: agents could read it."""
    data: Path | None = None
    audit: float = 0.0
    """Of a local one: share of the episodes that a second worker plays again."""
    hidden_isolation: str | None = None
    """Of a local one: as `evopolicy-coordinator --hidden-isolation` takes it; None for its default."""

    def check_cases(self, runs: Iterable[RunSettings]) -> None:
        """ConfigError where a local one has not the case files that a run plays."""
        if (
            self.local_slots is not None
            and self.data is None
            and any(run.profile == "published" for run in runs)
        ):
            raise ConfigError(
                "--profile published plays the published case files: give --data FOLDER, the folder data/main-128 of the"
                " published software, which holds gym/acrobot/train.json and so on"
            )


class RunResult(msgspec.Struct, frozen=True, kw_only=True):
    """What a run came to, for people and scripts."""

    env: str
    run_directory: str
    status: str
    """`completed`, `no_ok_submit`, `error`, `cancelled`."""
    error: str | None = None
    final_score: float | None = None
    """Held-out mean return."""
    random_score: float | None = None
    """Of uniform random actions on the same cases."""
    best_submit_index: int | None = None
    n_submits: int = 0
    budget_used: int = 0
    closed_reason: str = ""
    wall_s: float = 0.0
    in_question: bool = False
    """Audits found results of it disputed, or a forger among those who played it."""
    wrong_option: bool = False
    """It was never opened, for an option's sake."""


@contextlib.asynccontextmanager
async def connected(
    where: Cluster, env_ids: Sequence[str], tiers: Collection[Tier]
) -> AsyncIterator[tuple[Operations, Credentials, asyncio.Future[None] | None]]:
    """A link to the cluster, the gateways' credentials, and what fails when a local cluster cannot be kept up.

    `tiers`: sandbox tiers that will be asked for, without which a local cluster fails.
    """
    end_on_sigterm()
    async with contextlib.AsyncExitStack() as stack:
        failed: asyncio.Future[None] | None = None
        file, opened = where.file, None
        if where.local_slots is not None:
            cluster = await stack.enter_async_context(
                local_cluster(
                    "local",
                    state=where.state,
                    data=where.data,
                    audit=where.audit,
                    hidden_isolation=where.hidden_isolation,
                    unjailed=where.unjailed,
                )
            )
            if cluster.note:
                say(f"note: {cluster.note}", err=True)
            await cluster.start_workers(env_ids, slots=where.local_slots, tiers=tiers)
            file, failed, opened = cluster.operator_file, cluster.failed, cluster.opened
        operator, gateway = find_credentials(where.connect, file)
        link = await stack.enter_async_context(transport.connect(operator))
        yield Operations(link, opened), gateway, failed


async def play_all(
    plans: Sequence[Plan], where: Cluster, parallel: int, console: Terminal
) -> list[RunResult]:
    """Plays all plans, so many agents at once; one that fails does not stop the others."""
    results: dict[int, RunResult] = {}
    with RunView(console).shown() as watch:
        settings = [plan.settings for plan in plans]
        where.check_cases(settings)
        async with connected(
            where, [one.env for one in settings], {one.sandbox_tier for one in settings}
        ) as (operations, gateway, failed):
            gate = asyncio.Semaphore(parallel)

            async def one(index: int, plan: Plan) -> None:
                await gate.acquire()
                with contextlib.ExitStack() as place:
                    # Once its agent is gone, the next one begins while this run is scored.
                    place.callback(gate.release)
                    results[index] = await _play(plan, operations, gateway, watch, place.close)

            async def everything() -> None:
                async with asyncio.TaskGroup() as group:
                    for index, plan in enumerate(plans):
                        group.create_task(one(index, plan))

            await unless_failed(asyncio.create_task(everything()), failed)
    if all(result.wrong_option for result in results.values()):
        raise ConfigError(results[0].error or "")
    return [results[index] for index in range(len(plans))]


class End(NamedTuple):
    """What a run came to, as far as the exit code and its reason go."""

    name: str
    status: str
    closed_reason: str
    error: str | None
    where: str
    """Its folder; empty where there is none here."""

    @property
    def kind(self) -> str:
        """A key of `EXIT_CODES`, or `completed`."""
        if self.closed_reason in _AGENT_FAILED and self.status != "cancelled":
            return "agent_failed"
        return self.status if self.status in EXIT_CODES or self.status == "completed" else "error"

    @property
    def why(self) -> str:
        """In a line."""
        said = {
            "agent_failed": f"its agent stopped: {self.closed_reason}",
            "no_ok_submit": "no submit of it was ok",
            "cancelled": "it was cancelled",
        }
        why = self.error or said.get(self.kind, f"it was left {self.status or 'as it was'}")
        return f"{self.name}: {why}" + (f"; see {self.where}" if self.where else "")


def exit_code(ends: Sequence[End]) -> int:
    """For the gravest of some runs' ends: see `EXIT_CODES`. Says on stderr of each run that did not complete why."""
    say_lines((end.why for end in ends if end.kind != "completed"), err=True)
    kinds = {end.kind for end in ends}
    return next((code for kind, code in EXIT_CODES.items() if kind in kinds), 0)


def ends_of(results: Sequence[RunResult]) -> list[End]:
    """What these runs came to."""
    return [End(one.env, one.status, one.closed_reason, one.error, one.run_directory) for one in results]


def report(results: Sequence[RunResult], runs: Path, console: Terminal) -> None:
    """A table of what the runs came to, where each of them is, and what to do with all that are in the folder `runs`."""
    headings = ("environment", "score", "random", "best submit", "budget used", "ended")
    made = table(*headings, right=("score", "random"))
    for result in results:
        best = "" if result.best_submit_index is None else f"submit {result.best_submit_index}"
        shown = result.closed_reason.replace("_", " ") if result.status == "completed" else result.status
        made.add_row(
            result.env,
            _number(result.final_score),
            _number(result.random_score),
            best,
            str(result.budget_used),
            shown,
        )
    console.print(made)
    for result in results:
        if result.in_question:
            text = f"{result.env}: audits put these results in question; see `audit` in run.json"
            console.print(text, soft_wrap=True)
        console.print(f"run directory: {result.run_directory}", soft_wrap=True)
    if any(result.status == "completed" for result in results):
        console.print(next_step(runs), soft_wrap=True)


def next_step(runs: Path) -> str:
    """What to do with the runs in that folder."""
    return f"next: evopolicy report {shlex.quote(str(runs))} --out report"


async def _play(
    plan: Plan,
    operations: Operations,
    gateway: Credentials,
    watch: Watch,
    on_agent_gone: Callable[[], None],
) -> RunResult:
    play = RunLifecycle(plan, operations, gateway, watch, on_agent_gone=on_agent_gone)
    try:
        return _result(plan, await (play.go_on() if plan.resume else play.play()))
    except ConfigError as error:
        return RunResult(
            env=plan.settings.env,
            run_directory=str(plan.folder.root),
            status="error",
            error=str(error),
            wrong_option=True,
        )
    except Exception as error:
        why = why_failed(error, plan.folder.harness_log)
        watch.note(plan.settings.env, f"failed: {why}")
        return RunResult(
            env=plan.settings.env, run_directory=str(plan.folder.root), status="error", error=why
        )


def why_failed(error: Exception, log: Path) -> str:
    """Why a run failed, in a line. The other runs of a command go on after a bug, too, whose traceback is in the run's log."""
    why = foreseen(error)
    if why is None:
        why = f"{type(error).__name__}: {error}; the traceback is in {log}"
        with contextlib.suppress(OSError):
            log.parent.mkdir(parents=True, exist_ok=True)
            with log.open("a") as file:
                traceback.print_exception(error, file=file)
    return why


def _result(plan: Plan, record: RunRecord) -> RunResult:
    outcome = record.outcome
    reference = outcome.random_reference
    return RunResult(
        env=record.env,
        run_directory=str(plan.folder.root),
        status=outcome.status,
        error=outcome.error,
        final_score=outcome.score,
        random_score=None if reference is None else reference.mean_return,
        best_submit_index=outcome.best_submit_index,
        n_submits=len(list(plan.folder.checkpoints.glob("submit_*"))),
        budget_used=outcome.budget_used,
        closed_reason=outcome.closed_reason,
        wall_s=record.timing.wall_time_seconds,
        in_question=record.audit is not None and record.audit.in_question,
    )


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
