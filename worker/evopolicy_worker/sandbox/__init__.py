"""Sandboxes of environment and policy processes, and which of their tiers work here, tested by starting each."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
from collections.abc import Collection
from functools import cache
from pathlib import Path

import msgspec

from evopolicy_common.errors import SandboxError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_worker.sandbox import env_jail, jail
from evopolicy_worker.sandbox.zygote import START_TIMEOUT_S
from evopolicy_worker.slot_protocol import slot_messages as messages

SANDBOXED: tuple[Tier, ...] = ("bwrap", "landlock")
"""Tiers that confine policies, strongest first."""


def available_tiers(*, unsandboxed: bool = False, wanted: Collection[str] = SANDBOXED) -> tuple[Tier, ...]:
    """Tiers that this machine offers, strongest first; `none` only with `unsandboxed`.

    `wanted`: the sandboxed tiers to test; each takes about a second. A job names its tier, and nothing falls back to
    another.
    """
    found = [tier for tier in SANDBOXED if tier in wanted and why_not(tier) is None]
    return (*found, "none") if unsandboxed else tuple(found)


@cache
def why_not(tier: Tier) -> str | None:
    """Why this tier does not work here, with a remedy; None when it works.

    Starts an environment process in its jail, with the policies' sandbox inside. Call it on the main thread.
    """
    with scratch_folder("tier") as folder:
        # A subfolder, as for a slot: this process holds the lock of `folder` itself.
        scratch = folder / "slot"
        scratch.mkdir()
        try:
            return _why_not_started(tier, scratch)
        except (SandboxError, OSError) as error:
            return str(error)


def _why_not_started(tier: Tier, scratch: Path) -> str | None:
    packages = ("numpy",)
    user = jail.plan(tier, scratch, packages).user
    start = messages.Start(tier=tier, core=None, scratch=str(scratch), allowed_packages=packages, user=user)
    process = subprocess.Popen(
        env_jail.command(tier, scratch),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=env_jail.variables(scratch),
        start_new_session=True,
    )
    try:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(messages.framed(start))
        process.stdin.flush()
        if not select.select([process.stdout], [], [], 2 * START_TIMEOUT_S)[0]:
            return f"a slot did not start within {2 * START_TIMEOUT_S:g} s"
        head = process.stdout.read(messages.LENGTH.size)
        if len(head) == messages.LENGTH.size:
            reply = messages.replies.decode(process.stdout.read(messages.LENGTH.unpack(head)[0]))
            return reply.message if isinstance(reply, messages.Fault) else None
    except (BrokenPipeError, msgspec.DecodeError):
        pass
    finally:
        # The whole group, as in `slots`: bubblewrap's second process may still wait for the first.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        _, errors = process.communicate()
    words = errors.decode("utf-8", "replace").strip()[-2000:]
    return f"the environment process does not start: {words or 'no stderr output'}"
