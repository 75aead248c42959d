"""The cluster of a command on finished runs: a running one, or with `--local` one that the command starts and ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from evopolicy_common.cli.conventions import CLUSTER, fail
from evopolicy_common.console import Terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import LocalCluster, local_cluster, unless_failed
from evopolicy_common.messages.episode import Tier
from evopolicy_common.wire import credentials, transport

Local = Annotated[
    bool,
    typer.Option(
        "--local",
        help="Start a cluster on this machine for this command.",
        rich_help_panel=CLUSTER,
    ),
]
State = Annotated[
    Path | None,
    typer.Option(
        help="With --local: the state folder of the runs; default: the one that `evopolicy local` uses.",
        show_default=False,
        rich_help_panel=CLUSTER,
    ),
]
Slots = Annotated[
    int,
    typer.Option(
        min=1, max=1024, help="With --local: episodes played at the same time.", rich_help_panel=CLUSTER
    ),
]


class Where(msgspec.Struct, frozen=True, kw_only=True):
    """The cluster that the options name."""

    connect: tuple[str, ...]
    file: Path | None
    local: bool
    state: Path | None
    data: Path | None = None

    @contextlib.asynccontextmanager
    async def link(
        self, kind: str, *, needs_state: bool = True, packages: Sequence[str] = ()
    ) -> AsyncIterator[tuple[transport.Link, LocalCluster | None]]:
        """A link to the cluster; with `--local` the cluster too, which has no workers yet.

        `kind` names the logs of that cluster. `needs_state`: whether its state folder has to exist; otherwise a
        temporary one replaces the usual one. `packages`: those that policies may import besides numpy. Raises
        ConfigError for a folder that does not exist.
        """
        async with contextlib.AsyncExitStack() as stack:
            file, cluster = self.file, None
            if self.local:
                folder: Path | None = self.state or credentials.local_state_dir()
                if folder is not None and not folder.is_dir():
                    if needs_state or self.state is not None:
                        raise ConfigError(f"--state {folder}: no such state folder")
                    folder = None
                cluster = await stack.enter_async_context(
                    local_cluster(kind, state=folder, data=self.data, policy_packages=packages)
                )
                file = cluster.operator_file
            found = credentials.find("operator", self.connect, file)
            yield await stack.enter_async_context(transport.connect(found)), cluster


async def play(
    cluster: LocalCluster | None,
    env_ids: list[str],
    tiers: set[Tier],
    slots: int,
    work: Callable[[], Coroutine[Any, Any, None]],
) -> None:
    """Does the work; with a cluster of the command's own it starts workers first, and ends with an error when one
    fails."""
    if cluster is not None:
        await cluster.start_workers(env_ids, slots=slots, tiers=tiers)
    await unless_failed(asyncio.create_task(work()), None if cluster is None else cluster.failed)


def where_of(
    connect: list[str] | None,
    file: Path | None,
    local: bool,
    state: Path | None,
    data: Path | None = None,
    *,
    runs: Sequence[Path],
) -> Where:
    """The cluster of these options, for these runs' folders. Ends the command if they contradict each other."""
    for option, value in (("--state", state), ("--data", data)):
        if value is not None and not local:
            fail(f"{option} applies only with --local")
    if local and (connect or file is not None):
        fail("--local starts a cluster of its own; it cannot be combined with --connect or --credentials")
    if local and state is None and (states := _sweeps_states(runs)):
        # Named, not taken: a folder of runs may be another's, and its state would decide what counts as right.
        several = "; the sweeps one by one" if len(states) > 1 else ""
        fail(f"{states[0].parent} is a sweep with a cluster of its own: add --state {states[0]}{several}")
    return Where(connect=tuple(connect or ()), file=file, local=local, state=state, data=data)


def _sweeps_states(runs: Sequence[Path]) -> list[Path]:
    """State folders of `evopolicy suite --local` above these folders of runs, or one below them."""
    roots = [root.resolve() for root in runs]
    folders = [
        each for root in roots for each in (root, *root.parents, *(root.glob("*/") if root.is_dir() else ()))
    ]
    states = [folder / credentials.SWEEP_STATE for folder in folders]
    # Not `Path.is_file`, which raises for folders that this user may not look into.
    return list(dict.fromkeys(state for state in states if os.path.isfile(state / "coordinator.sqlite")))


class Playing:
    """A progress bar of episodes on a terminal. Elsewhere it prints only the reasons why episodes wait."""

    def __init__(self, progress: Progress, title: str) -> None:
        self._progress = progress
        self._task = progress.add_task(title, total=None)
        self._shown_reasons: set[str] = set()

    def update(self, *, total: int | None = None, title: str | None = None) -> None:
        """Sets the number of episodes to come, or the bar's title."""
        self._progress.update(self._task, total=total, description=title)

    def played(self, count: int, waits_for: str) -> None:
        """Shows the number of episodes played, and each reason for waiting once."""
        self._progress.update(self._task, completed=count)
        if waits_for and waits_for not in self._shown_reasons:
            self._shown_reasons.add(waits_for)
            self._progress.console.print(f"waits for {waits_for}")


@contextlib.contextmanager
def playing(console: Terminal, title: str) -> Iterator[Playing]:
    """A progress bar while the body runs."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as progress:
        yield Playing(progress, title)
