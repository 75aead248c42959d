"""Clusters, which play policies on train cases and whole runs."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import importlib.util
import os
import shlex
import sys
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
from operator import index
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from rich.progress import Progress

from evopolicy._evaluation import Episode, Evaluation, episode_of
from evopolicy._loop import awaited, call, loop
from evopolicy._runs import Run, read_run
from evopolicy_common.console import terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import EpisodeOutcome, Tier
from evopolicy_common.messages.gateway import FeedbackDetail, VideoOption
from evopolicy_common.messages.operator import Evaluate
from evopolicy_common.processes.local_cluster import unless_failed
from evopolicy_common.processes.preflight import check_installed
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_gateway import shipped
from evopolicy_gateway.agents.function import Workspace
from evopolicy_gateway.cli.options import default_exp_id, limits_of, one_environment, packages_for
from evopolicy_gateway.cli.run_options import RunOptions
from evopolicy_gateway.http.listener import Listener
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.operator import cluster as operator
from evopolicy_gateway.operator.trials import policy_bundle
from evopolicy_gateway.operator.watch import RunView
from evopolicy_gateway.run.lifecycle import RunLifecycle
from evopolicy_gateway.run.plan import WALL_S, Plan

T = TypeVar("T")

AgentFunction = Callable[[Workspace], Any]
Limits = Mapping[str, float]


class Cluster:
    """A coordinator with workers: temporary on this machine (`Cluster.local`) or already running (`Cluster.connect`).

    A context manager for `with` and `async with`; notebooks can use `open()` and `close()`. Several threads or tasks
    may call it at once. A cluster opens once: a second `open` raises ConfigError, and so does a call before it is open.
    """

    def __init__(self, where: operator.Cluster) -> None:
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
        policies may import besides numpy, such as `("scipy",)`. Raises ConfigError for `slots` below 1, and for `fresh`
        together with `state`.
        """
        if slots < 1:
            raise ConfigError(f"slots is {slots}: at least 1")
        if fresh and state is not None:
            raise ConfigError(f"fresh and state {os.fspath(state)}: give only one of them")
        kept = None if fresh else Path(state) if state is not None else local_state_dir()
        return cls(
            operator.Cluster(
                local_slots=slots,
                state=kept,
                data=None if data is None else Path(data),
                policy_packages=_names(policy_packages),
            )
        )

    @classmethod
    def connect(cls, *endpoints: str, credentials: str | os.PathLike[str] | None = None) -> Cluster:
        """Describes a running cluster, such as `Cluster.connect("tls/host:7447", credentials="operator-me")`.

        `credentials`: the folder written by `evopolicy-coordinator certs issue operator`. Without arguments it is the
        cluster of this machine.
        """
        return cls(
            operator.Cluster(connect=endpoints, file=None if credentials is None else Path(credentials))
        )

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

    def evaluate(
        self,
        policy: str | os.PathLike[str],
        *,
        env: str,
        cases: Iterable[int] = range(4),
        tier: Tier = "bwrap",
        limits: Limits | None = None,
        progress: bool = True,
    ) -> Evaluation:
        """Plays the policy in a folder on train cases, in a sandbox, outside any run and without a budget.

        `policy`: a folder with a `policy.py`. `env`: an environment's id, such as `gym/acrobot`. `cases`: train ids;
        equal ids name equal cases in every call on the same state. `tier`: sandbox tier, `bwrap`, `landlock` or `none`.
        `limits`: of the policy, such as `{"act_wall_s": 5}`. `progress`: show a progress bar on a terminal, or in a
        notebook with ipywidgets.

        Raises ConfigError, with the remedy, for wrong arguments and for missing requirements on this machine.
        """
        return call(self._evaluate(policy, env, tuple(cases), tier, limits or {}, progress))

    async def evaluate_async(
        self,
        policy: str | os.PathLike[str],
        *,
        env: str,
        cases: Iterable[int] = range(4),
        tier: Tier = "bwrap",
        limits: Limits | None = None,
        progress: bool = True,
    ) -> Evaluation:
        """Async twin of `evaluate`."""
        return await awaited(self._evaluate(policy, env, tuple(cases), tier, limits or {}, progress))

    def run(self, *, env: str, agent: str | AgentFunction, **options: Any) -> Run:
        """Plays one run on this cluster; arguments as for `evopolicy.run` without `slots` and `policy_packages`."""
        return call(self._run(env, agent, **options))

    async def run_async(self, *, env: str, agent: str | AgentFunction, **options: Any) -> Run:
        """Async twin of `run`."""
        return await awaited(self._run(env, agent, **options))

    # The methods below run on the package's event loop.

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

    async def _on(self, env: str, tier: Tier, work: Callable[[operator.Reached], Awaitable[T]]) -> T:
        """Returns the result of `work`; raises the local cluster's error when the cluster fails first."""
        reached = self._reached
        if reached is None:
            raise ConfigError("this cluster is not open: use it inside `with Cluster.local() as cluster:`")
        results: list[T] = []

        async def kept() -> None:
            results.append(await work(reached))

        if reached.local is not None and self._where.local_slots is not None:
            async with self._offering:
                if env not in self._offered:
                    await reached.local.start_workers([env], slots=self._where.local_slots, tiers={tier})
                    self._offered.add(env)
        failed = None if reached.local is None else reached.local.failed
        await unless_failed(asyncio.create_task(kept()), failed)
        return results[0]

    async def _evaluate(
        self,
        policy: str | os.PathLike[str],
        env: str,
        cases: tuple[int, ...],
        tier: Tier,
        limits: Limits,
        progress: bool,
    ) -> Evaluation:
        if not cases:
            raise ConfigError("cases is empty: name train ids, such as range(8)")
        try:
            cases = tuple(map(index, cases))  # numpy's integers too
        except TypeError as error:
            raise ConfigError(f"cases {cases!r}: name train ids, such as range(8) or [0, 3]") from error
        env = one_environment(env)
        bundle = await asyncio.to_thread(policy_bundle, shipped.found(Path(policy), Path.cwd()))
        message = Evaluate(
            token="",
            key=uuid.uuid4().hex,
            env=env,
            bundle=bundle.digest,
            split="train",
            cases=cases,
            sandbox_tier=tier,
            limits=limits_of([f"{name}={value}" for name, value in limits.items()]),
            step_limit="published",
        )

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

        return await self._on(env, tier, work)

    async def _run(
        self, env: str, agent: str | AgentFunction, *, progress: bool = True, **options: Any
    ) -> Run:
        check_installed("gateway")
        with contextlib.ExitStack() as stack:
            if callable(agent):
                options["entry"] = options.get("entry") or _name_of(agent)
                folder = stack.enter_context(scratch_folder("function"))
                agent = await asyncio.to_thread(_pickled, agent, folder / "function.pickle")
            plan = plan_of(env, agent, **options)
            await asyncio.to_thread(plan.check)
            return await self._play(plan, progress)

    async def _play(
        self, plan: Plan, progress: bool, started: Callable[[RunLifecycle], None] = lambda _: None
    ) -> Run:
        """Plays a run; `started` is called before its first step."""
        self._where.check_cases([plan.settings])

        async def work(reached: operator.Reached) -> Run:
            with RunView(terminal(stderr=True) if progress else None).shown() as watch:
                lifecycle = RunLifecycle(plan, reached.operations, reached.gateway, watch)
                started(lifecycle)
                await lifecycle.play()
            return await asyncio.to_thread(read_run, plan.folder.root)

        return await self._on(plan.settings.env, plan.settings.sandbox_tier, work)


