"""Writes Harbor tasks of open runs (`run --agent remote`), and answers their verifiers with the runs' scores.

- Harbor starts the agent in a container, with the run's workspace as its working directory and the run's bearer
  token in its environment. Its verifier runs `tests/test.sh` in a container of its own after the agent's container
  has been stopped: the agent has ended then and cannot write the reward.
- A verifier's request reports the end of its run's agent, as `evopolicy finish` does, and gets the score once it is
  there.
- Every request needs its task's token, which only the task's `tests/` have: Harbor's verifier gets them, its agent does
  not.
- Nothing but a run's score is told, and only after the run is finished.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from evopolicy_common.cli.conventions import end_on_sigterm, fail_on_our_errors, run_to_end
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError, EvopolicyError, raised_as
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import say
from evopolicy_common.wire.http import bound, serving
from evopolicy_gateway.harnesses.coding_agents.codex import toml
from evopolicy_gateway.run_folder.layout import RunFolder, folder_of, saved
from evopolicy_gateway.run_folder.listener import TOKEN_VARIABLE, Listener, finish, listener_of
from evopolicy_gateway.workspace.agents_md import base_url
from evopolicy_gateway.workspace.prompts import FIRST

WORKDIR = "/work"
"""The workspace in the container."""
VERIFIER_S = 24 * 3600.0
"""Time for the hidden episodes of a run after its agent's end."""
_ODD = re.compile(r"[^A-Za-z0-9._-]+")

_INSTRUCTION = f"""\
Your working directory is `{WORKDIR}`. {FIRST}
"""
_DOCKERFILE = f"""\
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends ca-certificates curl git && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir numpy
WORKDIR {WORKDIR}
"""
_TEST = """\
#!/bin/sh
# Ends the run, and waits for its score, which is the reward.
while :; do
    status=$(curl -sS -m 60 -X POST -H 'Authorization: Bearer {token}' -o /tmp/score -w '%{{http_code}}' '{url}')
    case "$status" in
        200) mkdir -p /logs/verifier && cp /tmp/score /logs/verifier/reward.txt && exit ;;
        # A busy service answers 503, and other agents can reach it: their requests must not cost this run its reward.
        202 | 000 | 502 | 503 | 504) sleep 2 ;;
        *) cat /tmp/score >&2; exit 1 ;;
    esac
done
"""


def task_name(folder: RunFolder) -> str:
    """The name of a run's task, from the path of its folder."""
    words = (_ODD.sub("-", word).strip("-._") for word in folder.root.parts[-3:])
    return "-".join(filter(None, words)).lower()


def task_files(folder: RunFolder, *, env: str, url: str, token: str, agent_s: float) -> Mapping[str, str]:
    """The task's files by path. `url`, `token`: where its verifier gets the score; `agent_s`: the agent's time,
    seconds."""
    name = task_name(folder)
    # A `$` begins a variable in such a file.
    source = str(folder.workspace).replace("$", "$$")
    volumes = [
        {"type": "bind", "source": source + part, "target": WORKDIR + part, "read_only": part != ""}
        for part in ("", "/feedback", "/AGENTS.md")
    ]
    bearer = folder.bearer.read_text().strip()
    # With such a file, Harbor's Docker passes `env` of task.toml to Compose and not to the container.
    service = {"volumes": volumes, "environment": {TOKEN_VARIABLE: bearer}}
    task = f"""\
schema_version = "1.4"

[task]
name = "evopolicy/{name}"
description = {toml(f"Improve a policy for {env}; the reward is its mean return on hidden cases.")}

[metadata]
env = {toml(env)}
run = {toml(str(folder.root))}

[environment]
env = {{ {TOKEN_VARIABLE} = "{bearer}" }}

[agent]
timeout_sec = {agent_s}

[verifier]
environment_mode = "separate"
timeout_sec = {VERIFIER_S}
"""
    return {
        "task.toml": task,
        "instruction.md": _INSTRUCTION,
        "environment/Dockerfile": _DOCKERFILE,
        # JSON is YAML.
        "environment/docker-compose.yaml": json.dumps({"services": {"main": service}}, indent=2) + "\n",
        "tests/test.sh": _TEST.format(url=url, token=token),
    }


