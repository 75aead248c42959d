"""A policy whose answers depend on all that it has seen, and the pause in which tests strike its processes."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable
from pathlib import Path

import msgspec
from slots import QUICK, Slots, begun, family, pid_of

from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_worker.slots.slot import Slot

PATIENT = msgspec.structs.replace(QUICK, act_wall_s=30.0, episode_wall_s=60.0)


# Its answers depend on all that it has seen, and it says so: a policy that is started again has to catch up.
STATEFUL = """
import hashlib, os, time

class Policy:
    def __init__(self, *spaces):
        self.seen = hashlib.sha256()
        self.n = 0
        print("built", flush=True)

    def reset(self, episode_index):
        self.seen.update(bytes([episode_index % 256]))

    def act(self, obs):
        self.n += 1
        if self.n == PAUSE_AT:
            time.sleep(PAUSE_S)
        self.seen.update(obs.tobytes())
        print(self.seen.hexdigest(), flush=True)
        return [self.seen.digest()[0] / 128.0 - 1.0]
"""


def stateful(pause_s: float = 5.0, at: int = 31) -> str:
    return STATEFUL.replace("PAUSE_AT", str(at)).replace("PAUSE_S", str(pause_s))


def essence(outcome: EpisodeOutcome) -> EpisodeOutcome:
    return msgspec.structs.replace(outcome, wall_s=0.0, policy_cpu_s=0.0)


async def in_its_pause(slot: Slot, pid: int) -> None:
    """Until the policy sleeps in its pause: it uses no time on a processor."""

    def used() -> str:
        return " ".join(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13])

    before, same = "", 0
    while same < 5:
        await asyncio.sleep(0.05)
        now = used()
        same, before = (same + 1 if now == before else 0), now


async def struck(
    slot: Slot, slots: Slots, strike: Callable[[list[int]], object], source: str = "", **options: object
) -> tuple[EpisodeOutcome, ...]:
    """The outcomes of a job whose slot's processes are struck in its policy's pause."""
    task = await begun(slot, slots, source or stateful(), **{"limits": PATIENT, **options})
    pids = family(pid_of(slot))
    await in_its_pause(slot, pids[-1])
    strike(pids)
    return await asyncio.wait_for(task, 100)


def kill_policy(pids: list[int]) -> None:
    os.kill(pids[-1], signal.SIGKILL)


def place_of_env(pids: list[int]) -> int:
    """Where in a slot's family the environment's process is: outside are its jail's, below it the sandbox's."""
    lines = [Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0") for pid in pids]
    return next(
        k
        for k, line in enumerate(lines)
        if b"bwrap" not in line[0] and b"evopolicy_worker.episodes.env_process" in line
    )
