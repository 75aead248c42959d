"""Tasks for Inspect: `inspect eval evopolicy/core16 --model …`. Inspect's model and solver are the agent; budget,
hidden cases and score are those of a run of ours.

Each sample is one run. The task's setup opens it, and its scorer closes it. Meanwhile an agent counts as alive on this
machine, so no hidden case of the run is played here. The model works through tools that read the workspace, write the
policy and submit it; it runs no program on this machine.

Inspect finds this module through the entry point `inspect_ai`, and reads the types and docstrings of the tools.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import anyio.to_thread
import inspect_ai
from inspect_ai import Task, task
from inspect_ai._util.error import PrerequisiteError
from inspect_ai.dataset import Sample
from inspect_ai.model import ChatMessageUser, get_model
from inspect_ai.model._model import sample_model_usage
from inspect_ai.scorer import Score, Target, grouped, mean, scorer
from inspect_ai.solver import Generate, Solver, TaskState, solver
from inspect_ai.tool import Tool, ToolError, tool
from inspect_ai.util import store
from rich.text import Text

from evopolicy._cluster import Cluster, plan_of
from evopolicy._loop import awaited
from evopolicy._runs import Run
from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, EvopolicyError, raised_as
from evopolicy_common.processes import proc
from evopolicy_common.records.words import in_words
from evopolicy_gateway.agents.client import Client, GatewayError, RefusedSubmit
from evopolicy_gateway.harnesses.coding_agents import session
from evopolicy_gateway.relay.usage import Usage
from evopolicy_gateway.run.lifecycle import RunLifecycle
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.run_options import default_exp_id
from evopolicy_gateway.run_folder import listener
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.run_folder.listener import Listener
from evopolicy_gateway.workspace.prompts import Prompts

_KEY = "evopolicy_run"
"""Name in a sample's store: the run's folder."""
_TOKEN_TABLE = "o200k_base"
_REMINDERS = 8
_MAX_READ = 20_000
_MAX_WRITTEN = 1 << 20
_MAX_LISTED = 500
_MAX_PATH = 500
"""Characters. Python makes nested folders recursively."""
_PROMPT = """\
Improve a policy. The rules below describe files and HTTP requests; you have tools instead: list_files and read_file for the
workspace, write_file for files below system/, and submit_episodes for POST /submit. There is no shell.

# AGENTS.md

{rules}

# The task (GET /task)

