"""The cluster of a command: an operator's, or a local one that the command starts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.cli.conventions import end_on_sigterm
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import LocalCluster, Workers, local_cluster
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.terminal import say
from evopolicy_common.wire import transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.run.operations import Operations, find_credentials
from evopolicy_gateway.run.run_options import ClusterOptions

CONNECT_S = 10.0
"""Patience with a coordinator that was not reached yet, seconds."""


class ChosenCluster(msgspec.Struct, frozen=True, kw_only=True):
    """Which cluster a command uses: a local one, the named one, or this machine's own."""

    connect: tuple[str, ...] = ()
    file: Path | None = None
    """The operator's credentials."""
    local: ClusterOptions | None = None
    """Of a cluster that is started here: `state` None is a temporary one."""
    unjailed: bool = False
    """For a local cluster with a state: its agents have no jail and could read that state."""
    patient: bool = False
    """The command continues earlier work, and waits for a coordinator that is away."""

    def check_cases(self, runs: Iterable[RunSettings]) -> None:
        """Raises ConfigError when a local cluster lacks the case files that a run plays."""
        derived = self.local is not None and self.local.data is None
        if derived and any(run.profile != "own" for run in runs):
            raise ConfigError(
                "--profile published plays the published case files: give --data FOLDER, the folder data/main-128 of"
                " the published software, which holds gym/acrobot/train.json and so on"
            )

    def check_train(self, env_id: str, cases: Sequence[int]) -> None:
        """Raises ConfigError for cases that a local cluster lacks. Other clusters' case files state their numbers."""
        if self.local is None or self.local.data is not None:
            return
        last, n = max(cases, default=-1), catalogue.suite_of(env_id).n_train
        if last >= n:
            raise ConfigError(f"--cases: there is no train case {last}; the cases are 0 to {n - 1}")


class Reached(NamedTuple):
    operations: Operations
    gateway: Credentials
    local: LocalCluster | None


@contextlib.asynccontextmanager
async def reached(where: ChosenCluster, workers: Workers | None = None) -> AsyncIterator[Reached]:
    """Connects to the cluster; a local one is started first, with `workers`."""
    async with contextlib.AsyncExitStack() as stack:
        local: LocalCluster | None = None
        file, opened = where.file, None
        if (chosen := where.local) is not None:
            starting = local_cluster(
                "local",
                state=chosen.state,
                data=chosen.data,
                hidden_isolation=chosen.hidden_isolation,
                unjailed=where.unjailed,
                workers=workers,
                policy_packages=tuple(chosen.policy_package or ()),
                env_timeout=chosen.env_timeout,
                env_memory=chosen.env_memory,
            )
            local = await stack.enter_async_context(starting)
            if local.note:
                say(f"note: {local.note}", err=True)
            file, opened = local.operator_file, local.opened
        operator, gateway = find_credentials(where.connect, file)
        timeout_s = None if where.patient else CONNECT_S
        link = await stack.enter_async_context(transport.connect(operator, timeout_s=timeout_s))
        yield Reached(Operations(link, opened), gateway, local)


@contextlib.asynccontextmanager
async def connected(
    where: ChosenCluster, env_ids: Sequence[str], tiers: Collection[Tier]
) -> AsyncIterator[tuple[Operations, Credentials, asyncio.Future[None] | None]]:
    """Yields operations, gateway credentials, and a future that fails with a local cluster."""
    end_on_sigterm()
    workers = None if where.local is None else Workers(env_ids, where.local.slots, tiers)
    async with reached(where, workers) as (operations, gateway, local):
        yield operations, gateway, None if local is None else local.failed
