"""The sandbox tiers that work on this machine, tested by starting a slot of each."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from functools import cache

from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_worker.sandbox import jail
from evopolicy_worker.slots.slot import Slot

SANDBOXED: tuple[Tier, ...] = ("bwrap", "landlock")
"""Tiers that confine policies, strongest first."""


def available_tiers(*, unsandboxed: bool = False, wanted: Collection[str] = SANDBOXED) -> tuple[Tier, ...]:
    """Tiers that this machine offers, strongest first; `none` only with `unsandboxed`.

    `wanted`: the sandboxed tiers to test; each takes about a second. A job names its tier, and nothing falls back to
    another.
    """
    working = [tier for tier in SANDBOXED if tier in wanted and why_not(tier) is None]
    return (*working, "none") if unsandboxed else tuple(working)


@cache
def why_not(tier: Tier) -> str | None:
    """Why this tier does not work here, with a remedy; None when it works.

    Starts an environment process in its jail, with the policies' sandbox inside. Call it on the main thread,
    and not from a coroutine.
    """
    with scratch_folder("tier") as folder:
        # A subfolder, as for a slot: this process holds the lock of `folder` itself.
        scratch = folder / "slot"
        try:
            jail.plan(tier, scratch, ("numpy",))
            asyncio.run(try_out(Slot(None, tier, scratch)))
        except (EvopolicyError, OSError) as error:
            return str(error)
    return None


async def try_out(slot: Slot) -> None:
    """Starts the slot and closes it. Raises as `Slot.start`."""
    try:
        await slot.start()
    finally:
        await slot.close()