{task}
"""  # noqa: E501


class _Live(NamedTuple):
    """A run whose agent is at work."""

    folder: RunFolder
    client: Client
    playing: asyncio.Task[Run]


_live: dict[str, _Live] = {}
"""Runs of this process by their folders. A sample's store holds the folder only, because Inspect writes it to its
log."""
Where = tuple[str | None, str | None, int, str | None]
"""Endpoint and credentials of a running cluster, or two None; slots and state folder of a local one."""
_clusters: dict[Where, Cluster] = {}
"""Open clusters, each for all samples that name it; they close with the process."""
_opening = threading.Lock()


@task
def core16(
    budget: int | None = None,
    connect: str | None = None,
    credentials: str | None = None,
    slots: int = 2,
    state: str | None = None,
    validation: int | None = None,
    heldout: int | None = None,
    runs: str = "runs",
    exp_id: str | None = None,
    entry: str | None = None,
) -> Task:
    """The sixteen environments of Core16; parameters as for `environments`."""
    options = {"budget": budget, "validation": validation, "heldout": heldout, "runs": runs}
    return _task(["core16"], (connect, credentials, slots, state), options, exp_id, entry)


@task
def environments(
    envs: str | list[str],
    budget: int | None = None,
    connect: str | None = None,
    credentials: str | None = None,
    slots: int = 2,
    state: str | None = None,
    validation: int | None = None,
    heldout: int | None = None,
    runs: str = "runs",
    exp_id: str | None = None,
    entry: str | None = None,
) -> Task:
    """Environments of your choice, one sample each.

    Args:
        envs: Ids, globs or suites, such as `gym/acrobot`, separated by commas.
        budget: Train episodes; by default those of the environment's suite.
        connect: Endpoint of a running cluster, such as `tls/host:7447`; by default a local one is started.
        credentials: Folder of the operator's credentials for `connect`.
        slots: Episodes that a local cluster plays at once, for each environment.
        state: Folder of a local cluster's state; by default the one of all local commands.
        validation: Hidden validation cases; by default the suite's.
        heldout: Hidden held-out cases; by default the suite's.
        runs: Folder of the run directories.
        exp_id: Name of the experiment; by default the time.
        entry: Leaderboard entry; by default the model's name with `(Inspect)`.
    """
    patterns = envs.split(",") if isinstance(envs, str) else envs
    options = {"budget": budget, "validation": validation, "heldout": heldout, "runs": runs}
    return _task(patterns, (connect, credentials, slots, state), options, exp_id, entry)


def _task(
    patterns: list[str], where: Where, options: dict[str, Any], exp_id: str | None, entry: str | None
) -> Task:
    try:
        dataset = [Sample(id=env, input=env, metadata={"env": env}) for env in catalogue.resolve(patterns)]
        _check_token_table()
        _cluster(where)
    except EvopolicyError as error:
        # Inspect ends with this line. An error in a sample has a traceback, and `inspect eval` exits with 0.
        text = str(error).replace("with state", "with -T state=FOLDER")
        raise PrerequisiteError(Text(f"error: {text}")) from error
    return Task(
        dataset=dataset,
        setup=open_run(where, options, exp_id or default_exp_id(), entry),
        solver=improve(),
        scorer=heldout_return(),
        cleanup=_clean_up,
    )


def _check_token_table() -> None:
    """Raises ConfigError where Inspect's mock model cannot download the table with which it counts tokens."""
    if get_model().api.__class__.__name__ != "MockLLM":
        return
    import tiktoken

    try:
        tiktoken.get_encoding(_TOKEN_TABLE)
    except OSError as error:
        raise ConfigError(
            "Inspect's mock model counts tokens with a table that cannot be downloaded here."
            " Where there is a network, run:"
            f" TIKTOKEN_CACHE_DIR=tokens python -c \"import tiktoken; tiktoken.get_encoding('{_TOKEN_TABLE}')\";"
            " copy the folder tokens to this machine, and set TIKTOKEN_CACHE_DIR to its path"
        ) from error


@solver
def open_run(where: Where, options: dict[str, Any], exp_id: str, entry: str | None) -> Solver:
    """Opens the sample's run, and gives its tools and rules to the agent."""
    attempts: dict[tuple[int | str, int], Iterator[int]] = {}

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        # A sample that Inspect tries again has a run directory already.
        attempt = next(attempts.setdefault((state.sample_id, state.epoch), itertools.count()))
        plan = plan_of(
            state.metadata["env"],
            listener.AGENT,
            listener=Listener(host="127.0.0.1", port=0),
            agent_host=proc.boot_id(),
            exp_id=f"{exp_id}-{state.epoch}" + (f".{attempt}" if attempt else ""),
            entry=entry or f"{get_model()} (Inspect)",
            model=str(get_model()),
            repeat=state.epoch - 1,
            **options,
        )
        cluster = await anyio.to_thread.run_sync(_cluster, where)
        live = await awaited(_begin(cluster, plan))
        _live[str(live.folder.root)] = live
        store().set(_KEY, str(live.folder.root))
        text = await anyio.to_thread.run_sync(live.client.task)
        state.user_prompt.text = _PROMPT.format(rules=live.folder.agents_md.read_text(), task=text)
        state.tools = [*state.tools, list_files(), read_file(), write_file(), submit_episodes()]
        return state

    return solve


