"""`evopolicy status`, `evopolicy workers …`, `evopolicy runs …`: an operator's view of a cluster, and commands to it.

Exit codes: 0 all well, 1 the coordinator refused or cannot be reached, 2 wrong usage.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import typer
from rich.console import Group, RenderableType
from rich.text import Text

from evopolicy_common.cli.conventions import Connect, CredentialsFile, Json
from evopolicy_common.cli.frame import App
from evopolicy_common.console import listing, terminal
from evopolicy_common.messages.status import RunStatus, StatusReply, WorkerStatus
from evopolicy_common.terminal import counted, duration, say, say_json
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.operator_client import OperatorClient
from evopolicy_coordinator.web.content.remarks import remarks, served_by

T = TypeVar("T")

status_app = App(name="status", help="Show workers, runs, and the reasons why runs wait.")
workers_app = App(name="workers", help="Drain, pause and resume workers.", no_args_is_help=True)
runs_app = App(name="runs", help="Cancel and repin runs.", no_args_is_help=True)


def asking(connect: list[str] | None, file: Path | None, work: Callable[[OperatorClient], Awaitable[T]]) -> T:
    async def ask_cluster() -> T:
        async with transport.connect(credentials.find_running(tuple(connect or ()), file)) as link:
            return await work(OperatorClient(link))

    return asyncio.run(ask_cluster())


@status_app.callback(
    invoke_without_command=True, epilog="Example: evopolicy status --credentials operator-me"
)
def status(connect: Connect = None, file: CredentialsFile = None, as_json: Json = False) -> None:
    """Show workers, runs, and the reasons why runs wait."""
    reply = asking(connect, file, OperatorClient.status)
    if as_json:
        say_json(reply)
    else:
        terminal().print(render(reply))


WorkerName = Annotated[
    str, typer.Argument(help="The worker's name, as `evopolicy status` shows it.", show_default=False)
]
RunId = Annotated[
    str, typer.Argument(help="The run's id, as `evopolicy status` shows it.", show_default=False)
]


_WORKER_COLUMNS: dict[str, Callable[[WorkerStatus], str]] = {
    "worker": lambda one: one.worker,
    "host": lambda one: one.host,
    "state": lambda one: one.state,
    "slots": lambda one: str(one.slots),
    "running": lambda one: str(one.running),
    "held": lambda one: str(one.held),
    "envs": lambda one: str(len(one.environments)),
    "tiers": lambda one: ", ".join([" ".join(one.tiers), *(f"no {tier}" for tier in one.missing_tiers)]),
    "class": lambda one: one.fingerprint,
    "seen": lambda one: f"{duration(one.last_seen_s)} ago",
}
_COUNTS = ("slots", "running", "held", "envs")


def _command(name: str, state: Literal["active", "paused", "draining"], what: str) -> None:
    @workers_app.command(name, epilog=f"Example: evopolicy workers {name} lab-3f2a", help=what)
    def command(worker: WorkerName, connect: Connect = None, file: CredentialsFile = None) -> None:
        async def work(operator: OperatorClient) -> set[str]:
            reply = await operator.status()
            await operator.set_worker(worker, state)
            return {one.worker for one in reply.workers}

        known = asking(connect, file, work)
        if worker in known:
            say(f"{worker} is {state}")
        else:
            connected = ", ".join(sorted(known)) or "none"
            say(f"{worker} is not connected; it is {state} when it connects. Connected: {connected}")


_command("drain", "draining", "Give a worker no more work. It finishes its episodes, then ends.")
_command(
    "pause",
    "paused",
    "Give a worker no more work until it is resumed. It finishes its episodes and stays connected.",
)
_command("resume", "active", "Give work again to a worker that was paused or drained.")


@runs_app.command(epilog="Example: evopolicy runs cancel r-0f2e9a7c11d04b35")
def cancel(run: RunId, connect: Connect = None, file: CredentialsFile = None) -> None:
    """End a run without a score, and stop its episodes."""

    async def cancelled(operator: OperatorClient) -> bool:
        reply = await operator.status()
        await operator.cancel(run)
        return any(one.run == run for one in reply.runs)

    was_open = asking(connect, file, cancelled)
    say(f"{run} is cancelled" if was_open else f"{run} had ended before; its result stays as it is")


@runs_app.command("agent-gone", epilog="Example: evopolicy runs agent-gone r-0f2e9a7c11d04b35")
def agent_gone(run: RunId, connect: Connect = None, file: CredentialsFile = None) -> None:
    """Vouch that a run's agent has ended, because its machine is lost for good.

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
    slots = sum(worker.slots for worker in reply.workers if worker.state == "active")
    head = (
        f"cluster {reply.cluster} · evopolicy {reply.version} · up {duration(reply.uptime_s)} on {served_by(reply)} ·"
        f" {counted(slots, 'slot')} · {sum(run.queued for run in reply.runs)} queued,"
        f" {sum(run.running for run in reply.runs)} running,"
        f" {counted(reply.episodes_done, 'episode')} done, {reply.episodes_per_s:.1f}/s over the last minute"
    )
    parts: list[RenderableType] = [
        Text(head),
        listing(reply.workers, _WORKER_COLUMNS, right=_COUNTS, whole=("worker", "class")),
        *_classes(reply),
        listing(reply.runs, _RUN_COLUMNS, whole=("run",)),
    ]
    waits = [f"{run.run} waits for {run.waits_for}" for run in reply.runs if run.waits_for]
    lines = itertools.chain(waits, *remarks(reply).values())
    return Group(*parts, *(Text(line, style="yellow") for line in lines))


_RUN_COLUMNS: dict[str, Callable[[RunStatus], str]] = {
    "run": lambda run: run.run,
    "entry": lambda run: run.entry,
    "environment": lambda run: run.env,
    "phase": lambda run: f"{run.phase}, abandoned" if run.abandoned else run.phase,
    "budget left": lambda run: f"{run.remaining_budget}/{run.budget}",
    "submits": lambda run: str(run.n_submits),
    "queued": lambda run: str(run.queued),
    "running": lambda run: str(run.running),
    "done": lambda run: str(run.done),
    "agent": lambda run: run.agent_host,
}


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
