"""Clusters, which play policies on train cases and whole runs."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import importlib.util
import os
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Mapping
from pathlib import Path
from typing import Any, Self, TypeVar, Unpack

from rich.progress import Progress

from evopolicy._arguments import OPTIONS, AnyPath, RunKeywords, check_argument, check_names, taken
from evopolicy._evaluation import Episode, Evaluation, episode_of
from evopolicy._functions import agent_of, name_of, policy_of
from evopolicy._loop import awaited, call, loop, twins
from evopolicy._runs import Run, read_run
from evopolicy_common.console import terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import unless_failed
from evopolicy_common.messages.episode import EpisodeOutcome, ResourceLimits, Tier
from evopolicy_common.messages.operator import Evaluate
from evopolicy_common.processes.packages import policy_versions
from evopolicy_common.processes.preflight import check_installed
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_gateway import shipped
from evopolicy_gateway.agents.function import Workspace
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.operator import cluster as operator
from evopolicy_gateway.operator.trials import evaluation, policy_bundle
from evopolicy_gateway.run import run_options
from evopolicy_gateway.run.lifecycle import RunLifecycle
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.run_options import one_environment, packages_for
from evopolicy_gateway.run.watch import RunView
from evopolicy_gateway.run_folder.listener import Listener

T = TypeVar("T")

AgentFunction = Callable[[Workspace], Any]
PolicyFunction = Callable[[Any], Any]
"""Returns the action for an observation."""
Limits = Mapping[str, float]
Trial = tuple[Bundle, Evaluate]
"""A policy, and the order to play it on train cases."""


class Cluster:
    """A coordinator with workers: temporary on this machine (`Cluster.local`) or already running (`Cluster.connect`).

    A context manager for `with` and `async with`; notebooks can use `open()` and `close()`. Several threads or tasks
    may call it at once. A cluster opens once: a second `open` raises ConfigError, and so does a call before it is open.
    """

    def __init__(self, where: operator.ChosenCluster) -> None:
        """Private: use `Cluster.local` or `Cluster.connect`."""
        self._where = where
        self._reached: operator.Reached | None = None
        self._end = asyncio.Event()
        self._held: asyncio.Task[None] | None = None
        self._offered: set[str] = set()
        self._offering = asyncio.Lock()

    @classmethod
    def local(
        cls,
        slots: int = 2,
        *,
        state: str | os.PathLike[str] | None = None,
        fresh: bool = False,
        data: str | os.PathLike[str] | None = None,
        policy_packages: Iterable[str] = (),
    ) -> Cluster:
        """Describes a cluster on this machine, which runs inside the `with`; starts nothing before that.

        `slots`: episodes played at once for each environment, at least 1. `state`: folder of the cluster's stored
        state, by default the folder that all local commands share, so that equal ids name equal cases. `fresh`: use a
        temporary state, deleted at the end. `data`: folder of split files. `policy_packages`: installed packages that
        policies may import besides numpy, such as `("scipy",)`. Raises ConfigError for wrong
        arguments, and for `fresh` together with `state`.
        """
        given = taken(slots=slots, state=state, fresh=fresh, data=data, policy_packages=policy_packages)
        if fresh and state is not None:
            raise ConfigError(f"fresh and state {given['state']}: give only one of them")
        if (folder := given["data"]) is not None and not folder.is_dir():
            raise ConfigError(f"data {folder} is not a folder: give one that `evopolicy data make` wrote")
        policy_versions(given["policy_packages"])
        chosen = run_options.ClusterOptions(
            slots=given["slots"],
            state=None if fresh else given["state"] or local_state_dir(),
            data=given["data"],
            policy_package=list(given["policy_packages"]),
        )
        return cls(operator.ChosenCluster(local=chosen))

    @classmethod
    def connect(cls, *endpoints: str, credentials: str | os.PathLike[str] | None = None) -> Cluster:
        """Describes a running cluster, such as `Cluster.connect("tls/host:7447", credentials="operator-me")`.

        `credentials`: the folder written by `evopolicy-coordinator certs issue operator`. Without arguments it is the
        cluster of this machine.
        """
        connect = tuple(check_argument("endpoint", endpoint) for endpoint in endpoints)
        return cls(operator.ChosenCluster(connect=connect, file=check_argument("credentials", credentials)))

    def open(self) -> Self:
        """Starts or connects to the cluster, for notebooks. `close` ends it, and so does the end of the process."""
        call(self._open())
        atexit.register(self.close)
        return self

    def close(self) -> None:
        """Ends the processes and connections of `open`. A second call does nothing."""
        atexit.unregister(self.close)
        call(self._close())

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        await awaited(self._open())
        return self

    async def __aexit__(self, *_: object) -> None:
        await awaited(self._close())

    async def _evaluate(
        self,
        policy: AnyPath | PolicyFunction,
        *,
        env: str,
        cases: Iterable[int] = range(4),
        tier: Tier = "bwrap",
        limits: Limits | None = None,
        progress: bool = True,
    ) -> Evaluation:
        """Plays the policy in a folder on train cases, in a sandbox, outside any run and without a budget.

        `policy`: a folder with a `policy.py`, or a function of an observation that returns an action. The function is
        sent by value, with its own module, and begins each episode anew; it can import the standard library, numpy, and
        `policy_packages`. `env`: an environment's id, such as `gym/acrobot`. `cases`: train ids;
        equal ids name equal cases in every call on the same state. `tier`: sandbox tier, `bwrap`, `landlock` or `none`.
        `limits`: of the policy, such as `{"act_wall_s": 5}`. `progress`: show a progress bar on a terminal, or in a
        notebook with ipywidgets.

        Raises ConfigError, with the remedy, for wrong arguments and for missing requirements on this machine.
        """
        trial = await asyncio.to_thread(trial_of, policy, env, cases, tier, limits)
        return await self._evaluated(trial, check_argument("progress", progress))

    async def _run(
        self,
        *,
        env: str,
        agent: str | AgentFunction,
        progress: bool = True,
        **options: Unpack[RunKeywords],
    ) -> Run:
        """Plays one run on this cluster; arguments as for `evopolicy.run` without `slots` and `policy_packages`."""
        check_argument("progress", progress)
        with contextlib.ExitStack() as stack:
            plan = await self._planned(stack, env, agent, options)
            return await self._play(plan, progress)

    evaluate, evaluate_async = twins(_evaluate)
    run, run_async = twins(_run)

    # The methods that begin with an underscore run on the package's event loop.

    async def _open(self) -> None:
        if self._held is not None:
            raise ConfigError("this cluster is open already, or was closed: make another")
        opened: asyncio.Future[operator.Reached] = loop().create_future()
        # One task enters and exits all context managers, because callers may use different tasks or threads.
        self._held = asyncio.create_task(self._hold(opened))
        try:
            both: list[asyncio.Future[Any]] = [opened, self._held]
            await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            await self._close()
            raise
        if not opened.done():
            await self._held
        self._reached = opened.result()

    async def _hold(self, opened: asyncio.Future[operator.Reached]) -> None:
        async with operator.reached(self._where) as reached:
            opened.set_result(reached)
            await self._end.wait()

    async def _close(self) -> None:
        self._reached = None
        self._end.set()
        if self._held is not None:
            await asyncio.wait([self._held])

    async def _on(
        self, env: str, tier: Tier, work: Callable[[operator.Reached], Coroutine[Any, Any, T]]
    ) -> T:
        """Returns the result of `work`; raises the local cluster's error when the cluster fails first."""
        reached = self._reached
        if reached is None:
            raise ConfigError("this cluster is not open: use it inside `with Cluster.local() as cluster:`")
        if reached.local is not None and self._where.local is not None:
            async with self._offering:
                if env not in self._offered:
                    await reached.local.start_workers([env], slots=self._where.local.slots, tiers={tier})
                    self._offered.add(env)
        failed = None if reached.local is None else reached.local.failed
        return await unless_failed(asyncio.create_task(work(reached)), failed)

    async def _evaluated(self, trial: Trial, progress: bool) -> Evaluation:
        bundle, message = trial
        env, cases = message.env, message.cases or ()

        async def work(reached: operator.Reached) -> Evaluation:
            await reached.operations.upload(bundle.digest, bundle.packed)
            outcomes: list[EpisodeOutcome] = []
            with _bar(progress) as bar:
                task = bar.add_task(env, total=len(cases))
                async for outcome, _, _ in reached.operations.evaluate(message):
                    if outcome is not None:
                        outcomes.append(outcome)
                        bar.update(task, completed=len(outcomes))
            episodes: list[Episode] = []
            for outcome, case in zip(sorted(outcomes, key=lambda one: one.index), cases, strict=True):
                ref = outcome.trajectory
                packed = None if ref is None else await reached.operations.fetch(ref)
                episodes.append(await asyncio.to_thread(episode_of, case, outcome, packed))
            return Evaluation(env, episodes)

        return await self._on(env, message.sandbox_tier, work)

    async def _planned(
        self, stack: contextlib.ExitStack, env: str, agent: str | AgentFunction, options: RunKeywords
    ) -> Plan:
        """The checked plan of a run; `stack` holds the folder of an agent's function."""
        check_installed("gateway")
        check_argument("agent", agent)
        if callable(agent):
            options = {**options, "entry": options.get("entry") or name_of(agent)}
            folder = stack.enter_context(scratch_folder("function"))
            agent = await asyncio.to_thread(agent_of, agent, folder / "function.pickle")
        plan = plan_of(env, agent, **options)
        self._where.check_cases([plan.settings])
        await asyncio.to_thread(plan.check)
        return plan

    async def _play(
        self, plan: Plan, progress: bool, started: Callable[[RunLifecycle], None] = lambda _: None
    ) -> Run:
        """Plays a run; `started` is called before its first step."""

        async def work(reached: operator.Reached) -> Run:
            with RunView(terminal(stderr=True) if progress else None).shown() as watch:
                lifecycle = RunLifecycle(plan, reached.operations, reached.gateway, watch)
                started(lifecycle)
                await lifecycle.play_run()
            return await asyncio.to_thread(read_run, plan.folder.root)

        return await self._on(plan.settings.env, plan.settings.sandbox_tier, work)


