"""The sandbox's tiers: which of them work here, found out by starting each."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from evopolicy_common.errors import SandboxError
from evopolicy_common.messages.episode import Tier
from evopolicy_worker.sandbox import jail
from evopolicy_worker.sandbox.zygote import Zygote


def available_tiers(
    allowed_packages: tuple[str, ...] = ("numpy",), *, unsandboxed: bool = False
) -> tuple[Tier, ...]:
    """Tiers that this machine offers, the strongest first; `none` only when its operator says so.

    Nothing falls back from one tier to another: a job names its tier.
    """
    found: list[Tier] = [tier for tier in ("bwrap", "landlock") if why_not(tier, allowed_packages) is None]
    return (*found, "none") if unsandboxed else tuple(found)


@cache
def why_not(tier: Tier, allowed_packages: tuple[str, ...] = ("numpy",)) -> str | None:
    """Why this tier does not work here, with what to do; None when it works. Starts a sandbox to see."""
    with tempfile.TemporaryDirectory(prefix="evopolicy-tier-") as folder:
        scratch = Path(folder)
        try:
            zygote = Zygote(jail.plan(tier, scratch, allowed_packages), scratch)
        except (SandboxError, OSError) as error:
            return str(error)
        zygote.close()
        return None
