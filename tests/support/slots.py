"""Slots for tests: started once per tier, and played from ordinary code."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
from collections.abc import Coroutine, Iterator
from pathlib import Path
from textwrap import dedent, indent
from typing import Any, TypeVar

import msgspec

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import (
    BlobRef,
    EpisodeOutcome,
    EpisodeSpec,
    Job,
    PolicyFailure,
    ResourceLimits,
    Tier,
)
from evopolicy_common.processes import proc
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.trajectory import Row, decode
from evopolicy_worker.slot_protocol.begun import unpack
from evopolicy_worker.slots.slot import Slot

T = TypeVar("T")

_TIMES = {"episode_wall_s": 20.0, "act_wall_s": 2.0, "init_wall_s": 10.0, "cpu_s": 10.0}
QUICK = ResourceLimits(**_TIMES, memory_bytes=256 << 20, processes=8, file_bytes=4 << 20)
"""Limits that a test can wait for."""

HONEST = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return [float(obs[2] - obs[0])]
"""
"""A policy for `toy/line` that does what it should."""

STUCK = HONEST.replace("return [", "import time; time.sleep(60); return [")
"""One that answers the first question after a minute."""

_MISBEHAVING = """
import ctypes, json, os, signal, struct, sys, threading, time
import numpy as np

class Policy:
    def __init__(self, *spaces):
        self.n = 0
        {init}

    def reset(self, episode_index):
        {reset}

    def act(self, obs):
        self.n += 1
        if self.n == 4:
            {act}
        return [0.0]
"""


def misbehaving(init: str = "pass", reset: str = "pass", act: str = "pass") -> str:
    """A policy with this code in its three places; in `act` at step 3 only."""
    return _MISBEHAVING.format(init=init, reset=reset, act=act)


def acting(act: str = "return [0.0]", *, init: str = "pass", reset: str = "pass", before: str = "") -> str:
    """A policy with these lines in its three methods, after the lines `before`."""
    methods = (
        ("__init__(self, *spaces)", init),
        ("reset(self, episode_index)", reset),
        ("act(self, obs)", act),
    )
    texts = (f"    def {head}:\n{indent(dedent(body).strip(), ' ' * 8)}\n" for head, body in methods)
    return "\n".join((dedent(before), "class Policy:", *texts))


