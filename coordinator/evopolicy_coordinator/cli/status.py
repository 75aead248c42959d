"""`evopolicy status`, `evopolicy workers …`, `evopolicy runs …`: an operator's view of a cluster, and commands to it.

Exit codes: 0 all well, 1 the coordinator refused or cannot be reached, 2 wrong usage.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from evopolicy_common import catalogue
from evopolicy_common.cli.conventions import Connect, CredentialsFile, fail_on_our_errors
from evopolicy_common.cli.frame import App
from evopolicy_common.console import listing, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.status import RunStatus, StatusReply, WorkerStatus
from evopolicy_common.terminal import duration, say, say_json, say_lines
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.operator_client import OperatorClient

T = TypeVar("T")

status_app = App(name="status", help="Show workers, runs, and the reasons why runs wait.")
workers_app = App(
    name="workers",
    help="List, drain, pause and resume workers.",
    no_args_is_help=True,
)
runs_app = App(
    name="runs",
    help="List, cancel and repin runs.",
    no_args_is_help=True,
)


def asking(connect: list[str] | None, file: Path | None, work: Callable[[OperatorClient], Awaitable[T]]) -> T:
    """`work` with a link to the coordinator; our errors as one line."""

    async def ask() -> T:
        async with transport.connect(credentials.find("operator", tuple(connect or ()), file)) as link:
            return await work(OperatorClient(link))

    with fail_on_our_errors():
        return asyncio.run(ask())
    raise AssertionError("fail_on_our_errors never swallows")


@status_app.callback(
    invoke_without_command=True, epilog="Example: evopolicy status --watch --credentials operator-me"
)
def status(
    connect: Connect = None,
    file: CredentialsFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the status as JSON.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Refresh every second until Ctrl-C.")] = False,
) -> None:
    """Show workers, runs, and the reasons why runs wait.

    --watch --json prints one line of JSON every second.
    """
    if watch:
        asking(connect, file, _watch_lines if as_json else _watch)
        return
    reply = asking(connect, file, OperatorClient.status)
    if as_json:
        say_json(reply)
    else:
        terminal().print(render(reply))


async def _watch(operator: OperatorClient) -> None:
    with Live(console=terminal(), auto_refresh=False) as live:
        while True:
            started = time.monotonic()
            live.update(render(await operator.status()), refresh=True)
            await asyncio.sleep(max(0.0, 1.0 - (time.monotonic() - started)))


async def _watch_lines(operator: OperatorClient) -> None:
    while True:
        say_json(await operator.status(), indent=False)
        await asyncio.sleep(1.0)


Json = Annotated[bool, typer.Option("--json", help="Print them as JSON.")]
WorkerName = Annotated[
    str, typer.Argument(help="The worker's name, as `evopolicy workers list` shows it.", show_default=False)
]
Absent = Annotated[
    bool, typer.Option("--absent", help="The worker is not connected; apply this when it reconnects.")
]
RunId = Annotated[
    str, typer.Argument(help="The run's id, as `evopolicy runs list` shows it.", show_default=False)
]


@workers_app.command("list", epilog="Example: evopolicy workers list")
def list_workers(connect: Connect = None, file: CredentialsFile = None, as_json: Json = False) -> None:
    """List the workers that are or recently were connected, with their environments."""
    reply = asking(connect, file, OperatorClient.status)
    if as_json:
        say_json(reply.workers)
        return
    shown = ("worker", "host", "state", "slots", "running", "tiers", "environments")
    terminal().print(_workers(reply, *shown) if reply.workers else "no worker is connected")
    say_lines(line for worker in reply.workers for line in _lacks(worker))


def _tiers(worker: WorkerStatus) -> str:
    return ", ".join([" ".join(worker.tiers), *(f"no {tier}" for tier in worker.missing_tiers)])


def _lacks(worker: WorkerStatus) -> Iterator[str]:
    for tier, why in worker.missing_tiers.items():
        yield f"{worker.worker} has no sandbox tier {tier}: {why}"
    for env, why in worker.failed_environments.items():
        yield f"{worker.worker} does not offer {env}: {why}"


def _names(env_ids: Sequence[str]) -> str:
    """Environments in short form: a suite's name for all of a suite."""
    remaining, names = set(env_ids), []
    for suite in catalogue.suites():
        members = set(catalogue.resolve([suite]))
        if members <= remaining:
            remaining -= members
            names.append(suite)
    return " ".join([*names, *(env_id for env_id in env_ids if env_id in remaining)])


