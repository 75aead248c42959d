"""`evopolicy harbor`: open runs of remote agents as Harbor tasks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evopolicy_common.cli.conventions import end_on_sigterm, fail_on_our_errors, run_to_end
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError
from evopolicy_common.terminal import say
from evopolicy_common.wire.http import bound, serving
from evopolicy_gateway.harbor.scores import make_app, tasks_in, token_of, write_task
from evopolicy_gateway.run_folder.listener import Listener, listener_of
from evopolicy_gateway.workspace.agents_md import base_url

app = App()


@app.command(
    "harbor",
    epilog="Example: evopolicy harbor runs/theirs/gym_acrobot/first --http 10.0.0.5:8090",
)
def harbor(
    http: Annotated[
        str,
        typer.Option(metavar="HOST:PORT", help="Address of this machine at which verifiers get scores."),
    ],
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of open runs with --agent remote; default: those of the tasks.", show_default=False
        ),
    ] = None,
    tasks: Annotated[Path, typer.Option(help="Folder for the tasks.")] = Path("harbor-tasks"),
    http_url: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="URL for verifiers, if it differs from --http, such as that of a TLS proxy."
        ),
    ] = None,
    agent_s: Annotated[float, typer.Option(min=1.0, help="Time of the agent in Harbor, seconds.")] = 86400.0,
) -> None:
    """Write a Harbor task for each open run of a remote agent, and serve the runs' scores to Harbor's verifiers until
    Ctrl-C.

    Called again with the same --tasks and --http, it serves the same tasks. A task is one run, so Harbor can play it
    once.
    """
    with fail_on_our_errors():
        run_to_end(_serve(listener_of(http, http_url), runs or [], tasks, agent_s))


async def _serve(listener: Listener, runs: list[Path], tasks: Path, agent_s: float) -> None:
    end_on_sigterm()
    try:
        sock = bound(listener.host, listener.port)
    except OSError as error:
        raise ConfigError(f"--http: cannot listen there: {error.strerror or error}") from error
    url = listener.url or base_url(listener.host, sock.getsockname()[1])
    for run in runs:
        say(f"written: {write_task(tasks, run, url, agent_s)}")
    known = tasks_in(tasks)
    if not known:
        raise ConfigError(f"{tasks} has no tasks; name open runs, such as runs/theirs/gym_acrobot/first")
    async with serving(make_app(known, token_of(tasks)), sock) as task:
        say(
            f"scores are served at {url}; next, in another terminal: harbor run --path {tasks} --agent AGENT --model"
            " MODEL"
        )
        await task