def plan_of(
    env: str,
    agent: str,
    *,
    budget: int | None = None,
    runs: str | os.PathLike[str] = "runs",
    exp_id: str | None = None,
    entry: str | None = None,
    model: str | None = None,
    repeat: int = 0,
    validation: int | None = None,
    heldout: int | None = None,
    profile: Literal["published"] | None = None,
    replays: VideoOption | None = None,
    tier: Tier = "bwrap",
    feedback: FeedbackDetail | None = None,
    prompts: str | os.PathLike[str] | None = None,
    agents_md: str | os.PathLike[str] | None = None,
    agent_wall_s: float = WALL_S,
    overwrite: bool = False,
    listener: Listener | None = None,
    agent_host: str = "",
) -> Plan:
    """The plan of a run; arguments as for `run`, and for an agent that is started elsewhere as in `Plan`. Raises ConfigError."""
    env = one_environment(env)
    given = RunOptions(
        agent=agent,
        budget=budget,
        runs=Path(runs),
        exp_id=exp_id or default_exp_id(),
        entry=entry,
        model=model,
        repeat=repeat,
        validation=validation,
        heldout=heldout,
        profile=profile,
        replays=replays,
        tier=tier,
        feedback=feedback,
        prompts=None if prompts is None else Path(prompts),
        agents_md=None if agents_md is None else Path(agents_md),
    )
    texts = given.texts(Path.cwd())
    return Plan(
        settings=given.settings(env, given.exp_id or "", agent_host, texts),
        texts=texts,
        agent=agent,
        runs=given.runs,
        started_in=Path.cwd(),
        wall_limit_s=agent_wall_s,
        silence_s=given.agent_silence_s,
        overwrite=overwrite,
        jail=JailSettings() if listener is None else JailSettings(mode="none"),
        listener=listener,
    )


def evaluate(
    policy: str | os.PathLike[str],
    *,
    env: str,
    cases: Iterable[int] = range(4),
    slots: int = 2,
    tier: Tier = "bwrap",
    limits: Limits | None = None,
    progress: bool = True,
    policy_packages: Iterable[str] = (),
) -> Evaluation:
    """`Cluster.evaluate` on a temporary local cluster. For several calls, one `Cluster.local` saves repeated starts.

    `policy_packages`: as for `Cluster.local`; a policy in a run's directory by default gets the packages of its run.
    """
    wanted = (policy, env, tuple(cases), slots, tier, limits or {}, progress, _names(policy_packages))
    return call(_evaluated(*wanted))