@solver
def improve(reminders: int = _REMINDERS) -> Solver:
    """The default agent: the model calls tools until it stops, and is reminded while budget is left.

    Args:
        reminders: Maximum number of reminders.
    """

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        for count in itertools.count():
            state = await generate(state)
            remaining = await anyio.to_thread.run_sync(_remaining)
            if remaining == 0 or state.completed or count == reminders:
                return state
            state.messages.append(ChatMessageUser(content=Prompts().stopped(remaining)))
        raise AssertionError("the count has no end")

    return solve


@scorer(metrics=[grouped(mean(), "env", all=False)])
def heldout_return() -> Callable[[TaskState, Target], Awaitable[Score]]:
    """Mean return of the selected checkpoint on the hidden held-out cases; NaN for a run without an ok submit."""

    async def score(state: TaskState, target: Target) -> Score:
        live = _of_sample()
        _count(live)
        run = await awaited(_end(live))
        del _live[str(live.folder.root)]
        summary = run.summary
        names = ("status", "best_submit", "budget_used", "random_score", "run")
        return Score(
            value=float("nan") if run.score is None else run.score,
            explanation=f"{in_words(summary.status)}; run directory {live.folder.root}",
            metadata={name: getattr(summary, name) for name in names},
        )

    return score


async def _clean_up(state: TaskState) -> None:
    """Cancels the run of a sample that ended before it was scored."""
    live = _live.pop(state.store.get(_KEY, ""), None)
    if live is not None:
        _count(live)
        await awaited(_cancelled(live.playing))


@tool
def list_files() -> Tool:
    async def execute() -> str:
        """Lists the files of the workspace with their sizes in bytes."""
        root = _of_sample().folder.workspace
        files = sorted(path for path in root.rglob("*") if path.is_file())
        lines = [f"{path.relative_to(root)} {path.stat().st_size}" for path in files[:_MAX_LISTED]]
        more = [f"… {len(files) - _MAX_LISTED} more"] if len(files) > _MAX_LISTED else []
        return "\n".join(lines + more)

    return execute


@tool
def read_file() -> Tool:
    async def execute(path: str, offset: int = 0) -> str:
        """Reads at most 20,000 bytes of a text file of the workspace.

        Args:
            path: Path relative to the workspace, such as feedback/submit_000/summary.json.
            offset: Bytes to skip.
        """
        place = _inside(path, ".")
        with raised_as(ToolError, path, OSError), place.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            begin = min(max(0, offset), size)
            file.seek(begin)
            data = file.read(_MAX_READ)
            rest = size - begin - len(data)
        text = data.decode("utf-8", "replace")
        return f"{text}\n[{rest} more bytes]" if rest > 0 else text

    return execute


@tool
def write_file() -> Tool:
    async def execute(path: str, content: str) -> str:
        """Writes a file of the policy, and replaces an existing one.

        Args:
            path: Path relative to the workspace, below system/, such as system/policy.py.
            content: The whole new text.
        """
        place = _inside(path, "system")
        if len(content) > _MAX_WRITTEN:
            raise ToolError(f"{path}: {len(content)} characters; at most {_MAX_WRITTEN}")
        with raised_as(ToolError, path, OSError):
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(content, encoding="utf-8", errors="replace")
        return f"wrote {path}"

    return execute


@tool
def submit_episodes() -> Tool:
    async def execute(env_instances: list[int]) -> str:
        """Submits the present policy for one episode on each of these train ids, waits, and returns the summary.

        The episodes are charged to the budget. The feedback is then in the workspace, below feedback/.

        Args:
            env_instances: Train ids, such as [0, 1, 2, 3].
        """
        live = _of_sample()
        _count(live)
        try:
            # Inspect's time limit must not wait for a busy cluster.
            verdict = await anyio.to_thread.run_sync(
                live.client.submit, env_instances, abandon_on_cancel=True
            )
        except GatewayError as error:
            raise ToolError(str(error)) from error
        if isinstance(verdict, RefusedSubmit):
            raise ToolError(f"{verdict.status}: {verdict.message}")
        text = (live.folder.feedback / verdict.name / "summary.json").read_text()
        return f"feedback/{verdict.name}: {verdict.status}\n{text[:_MAX_READ]}"

    return execute


