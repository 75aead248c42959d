"""The cluster of a command on finished runs: a running one, or with `--local` one that the command starts and ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress

from evopolicy_common.cli.conventions import CLUSTER, fail
from evopolicy_common.console import Terminal, progress_bars
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import LocalCluster, local_cluster, unless_failed
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes.notices import Waiting
from evopolicy_common.wire import credentials, transport
from evopolicy_results.evaluations import Evaluations

Local = Annotated[
    bool,
    typer.Option(
        "--local", help="Start a cluster on this machine for this command.", rich_help_panel=CLUSTER
    ),
]
State = Annotated[
    Path | None,
    typer.Option(
        help="With --local: the runs' state folder; default: that of `evopolicy local`.",
        rich_help_panel=CLUSTER,
    ),
]
Runs = Annotated[
    list[Path], typer.Argument(metavar="RUNS...", help="Finished runs' directories, or folders of them.")
]
_SHOWN = 20


def first(lines: Sequence[str]) -> list[str]:
    """The first lines of a list, and how many more there are."""
    more = [f"… and {len(lines) - _SHOWN} more (--json lists all)"] if len(lines) > _SHOWN else []
    return [*lines[:_SHOWN], *more]


class Where:
    def __init__(
        self,
        connect: list[str] | None,
        file: Path | None,
        local: bool,
        state: Path | None,
        data: Path | None = None,
        *,
        runs: Sequence[Path],
        needs_state: bool = True,
    ) -> None:
        """Ends the command if the options contradict each other, or belong to another cluster than these runs.

        `needs_state`: whether the state folder has to exist; otherwise a temporary one replaces the usual one."""
        for option, value in (("--state", state), ("--data", data)):
            if value is not None and not local:
                fail(f"{option} applies only with --local")
        if local and (connect or file is not None):
            fail("--local starts a cluster of its own; it cannot be combined with --connect or --credentials")
        if local and state is None and (states := _sweeps_states(runs)):
            # Named, not taken: a folder of runs may be another's, and its state would decide what counts as right.
            several = "; the sweeps one by one" if len(states) > 1 else ""
            fail(f"{states[0].parent} is a sweep with a cluster of its own: add --state {states[0]}{several}")
        self.local, self.state = local, state
        self._connect, self._file, self._data, self._needs_state = connect or (), file, data, needs_state

    @contextlib.asynccontextmanager
    async def link(
        self, kind: str, packages: Sequence[str] = ()
    ) -> AsyncIterator[tuple[transport.Link, LocalCluster | None]]:
        """A link to the cluster; with `--local` the cluster too, which has no workers yet.

        `kind` names the logs of that cluster. `packages`: those that policies may import besides numpy. Raises
        ConfigError for a state folder that does not exist.
        """
        async with contextlib.AsyncExitStack() as stack:
            file, cluster = self._file, None
            if self.local:
                folder: Path | None = self.state or credentials.local_state_dir()
                if folder is not None and not folder.is_dir():
                    if self._needs_state or self.state is not None:
                        raise ConfigError(f"--state {folder}: no such state folder")
                    folder = None
                cluster = await stack.enter_async_context(
                    local_cluster(kind, state=folder, data=self._data, policy_packages=packages)
                )
                file = cluster.operator_file
            link = transport.connect(credentials.find("operator", tuple(self._connect), file))
            yield await stack.enter_async_context(link), cluster

    @contextlib.asynccontextmanager
    async def playing(
        self, kind: str, console: Terminal, packages: Sequence[str] = ()
    ) -> AsyncIterator[Playing]:
        """Evaluations on the cluster of `link`, with a progress bar while the body runs."""
        async with self.link(kind, packages) as (link, cluster):
            with progress_bars(console) as progress:
                yield Playing(link, cluster, progress, kind)


class Playing:
    """Evaluations of a command, with a bar on a terminal. Elsewhere it prints only why episodes wait."""

    def __init__(
        self, link: transport.Link, cluster: LocalCluster | None, progress: Progress, title: str
    ) -> None:
        """`cluster`: the command's own, which has no workers yet."""
        self.evaluations = Evaluations(link, self._played, own=cluster is not None)
        self._cluster, self._progress = cluster, progress
        self._task = progress.add_task(title, total=None)
        self._waiting = Waiting()

    def update(self, *, total: int | None = None, title: str | None = None) -> None:
        """Sets the number of episodes to come, or the bar's title."""
        self._progress.update(self._task, total=total, description=title)

    def _played(self, count: int, waits_for: str) -> None:
        self._progress.update(self._task, completed=count)
        if self._waiting.worth_saying(waits_for):
            self._progress.console.print(f"waiting for {waits_for}", soft_wrap=True)

    async def run_work(
        self, envs: list[str], tiers: set[Tier], work: Callable[[], Coroutine[Any, Any, None]]
    ) -> None:
        """Does the work. A cluster of the command's own gets workers first, with a slot for each core, and its failure
        ends the work."""
        failed = None
        if self._cluster is not None:
            await self._cluster.start_workers(envs, tiers=tiers)
            failed = self._cluster.failed
        await unless_failed(asyncio.create_task(work()), failed)


def _sweeps_states(runs: Sequence[Path]) -> list[Path]:
    """State folders of `evopolicy suite --local` above these folders of runs, or one below them."""
    roots = [root.resolve() for root in runs]
    folders = [
        each for root in roots for each in (root, *root.parents, *(root.glob("*/") if root.is_dir() else ()))
    ]
    states = [folder / credentials.SWEEP_STATE for folder in folders]
    # Not `Path.is_file`, which raises for folders that this user may not read.
    return list(dict.fromkeys(state for state in states if os.path.isfile(state / "coordinator.sqlite")))