def write_task(tasks: Path, run: Path, url: str, agent_s: float) -> Path:
    """Writes the task of an open run; `url`: of the scores. Raises ConfigError for any other folder."""
    folder = folder_of(run)
    if not folder.bearer.exists():
        raise ConfigError(
            f"{folder.root} is no open run of a remote agent; start one with `evopolicy run --agent remote --http"
            " HOST:PORT`"
        )
    place = tasks / task_name(folder)
    if (place / "task.toml").exists():
        other = _run_of(place / "task.toml").root
        if other.resolve() != folder.root.resolve():
            raise ConfigError(f"{place} is already the task of {other}; name another folder with --tasks")
    env = saved(folder.intended, CreateRun).settings.env
    files = task_files(
        folder, env=env, url=f"{url}/{place.name}", token=token_of(tasks, place.name), agent_s=agent_s
    )
    for name, text in files.items():
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        # The files hold the tokens of agent and verifier.
        write_atomically(path, text.encode(), mode=0o700 if path.suffix == ".sh" else 0o600)
    return place


def token_of(tasks: Path, task: str) -> str:
    """The token of a task in a folder, which stays the same when it is served again. Other tasks have others."""
    path = tasks / ".token"
    if not path.exists():
        tasks.mkdir(parents=True, exist_ok=True)
        write_atomically(path, f"{secrets.token_hex(32)}\n".encode(), mode=0o600)
    return hmac.digest(path.read_bytes().strip(), task.encode(), "sha256").hex()


def tasks_in(tasks: Path) -> dict[str, RunFolder]:
    """The run of each task in a folder. Raises ConfigError when a task cannot be read."""
    return {path.parent.name: _run_of(path) for path in sorted(tasks.glob("*/task.toml"))}


def _run_of(path: Path) -> RunFolder:
    try:
        return RunFolder(Path(tomllib.loads(path.read_text("utf-8"))["metadata"]["run"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{path}: not a task of `evopolicy harbor`: {error}; choose another folder with --tasks"
        ) from error


def make_app(runs: Mapping[str, RunFolder], tasks: Path) -> Starlette:
    """The service of the scores: `POST /TASK`."""

    async def answer(request: Request) -> Response:
        given, task = request.headers.get("authorization", ""), request.path_params["task"]
        folder = runs.get(task)
        if not hmac.compare_digest(given.encode(), f"Bearer {token_of(tasks, task)}".encode()):
            text, status = "wrong or missing token", 401
        elif folder is None:
            text, status = "no such task", 404
        else:
            try:
                text, status = _score(folder)
            except (EvopolicyError, OSError) as error:
                text, status = str(error), 409
        return PlainTextResponse(f"{text}\n", status)

    return Starlette(routes=[Route("/{task}", answer, methods=["POST"])])


def _score(folder: RunFolder) -> tuple[str, int]:
    """Text and status of the answer."""
    if not folder.run_json.exists():
        try:
            finish(folder)
        except (ConfigError, OSError):
            # The run may have ended since: its gateway's files are removed after run.json is written.
            if not folder.run_json.exists():
                raise
        return "the run is being scored", 202
    outcome = read_record(folder.root).outcome
    if outcome.score is None:
        return f"the run {folder.root} has no score: {outcome.error or in_words(outcome.status)}", 409
    return repr(outcome.score), 200


app = App()


@app.command(
    "harbor",
    epilog="Example: evopolicy harbor runs/theirs/gym_acrobot/first --http 10.0.0.5:8090",
)
def harbor(
    http: Annotated[
        str,
        typer.Option(metavar="HOST:PORT", help="Address of this machine for verifiers."),
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
        typer.Option(metavar="URL", help="URL for verifiers, if not that of --http, such as a TLS proxy's."),
    ] = None,
    agent_s: Annotated[float, typer.Option(min=1.0, help="Time of the agent in Harbor, seconds.")] = 86400.0,
) -> None:
    """Write a Harbor task for each open run of a remote agent, and serve the runs' scores to Harbor's verifiers until
    Ctrl-C.

    The same --tasks and --http serve the same tasks again. A task is one run, so Harbor can play it once.
    """
    with fail_on_our_errors():
        run_to_end(_serve(listener_of(http, http_url), runs or [], tasks, agent_s))


async def _serve(listener: Listener, runs: list[Path], tasks: Path, agent_s: float) -> None:
    end_on_sigterm()
    with raised_as(ConfigError, "--http: cannot listen there", OSError):
        sock = bound(listener.host, listener.port)
    url = listener.url or base_url(listener.host, sock.getsockname()[1])
    for run in runs:
        say(f"written: {write_task(tasks, run, url, agent_s)}")
    known = tasks_in(tasks)
    if not known:
        raise ConfigError(f"{tasks} has no tasks; name open runs, such as runs/theirs/gym_acrobot/first")
    async with serving(make_app(known, tasks), sock) as task:
        command = f"harbor run --path {tasks} --agent AGENT --model MODEL"
        say(f"scores are served at {url}; next, in another terminal: {command}")
        await task