_WORKER_COLUMNS: dict[str, Callable[[WorkerStatus], str]] = {
    "worker": lambda one: one.worker,
    "host": lambda one: one.host,
    "state": lambda one: one.state,
    "slots": lambda one: str(one.slots),
    "running": lambda one: str(one.running),
    "held": lambda one: str(one.held),
    "envs": lambda one: str(len(one.environments)),
    "tiers": _tiers,
    "environments": lambda one: _names(one.environments),
    "class": lambda one: one.fingerprint,
    "seen": lambda one: f"{duration(one.last_seen_s)} ago",
}


def _workers(reply: StatusReply, *columns: str) -> Table:
    shown = {name: _WORKER_COLUMNS[name] for name in columns}
    return listing(
        reply.workers, shown, right=("slots", "running", "held", "envs"), whole=("worker", "class")
    )


def _set_worker(
    worker: str,
    state: Literal["active", "paused", "draining"],
    connect: list[str] | None,
    file: Path | None,
    absent: bool,
) -> None:
    async def work(operator: OperatorClient) -> None:
        if not absent:
            reply = await operator.status()
            known = {*(one.worker for one in reply.workers), *reply.quarantined}
            if worker not in known:
                raise ConfigError(
                    f"no worker {worker!r} is connected; there are: {', '.join(sorted(known)) or 'none'}."
                    " For a worker that will return, add --absent"
                )
        await operator.set_worker(worker, state)

    asking(connect, file, work)
    say(f"{worker} is {state}")


def _command(name: str, state: Literal["active", "paused", "draining"], what: str) -> None:
    @workers_app.command(name, epilog=f"Example: evopolicy workers {name} lab-3f2a", help=what)
    def command(
        worker: WorkerName, connect: Connect = None, file: CredentialsFile = None, absent: Absent = False
    ) -> None:
        _set_worker(worker, state, connect, file, absent)


_command("drain", "draining", "Give a worker no more work. It finishes its episodes, then ends.")
_command(
    "pause",
    "paused",
    "Give a worker no more work until it is resumed. It finishes its episodes and stays connected.",
)
_command(
    "resume", "active", "Give work again to a worker that was paused, drained, or quarantined by an audit."
)


@runs_app.command("list", epilog="Example: evopolicy runs list")
def list_runs(connect: Connect = None, file: CredentialsFile = None, as_json: Json = False) -> None:
    """List the unfinished runs, with the reasons why they wait."""
    reply = asking(connect, file, OperatorClient.status)
    if as_json:
        say_json(reply.runs)
        return
    shown = listing(
        reply.runs, {**_columns("environment"), "waits for": lambda run: run.waits_for}, whole=("run",)
    )
    terminal().print(shown if reply.runs else "no run is open")
    say_lines(abandoned(reply.runs))


def _columns(env: str) -> dict[str, Callable[[RunStatus], str]]:
    """The first columns of tables of runs. `env`: heading of the environment."""
    return {
        "run": lambda run: run.run,
        "entry": lambda run: run.entry,
        env: lambda run: run.env,
        "phase": lambda run: f"{run.phase}, abandoned" if run.abandoned else run.phase,
        "budget left": lambda run: f"{run.remaining_budget}/{run.budget}",
    }


@runs_app.command(epilog="Example: evopolicy runs cancel r-0f2e9a7c11d04b35")
def cancel(
    run: RunId,
    connect: Connect = None,
    file: CredentialsFile = None,
) -> None:
    """End a run without a score, and stop its episodes."""

    async def cancelled(operator: OperatorClient) -> bool:
        reply = await operator.status()
        await operator.cancel(run)
        return any(one.run == run for one in reply.runs)

    was_open = asking(connect, file, cancelled)
    say(f"{run} is cancelled" if was_open else f"{run} had ended before; its result stays as it is")


@runs_app.command("agent-gone", epilog="Example: evopolicy runs agent-gone r-0f2e9a7c11d04b35")
def agent_gone(
    run: RunId,
    connect: Connect = None,
    file: CredentialsFile = None,
) -> None:
    """Vouch that a run's agent has ended, after its machine was lost for good.

    The cluster may then play hidden cases on that machine. If the agent is still alive, it could learn them: when in
    doubt, resume the run or restart the machine.
    """
    asking(connect, file, lambda operator: operator.agent_gone(run))
    say(f"the agent of {run} is recorded as ended")