def trial_of(
    policy: AnyPath | PolicyFunction, env: str, cases: Iterable[int], tier: Tier, limits: Limits | None
) -> Trial:
    """Reads the policy; arguments as for `evaluate`. Raises ConfigError."""
    given = taken(policy=policy, env=env, cases=cases, tier=tier, limits=limits)
    if not given["cases"]:
        raise ConfigError("cases is empty: name train ids, such as range(8)")
    env = one_environment(env)
    folder = given["policy"]
    bundle = policy_of(folder) if callable(folder) else policy_bundle(shipped.found(folder, Path.cwd()))
    return bundle, evaluation(env, bundle, given["cases"], tier, given["limits"] or ResourceLimits())


def plan_of(
    env: str, agent: str, *, listener: Listener | None = None, agent_host: str = "", **options: object
) -> Plan:
    """The plan of a run; arguments as for `run`, and for an agent that is started elsewhere as in `Plan`. Raises
    ConfigError."""
    check_names(options, OPTIONS.keys() - {"agent"})
    env = one_environment(check_argument("env", env))
    given = run_options.RunOptions(
        agent=agent, **{name: value for name, value in taken(**options).items() if value is not None}
    )
    jail = JailSettings() if listener is None else JailSettings(mode="none")
    (plan,) = given.plans([env], jail, agent_host, listener)
    return plan


