"""`evopolicy-gateway`: serves one run's workspace over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from evopolicy_common.cli.conventions import FAILURE, code_of, fail_on_our_errors, setup_logging
from evopolicy_common.cli.frame import App, Version, run_app
from evopolicy_common.errors import ConfigError
from evopolicy_common.logs import structlog
from evopolicy_common.processes.preflight import foreseen
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import Orders, Progress, Ready, Waits
from evopolicy_gateway.run.gateway import Gateway
from evopolicy_gateway.run_folder.layout import RunFolder, folder_of
from evopolicy_gateway.run_folder.locks import alone
from evopolicy_gateway.submits.pipeline import SubmitPipeline
from evopolicy_gateway.submits.tickets import TicketMachine
from evopolicy_gateway.workspace import staging as workspace
from evopolicy_gateway.workspace.agents_md import Urls

app = App()
log: structlog.stdlib.BoundLogger = structlog.get_logger()


@app.command()
def serve(
    run_directory: Annotated[Path, typer.Argument(help="Directory of an open run.", show_default=False)],
    controlled: Annotated[
        bool,
        typer.Option("--controlled", hidden=True, help="Speak with a parent process over stdin and stdout."),
    ] = False,
    _: Version = False,
) -> None:
    """Serve one run to its agent on a loopback port, and print the agent's environment variables.

    Example: evopolicy-gateway runs/evolve/gym_acrobot/first

    `evopolicy run` starts this command itself. Start it by hand to continue an open run after a crash, on the same
    port. Nothing then supervises the agent: run `evopolicy finish` when it has ended. Ctrl-C leaves the run open.
    """
    setup_logging()
    with _failures_in_the_log() if controlled else fail_on_our_errors():
        folder = folder_of(run_directory)
        # The command that controls a gateway holds the folder for both.
        with contextlib.nullcontext() if controlled else alone(folder.lock, folder.root):
            closed = asyncio.run(_serve(folder, controlled))
    sys.stdout.flush()
    # A thread that still reads stdin, or a session that cannot be closed, must not hold up the exit. Status 0 tells
    # the parent that the coordinator has closed the run.
    os._exit(0 if closed or not controlled else 3)


@contextlib.contextmanager
def _failures_in_the_log() -> Iterator[None]:
    """Logs the error that ends the process, for a log that holds JSON lines only."""
    try:
        yield
    except ConfigError as error:
        log.error("the gateway cannot serve", error=str(error))
        raise SystemExit(code_of(error)) from error
    except Exception as error:
        why = foreseen(error)
        log.error("the gateway failed", error=str(error) if why is None else why, exc_info=why is None)
        raise SystemExit(FAILURE) from error


async def _serve(folder: RunFolder, controlled: bool) -> bool:
    def ready(urls: Urls, pipeline: SubmitPipeline) -> None:
        variables = urls.environment() | workspace.variables(folder)
        if controlled:
            opened = pipeline.machine.run
            why = f"--video {opened.video}: {opened.env.env} does not render; there are no videos"
            notes = (why,) if opened.video != "off" and not opened.env.renders else ()
            times = {"held_s": round(pipeline.machine.held_s, 3), "permit_s": round(gateway.permit_s, 3)}
            child_messages.emit(Ready(variables=urls.environment(), notes=notes, **times))
        else:
            print("".join(f"{name}={value}\n" for name, value in variables.items()), end="", flush=True)

    def changed(pipeline: SubmitPipeline) -> None:
        if controlled:
            child_messages.emit(progress_of(pipeline.machine))

    last_wait = ""

    def waits(what: str) -> None:
        nonlocal last_wait
        if what == last_wait:
            return
        last_wait = what
        if controlled:
            child_messages.emit(Waits(waits_for=what))
        elif what:
            print(f"waiting for {what}", file=sys.stderr, flush=True)

    calls: dict[str, Any] = {"on_ready": ready, "on_change": changed, "on_wait": waits}
    gateway = Gateway(folder, **calls, alone=not controlled)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, gateway.tell, None)
    listener = asyncio.create_task(_listen(gateway)) if controlled else None
    try:
        closed = await gateway.run()
    finally:
        if listener is not None:
            listener.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await listener
    return closed


async def _listen(gateway: Gateway) -> None:
    orders = Orders()
    while (order := await orders.next()) is not None:
        if isinstance(order, child_messages.CloseRun):
            gateway.tell(order)
    gateway.tell(None)


def progress_of(machine: TicketMachine) -> Progress:
    """A run in the operator's live view."""
    settled = [ticket for ticket in machine.tickets if ticket.status is not None]
    means = [ticket.mean for ticket in settled if ticket.mean is not None]
    running, last = machine.in_flight, settled[-1] if settled else None
    fields = () if running is None else ("submit_id", "n_episodes", "n_done", "waits_for")
    now: dict[str, Any] = {name: getattr(running, name) for name in fields}
    return Progress(
        episode_budget=machine.run.episode_budget,
        remaining_budget=machine.state.remaining_budget,
        n_submits=machine.state.n_submits,
        n_rejected=machine.n_rejected,
        last_submit_id=last.submit_id if last else None,
        last_status=last.status if last else None,
        last_mean=last.mean if last else None,
        best_mean=max(means, default=None),
        in_flight_s=round(machine.in_flight_s, 3),
        feedback_s=round(machine.feedback_s, 3),
        held_s=round(machine.held_s, 3),
        spent=machine.spent,
        cancelled=machine.cancelled,
        **now,
    )


def main() -> None:
    run_app(app)


if __name__ == "__main__":
    main()