def _of_sample() -> _Live:
    """The run of the sample that the caller belongs to."""
    live = _live.get(store().get(_KEY, ""))
    if live is None:
        raise RuntimeError("this sample has no open run: its task's setup opens one")
    return live


def _count(live: _Live) -> None:
    """Gives the sample's tokens, as Inspect counts them so far, to the run's record."""
    used = {
        model: Usage(
            input_noncached=usage.input_tokens,
            cache_read=usage.input_tokens_cache_read or 0,
            cache_creation=usage.input_tokens_cache_write or 0,
            output=usage.output_tokens,
            reasoning=usage.reasoning_tokens,
        )
        for model, usage in sample_model_usage().items()
    }
    if live.folder.state.exists():  # else the run is over
        version = f"inspect_ai {inspect_ai.__version__}"
        session.save(live.folder.session, session.SessionState(cli_version=version, used=used))


def _inside(path: str, below: str) -> Path:
    """The file of the workspace, with links resolved. Raises ToolError for one that is not below that folder."""
    workspace = _of_sample().folder.workspace.resolve()
    if len(path) > _MAX_PATH:
        raise ToolError(f"the path has {len(path)} characters; at most {_MAX_PATH}")
    try:
        place = (workspace / path).resolve()
    except (OSError, ValueError) as error:
        raise ToolError(f"{path!r} is no path: {error}") from error
    if not place.is_relative_to(workspace / below) or place == workspace / below:
        raise ToolError(f"{path!r} is not below {'the workspace' if below == '.' else f'{below}/'}")
    return place


def _remaining() -> int:
    """Episodes left; 0 once the run is closed."""
    try:
        state = _of_sample().client.info()["state"]
    except GatewayError:
        return 0
    return 0 if state["is_finalized"] else int(state["remaining_budget"])


def _cluster(where: Where) -> Cluster:
    with _opening:
        if where not in _clusters:
            connect, credentials, slots, state = where
            if connect is None and credentials is None:
                cluster = Cluster.local(slots, state=state)
            else:
                cluster = Cluster.connect(*([] if connect is None else [connect]), credentials=credentials)
            _clusters[where] = cluster.open()
        return _clusters[where]


# The functions below run on the package's event loop.


async def _begin(cluster: Cluster, plan: Plan) -> _Live:
    """Opens a run, and waits until its agent may begin."""
    await asyncio.to_thread(plan.check)
    started: asyncio.Future[RunLifecycle] = asyncio.get_running_loop().create_future()
    playing = asyncio.create_task(cluster._play(plan, False, started.set_result))
    try:
        await _first(started, playing)
        served = started.result().served
        await _first(served, playing)
    except asyncio.CancelledError:
        await _cancelled(playing)
        raise
    urls = served.result().variables
    client = Client(
        info_url=urls["EVOPOLICYGYM_INFO_URL"],
        task_url=urls["EVOPOLICYGYM_TASK_URL"],
        submit_url=urls["EVOPOLICYGYM_SUBMIT_URL"],
        token=plan.folder.bearer.read_text().strip(),
    )
    return _Live(plan.folder, client, playing)


async def _first(wanted: asyncio.Future[Any], playing: asyncio.Task[Run]) -> None:
    """Waits for `wanted`; raises the error of the run if that ends first."""
    both: list[asyncio.Future[Any]] = [wanted, playing]
    await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
    if not wanted.done():
        await playing
        raise RuntimeError("the run was cancelled before its agent could begin")


async def _end(live: _Live) -> Run:
    """Reports the agent's end, and waits for the run's score."""
    with contextlib.suppress(FileNotFoundError):  # the run is over already
        live.folder.finish.touch(mode=0o600)
    return await live.playing


async def _cancelled(playing: asyncio.Task[Run]) -> None:
    playing.cancel()
    await asyncio.wait([playing])
