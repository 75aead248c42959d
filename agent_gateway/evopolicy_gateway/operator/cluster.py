"""The cluster that a command uses: an operator's, or one of this machine brought up for it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from evopolicy_common.cli import end_on_sigterm
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.messages.operator import RunSettings
from evopolicy_common.processes.local_cluster import LocalCluster, Workers, local_cluster
from evopolicy_common.terminal import say
from evopolicy_common.wire import transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.operator.live_view import live_view
from evopolicy_gateway.operator.operations import Operations, find_credentials


class Cluster(msgspec.Struct, frozen=True, kw_only=True):
    """Which cluster a command uses: a local one with so many slots, or the one that is named (or this machine's own)."""

    connect: tuple[str, ...] = ()
    file: Path | None = None
    """The operator's credentials."""
    local_slots: int | None = None
    state: Path | None = None
    """Of a local one: its folder; None for one that is thrown away."""
    unjailed: bool = False
    """Of a local one with a state: agents could read it."""
    data: Path | None = None
    audit: float = 0.0
    """Of a local one: share of the episodes that a second worker plays again."""
    hidden_isolation: str | None = None
    """Of a local one: as `evopolicy-coordinator --hidden-isolation` takes it; None for its default."""
    web: Path | None = None
    """Folder of runs that a live view shows meanwhile; None for no view."""

    def check_cases(self, runs: Iterable[RunSettings]) -> None:
        """ConfigError where a local one has not the case files that a run plays."""
        if (
            self.local_slots is not None
            and self.data is None
            and any(run.profile == "published" for run in runs)
        ):
            raise ConfigError(
                "--profile published plays the published case files: give --data FOLDER, the folder data/main-128 of the"
                " published software, which holds gym/acrobot/train.json and so on"
            )


class Reached(NamedTuple):
    """A cluster that answers."""

    operations: Operations
    gateway: Credentials
    """The gateways'."""
    local: LocalCluster | None
    """One that was brought up here."""


@contextlib.asynccontextmanager
async def reached(where: Cluster, workers: Workers | None = None) -> AsyncIterator[Reached]:
    """A link to the cluster, which is brought up where it is a local one, with these workers."""
    async with contextlib.AsyncExitStack() as stack:
        local: LocalCluster | None = None
        file, opened = where.file, None
        if where.local_slots is not None:
            local = await stack.enter_async_context(
                local_cluster(
                    "local",
                    state=where.state,
                    data=where.data,
                    audit=where.audit,
                    hidden_isolation=where.hidden_isolation,
                    unjailed=where.unjailed,
                    workers=workers,
                )
            )
            if local.note:
                say(f"note: {local.note}", err=True)
            file, opened = local.operator_file, local.opened
        operator, gateway = find_credentials(where.connect, file)
        link = await stack.enter_async_context(transport.connect(operator))
        if where.web is not None:
            await stack.enter_async_context(live_view(where.web, where.connect, file))
        yield Reached(Operations(link, opened), gateway, local)


@contextlib.asynccontextmanager
async def connected(
    where: Cluster, env_ids: Sequence[str], tiers: Collection[Tier]
) -> AsyncIterator[tuple[Operations, Credentials, asyncio.Future[None] | None]]:
    """A link to the cluster, the gateways' credentials, and what fails when a local cluster cannot be kept up.

    `tiers`: sandbox tiers that will be asked for, without which a local cluster fails.
    """
    end_on_sigterm()
    workers = None if where.local_slots is None else Workers(env_ids, where.local_slots, tiers)
    async with reached(where, workers) as (operations, gateway, local):
        yield operations, gateway, None if local is None else local.failed