async def evaluate_async(
    policy: str | os.PathLike[str],
    *,
    env: str,
    cases: Iterable[int] = range(4),
    slots: int = 2,
    tier: Tier = "bwrap",
    limits: Limits | None = None,
    progress: bool = True,
    policy_packages: Iterable[str] = (),
) -> Evaluation:
    """Async twin of `evaluate`."""
    wanted = (policy, env, tuple(cases), slots, tier, limits or {}, progress, _names(policy_packages))
    return await awaited(_evaluated(*wanted))


def run(
    *,
    env: str,
    agent: str | AgentFunction,
    budget: int | None = None,
    runs: str | os.PathLike[str] = "runs",
    slots: int = 2,
    policy_packages: Iterable[str] = (),
    **options: Any,
) -> Run:
    """Plays one whole run, up to its score, on a temporary local cluster.

    `agent`: a function of one `Workspace`, or a text as for `--agent` of `evopolicy run`. A function runs in its own
    process in the agent's jail, where it can import the standard library and numpy; its own module is sent with it. It
    returns a JSON-serialisable value, which `Run.value` reads back. `budget`: train episodes, by default the suite's.
    `runs`: the folder of run directories. `policy_packages`: installed packages that policies may import besides numpy,
    such as `("scipy",)`. Further `options`, as the options of `evopolicy run` with these names:
    `exp_id`, `entry`, `model`, `repeat`, `validation`, `heldout`, `profile`, `replays`, `tier`, `feedback`, `prompts` and
    `agents_md` (files), `agent_wall_s` (seconds), `overwrite`, `progress`.

    Raises ConfigError, with the remedy, for wrong arguments and for missing requirements on this machine. Ctrl-C
    cancels the run, and its folder records that.
    """
    return call(_ran(slots, _names(policy_packages), env, agent, budget=budget, runs=runs, **options))


async def run_async(
    *,
    env: str,
    agent: str | AgentFunction,
    budget: int | None = None,
    runs: str | os.PathLike[str] = "runs",
    slots: int = 2,
    policy_packages: Iterable[str] = (),
    **options: Any,
) -> Run:
    """Async twin of `run`."""
    return await awaited(
        _ran(slots, _names(policy_packages), env, agent, budget=budget, runs=runs, **options)
    )


async def _evaluated(
    policy: str | os.PathLike[str],
    env: str,
    cases: tuple[int, ...],
    slots: int,
    tier: Tier,
    limits: Limits,
    progress: bool,
    packages: tuple[str, ...],
) -> Evaluation:
    found = packages_for(shipped.found(Path(policy), Path.cwd()), packages)
    async with _opened(Cluster.local(slots, policy_packages=found)) as cluster:
        return await cluster._evaluate(policy, env, cases, tier, limits, progress)


async def _ran(
    slots: int, packages: tuple[str, ...], env: str, agent: str | AgentFunction, **options: Any
) -> Run:
    async with _opened(Cluster.local(slots, policy_packages=packages)) as cluster:
        return await cluster._run(env, agent, **options)


@contextlib.asynccontextmanager
async def _opened(cluster: Cluster) -> AsyncIterator[Cluster]:
    await cluster._open()
    try:
        yield cluster
    finally:
        await cluster._close()


def _names(packages: Iterable[str]) -> tuple[str, ...]:
    if isinstance(packages, str):
        raise ConfigError(
            f"policy_packages = {packages!r}: give a sequence of names, such as ({packages!r},)"
        )
    return tuple(sorted(set(packages)))


def _bar(wanted: bool) -> Progress:
    console = terminal(stderr=True)
    widgets = console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
    return Progress(
        console=console, transient=True, disable=not wanted or not (console.is_terminal or widgets)
    )


def _name_of(function: AgentFunction) -> str:
    name = getattr(function, "__name__", type(function).__name__)
    return name if name.isidentifier() else "function"


def _pickled(function: AgentFunction, file: Path) -> str:
    """Writes the function to `file` for the jail. Returns the agent that calls it there, in the form of `--agent`."""
    import cloudpickle

    # The jail cannot import modules from outside site-packages, so the function's module is pickled with it.
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    by_value = module is not None and module.__name__ != "__main__" and not _is_installed(module)
    if by_value:
        cloudpickle.register_pickle_by_value(module)
    try:
        file.write_bytes(cloudpickle.dumps(function))
    except Exception as error:
        raise ConfigError(f"agent {_name_of(function)} cannot be sent to its jail: {error}") from error
    finally:
        if by_value:
            cloudpickle.unregister_pickle_by_value(module)
    file.chmod(0o644)
    words: Sequence[str] = (sys.executable, "-P", "-m", "evopolicy_gateway.agents.function", str(file))
    return f"command:{shlex.join(words)}"


def _is_installed(module: Any) -> bool:
    """Whether the module is part of Python or of a package in site-packages."""
    place = getattr(module, "__file__", None)
    return place is None or any(part in ("site-packages", "dist-packages") for part in Path(place).parts)