async def _evaluate(
    policy: AnyPath | PolicyFunction,
    *,
    env: str,
    cases: Iterable[int] = range(4),
    slots: int = 2,
    tier: Tier = "bwrap",
    limits: Limits | None = None,
    progress: bool = True,
    policy_packages: Iterable[str] = (),
) -> Evaluation:
    """Plays a policy on train cases on a local cluster: `Cluster.evaluate`, which describes the arguments.

    `env`: an environment's id; `evopolicy envs` and docs/reference/environments.md list them. `cases`: train ids, by
    default 0 to 3; one id is one episode. `policy_packages`: as for `Cluster.local`; a policy in a run's directory by
    default gets the packages of its run.

    The call costs no budget and asks no model. It starts a coordinator and a worker and ends them, which takes a few
    seconds: for several calls, open one `Cluster.local`. `slots` episodes are played at once, each on one core.
    """
    trial = await asyncio.to_thread(trial_of, policy, env, cases, tier, limits)
    given = taken(policy=policy, progress=progress, policy_packages=policy_packages)
    names: Iterable[str] = given["policy_packages"]
    if isinstance(given["policy"], Path):
        names = packages_for(shipped.found(given["policy"], Path.cwd()), tuple(names))
    async with _opened(Cluster.local(slots, policy_packages=names)) as cluster:
        return await cluster._evaluated(trial, progress)


async def _run(
    *,
    env: str,
    agent: str | AgentFunction,
    slots: int = 2,
    policy_packages: Iterable[str] = (),
    progress: bool = True,
    **options: Unpack[RunKeywords],
) -> Run:
    """Plays one whole run, up to its score, on a local cluster.

    `env`: an environment's id, such as `gym/acrobot`. `agent`: a function of one `Workspace`, or a text as for
    `--agent` of `evopolicy run`. A function runs in its own process in the agent's jail, where it can import the
    standard library and numpy; its own module is sent with it. It returns a JSON-serialisable value, which `Run.value`
    reads back. `slots`, `policy_packages`: as for `Cluster.local`. `progress`: show the run's progress. `options`: as
    in `RunOptions`, such as `budget` (train episodes) and `exp_id`.

    The run plays `budget` train episodes at most, then the hidden validation cases for each submit, and the hidden
    held-out cases for the selected checkpoint and for random actions. An agent with a model also costs what its calls
    cost; `run.json` records it, and `prices` limits it.

    Raises ConfigError, with the remedy, for wrong arguments and for missing requirements on this machine. Ctrl-C
    cancels the run, and its folder records that.
    """
    check_argument("progress", progress)
    cluster = Cluster.local(slots, policy_packages=policy_packages)
    with contextlib.ExitStack() as stack:
        # Before the cluster is opened: a wrong argument starts no process.
        plan = await cluster._planned(stack, env, agent, options)
        async with _opened(cluster):
            return await cluster._play(plan, progress)


evaluate, evaluate_async = twins(_evaluate)
run, run_async = twins(_run)


@contextlib.asynccontextmanager
async def _opened(cluster: Cluster) -> AsyncIterator[Cluster]:
    await cluster._open()
    try:
        yield cluster
    finally:
        await cluster._close()


def _bar(wanted: bool) -> Progress:
    console = terminal(stderr=True)
    widgets = console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
    shown = wanted and (console.is_terminal or widgets)
    return Progress(console=console, transient=True, disable=not shown)