@runs_app.command(
    epilog="Example: evopolicy runs repin r-0f2e9a7c11d04b35 b23d564d30c1 --reason 'the old workers are gone'"
)
def repin(
    run: RunId,
    fingerprint_class: Annotated[
        str, typer.Argument(metavar="CLASS", help="The workers' class, as `evopolicy status` shows it.")
    ],
    reason: Annotated[str, typer.Option(help="The reason, recorded in the run.")],
    connect: Connect = None,
    file: CredentialsFile = None,
) -> None:
    """Let a run continue on workers with other library versions, when its first workers are gone."""
    asking(connect, file, lambda operator: operator.repin(run, fingerprint_class, reason))
    say(f"{run} continues on workers of class {fingerprint_class}")


def render(reply: StatusReply) -> RenderableType:
    """The status as tables."""
    slots = sum(worker.slots for worker in reply.workers if worker.state == "active")
    head = (
        f"cluster {reply.cluster} · evopolicy {reply.version} · up {duration(reply.uptime_s)} · {slots} slots ·"
        f" {sum(run.queued for run in reply.runs)} queued, {sum(run.running for run in reply.runs)} running,"
        f" {reply.episodes_done} episodes done, {reply.episodes_per_s:.1f}/s over the last minute"
    )
    parts: list[RenderableType] = [
        Text(head),
        _workers(
            reply, "worker", "host", "state", "slots", "running", "held", "envs", "tiers", "class", "seen"
        ),
        *_classes(reply),
        _runs(reply),
    ]
    if reply.audit_share or reply.audits:
        stand = ", ".join(f"{n} {state.replace('_', ' ')}" for state, n in sorted(reply.audits.items()))
        parts.append(
            Text(f"audits: {reply.audit_share:g} of the episodes of new runs; now {stand or 'none'}")
        )
    parts += [Text(line, style="yellow") for line in _remarks(reply)]
    return Group(*parts)


def _classes(reply: StatusReply) -> Iterator[Text]:
    """The members of the workers' classes, and environments with several classes, of which only one plays a run."""
    for name, versions in sorted({worker.fingerprint: worker.versions for worker in reply.workers}.items()):
        yield Text(f"class {name}: " + ", ".join(f"{what} {version}" for what, version in versions.items()))
    played: dict[str, dict[str, list[str]]] = {}
    for worker in reply.workers:
        for env, name in worker.classes.items():
            played.setdefault(env, {}).setdefault(name, []).append(worker.worker)
    for env, classes in sorted(played.items()):
        if len(classes) > 1:
            text = "; ".join(f"class {name} on {', '.join(there)}" for name, there in sorted(classes.items()))
            yield Text(f"{env} has {len(classes)} classes: {text}")


def _runs(reply: StatusReply) -> Table:
    columns = {
        **_columns("env"),
        "submits": lambda run: str(run.n_submits),
        "queued": lambda run: str(run.queued),
        "running": lambda run: str(run.running),
        "done": lambda run: str(run.done),
        "agent": lambda run: run.agent_host,
    }
    return listing(reply.runs, columns, whole=("run",))


def _remarks(reply: StatusReply) -> Iterator[str]:
    if reply.trouble:
        yield f"{reply.trouble}; this is the state of then"
    for name, why in reply.quarantined.items():
        yield f"{name} is quarantined: {why} (evopolicy workers resume {name} takes it back)"
    for one in reply.turned_away:
        where = f" of {one.host}" if one.host else ""
        yield f"{one.worker}{where} was turned away {duration(one.ago_s)} ago: {one.why}"
    yield from reply.disputes
    for run in reply.runs:
        if run.waits_for:
            yield f"{run.run} waits for {run.waits_for}"
    yield from abandoned(reply.runs)
    for worker in reply.workers:
        for run_id, why in worker.refused.items():
            yield f"{worker.worker} gets no work of {run_id}: {why}"
        yield from _lacks(worker)
        if worker.hidden_bar:
            yield f"{worker.worker} plays no hidden episodes now: {worker.hidden_bar}"
    yield from reply.stalls


def abandoned(runs: Iterable[RunStatus]) -> Iterator[str]:
    """Says of each abandoned run how to end it."""
    for run in runs:
        if run.abandoned:
            yield (
                f"{run.run} has had no gateway for {duration(run.silent_s)}: give its command again with --resume, or"
                f" end it with evopolicy runs cancel {run.run}"
            )