class Slots:
    """One slot per tier, sealing and packages, each started at its first use."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._slots: dict[tuple[str, bool, tuple[str, ...]], Slot] = {}
        self._numbers = itertools.count()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, T], timeout_s: float = 120.0) -> T:
        """The result of a coroutine, run on the slots' loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(timeout_s)

    def slot(self, tier: Tier = "bwrap", *, sealed: bool = True, packages: tuple[str, ...] = ()) -> Slot:
        """The running slot of that tier, whose policies may import these packages besides numpy."""
        key = (tier, sealed, packages)
        if key not in self._slots:
            slot = self.new(tier, sealed=sealed, packages=packages)
            self.run(slot.start())
            self._slots[key] = slot
        return self._slots[key]

    def new(self, tier: Tier = "bwrap", *, sealed: bool = True, packages: tuple[str, ...] = ()) -> Slot:
        """A slot of one's own, not started."""
        folder = self.folder / f"slot-{next(self._numbers)}"
        return Slot(None, tier, folder, ("numpy", *packages), sealed=sealed)

    @contextlib.contextmanager
    def running(self, slot: Slot | None = None) -> Iterator[Slot]:
        """This slot, or one of one's own, started inside and closed at the end."""
        slot = slot or self.new()
        self.run(slot.start())
        try:
            yield slot
        finally:
            self.run(slot.close())

    def bundle(self, files: dict[str, str | bytes] | str) -> Path:
        """A bundle's folder; a text is its `policy.py`."""
        folder = self.folder / f"bundle-{next(self._numbers)}"
        folder.mkdir()
        for name, content in ({"policy.py": files} if isinstance(files, str) else files).items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(dedent(content).encode() if isinstance(content, str) else content)
        return folder

    def play_all(
        self,
        policy: dict[str, str | bytes] | str | None,
        *,
        tier: Tier = "bwrap",
        sealed: bool = True,
        packages: tuple[str, ...] = (),
        slot: Slot | None = None,
        **options: Any,
    ) -> tuple[EpisodeOutcome, ...]:
        """Outcomes of a job with that policy (None: random actions)."""
        job = make_job(bundle=None if policy is None else "digest", tier=tier, **options)
        folder = None if policy is None else self.bundle(policy)
        slot = slot or self.slot(tier, sealed=sealed, packages=packages)
        return self.run(slot.play_job(job, folder, lambda episodes, steps: None))

    def play(self, policy: dict[str, str | bytes] | str | None, **options: Any) -> EpisodeOutcome:
        """The outcome of one episode; not the first of its submit unless `first=0`."""
        (outcome,) = self.play_all(policy, **options)
        return outcome

    def close(self) -> None:
        for slot in self._slots.values():
            self.run(slot.close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def make_job(
    *,
    env: str = "toy/line",
    first: int = 1,
    n: int = 1,
    seed: int = 7,
    policy_seed: bytes = bytes(range(16)),
    bundle: str | None = "digest",
    limits: ResourceLimits = QUICK,
    **options: Any,
) -> Job:
    """A job of `n` episodes from request index `first` on."""
    episodes = tuple(
        EpisodeSpec(
            index=first + k, episode_index=first + k, case=Case(seed=seed + k), policy_seed=policy_seed
        )
        for k in range(n)
    )
    meta = {"env": env, "submit_index": 3, "n_episodes_this_submit": n}
    meta |= {"remaining_budget_after": 5, "max_episode_steps": 60}
    return Job(
        job_id="job", env=env, bundle=bundle, episodes=episodes, env_meta=meta, limits=limits, **options
    )


def rows(outcome: EpisodeOutcome) -> list[Row]:
    """The outcome's trajectory."""
    assert outcome.trajectory is not None
    assert outcome.trajectory.inline is not None
    return list(decode(outcome.trajectory.inline).rows())


def category_of(outcome: EpisodeOutcome) -> str | None:
    """The category of the policy's failure; None without one."""
    return None if outcome.failure is None else outcome.failure.category


def failure_of(outcome: EpisodeOutcome) -> PolicyFailure:
    """The policy's failure, which has to be there."""
    assert outcome.failure is not None
    return outcome.failure


def going_on(job: Job, slot: Slot) -> Job:
    """The job as it is leased the next time."""
    back = slot.begun
    if back is None:
        return job
    ref = BlobRef(digest=digest_of(back.data), size=len(back.data), inline=back.data)
    return msgspec.structs.replace(job, begun=ref)


def prefix(job: Job, place: int = 0) -> list[float]:
    """The actions that the job goes on from."""
    packed = unpack(job).get(place)
    return [] if packed is None else [float(action[0]) for _, action in packed.unpacked().taken]


# A slot's processes.


def children(pid: int) -> list[int]:
    found = []
    # A process or a thread may end while this looks at it.
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += [int(child) for child in (task / "children").read_text().split()]
    return found


def family(pid: int) -> list[int]:
    """The process and all its descendants, outermost first; a process's children in the order of their starts."""
    return [pid, *(member for child in children(pid) for member in family(child))]


def runs(pid: int) -> bool:
    """Whether the process is there and not just waiting for its parent to take note of its end."""
    found = proc.stat(pid)
    return found is not None and found.state not in "ZX"


def pid_of(slot: Slot) -> int:
    assert slot._process is not None
    return slot._process.pid


async def begun(
    slot: Slot, slots: Slots, policy: str, **options: object
) -> asyncio.Task[tuple[EpisodeOutcome, ...]]:
    """A job that is being played: its policy's process is there and has begun to work."""
    before, taken = len(family(pid_of(slot))), 0
    job = make_job(
        **({"limits": msgspec.structs.replace(QUICK, act_wall_s=90.0, episode_wall_s=90.0)} | options)
    )

    def note(episodes: int, steps: int) -> None:
        nonlocal taken
        taken = steps

    task = asyncio.create_task(slot.play_job(job, slots.bundle(policy), note))
    # Another process may compile the policy first, so without a step yet, the same one has to be there for a while.
    last, same = 0, 0
    while not taken and same < 50:
        await asyncio.sleep(0.02)
        now = family(pid_of(slot))
        same = same + 1 if now[-1] == last and len(now) >= before else 0
        last = now[-1]
    return task
