"""Serves one run's workspace over HTTP: `python -m evopolicy_gateway.cli.serve RUN_DIRECTORY`.

`evopolicy run` starts this process and speaks with it over stdin and stdout (`processes.child_messages`). Exit codes: 0
the coordinator has closed the run, 3 the run stays open.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from evopolicy_common.cli.conventions import FAILURE, code_of, setup_logging
from evopolicy_common.errors import ConfigError
from evopolicy_common.logs import log
from evopolicy_common.processes.preflight import foreseen
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import Orders, Ready, TrainProgress, Waits
from evopolicy_gateway.run.gateway import Gateway
from evopolicy_gateway.run_folder.layout import RunFolder, folder_of
from evopolicy_gateway.submits.pipeline import SubmitPipeline
from evopolicy_gateway.submits.tickets import TicketMachine
from evopolicy_gateway.workspace.agents_md import Urls


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


async def _serve(folder: RunFolder) -> bool:
    def ready(urls: Urls, pipeline: SubmitPipeline) -> None:
        opened = pipeline.machine.run
        why = f"--video {opened.video}: {opened.env.env} does not render; there are no videos"
        notes = (why,) if opened.video != "off" and not opened.env.renders else ()
        held_s, permit_s = round(pipeline.machine.held_s, 3), round(gateway.permit_s, 3)
        variables = urls.environment()
        child_messages.emit(Ready(variables=variables, notes=notes, held_s=held_s, permit_s=permit_s))

    def changed(pipeline: SubmitPipeline) -> None:
        child_messages.emit(progress_of(pipeline.machine))

    last_wait = ""

    def waits(what: str) -> None:
        nonlocal last_wait
        if what != last_wait:
            last_wait = what
            child_messages.emit(Waits(waits_for=what))

    gateway = Gateway(folder, on_ready=ready, on_change=changed, on_wait=waits)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, gateway.tell, None)
    listener = asyncio.create_task(_listen(gateway))
    try:
        return await gateway.run()
    finally:
        listener.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await listener


async def _listen(gateway: Gateway) -> None:
    orders = Orders()
    while (order := await orders.next()) is not None:
        if isinstance(order, child_messages.CloseGateway):
            gateway.tell(order)
    gateway.tell(None)


def progress_of(machine: TicketMachine) -> TrainProgress:
    """A run in the operator's live view."""
    settled = [ticket for ticket in machine.tickets if ticket.status is not None]
    means = [ticket.mean_return for ticket in settled if ticket.mean_return is not None]
    running, last = machine.in_flight, settled[-1] if settled else None
    return TrainProgress(
        episode_budget=machine.run.episode_budget,
        remaining_budget=machine.state.remaining_budget,
        n_submits=machine.state.n_submits,
        n_rejected=machine.n_rejected,
        submit_id=running.submit_id if running else None,
        n_episodes=running.n_episodes if running else 0,
        n_done=running.n_done if running else 0,
        waits_for=running.waits_for if running else "",
        last_submit_id=last.submit_id if last else None,
        last_status=last.status if last else None,
        last_mean=last.mean_return if last else None,
        best_mean=max(means, default=None),
        in_flight_s=round(machine.in_flight_s, 3),
        feedback_s=round(machine.feedback_s, 3),
        held_s=round(machine.held_s, 3),
        spent=machine.spent,
        cancelled=machine.cancelled,
    )


if __name__ == "__main__":
    setup_logging()
    with _failures_in_the_log():
        closed = asyncio.run(_serve(folder_of(Path(sys.argv[1]))))
    sys.stdout.flush()
    # A thread that still reads stdin, or a session that cannot be closed, must not hold up the exit.
    os._exit(0 if closed else 3)
