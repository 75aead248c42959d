"""A policy that is stopped, or gets neither processor nor memory: only what it did itself counts against it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys

import msgspec
import pytest
from machines.cgroups import limited, starved
from slots import HONEST, QUICK, Slots, acting, begun, category_of, failure_of, family, misbehaving, pid_of
from stateful_policy import PATIENT, essence, place_of_env, stateful, struck

from evopolicy_common.errors import SlotDiedError
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_worker.episodes import monitor
from evopolicy_worker.slots.slot import Slot

pytestmark = pytest.mark.slow

LESS_TIGHT = msgspec.structs.replace(QUICK, act_wall_s=3.0, episode_wall_s=4.0)
TIGHT = msgspec.structs.replace(QUICK, act_wall_s=1.0, episode_wall_s=4.0)


def stopped(
    slots: Slots, slot: Slot, which: str, stop_s: float, source: str, **options: object
) -> EpisodeOutcome:
    """One episode in which processes of the slot are stopped for a while in the policy's pause."""

    async def work() -> tuple[EpisodeOutcome, ...]:
        task = await begun(slot, slots, source, **options)
        pids = family(pid_of(slot))
        env = place_of_env(pids)
        chosen = {
            "policy": pids[-1:],
            "environment": pids[env : env + 1],
            "all": pids,
            "sandbox": pids[env + 1 : -1],
        }
        for pid in chosen[which]:
            os.kill(pid, signal.SIGSTOP)
        await asyncio.sleep(stop_s)
        for pid in chosen[which]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        return await asyncio.wait_for(task, 100)

    (outcome,) = slots.run(work())
    return outcome


@pytest.mark.parametrize("which", ["policy", "environment", "sandbox", "all"])
def test_no_wall_limit_counts_the_time_of_a_stop(slots: Slots, which: str) -> None:
    source = stateful(0.7)
    undisturbed = slots.play(stateful(0.0), limits=PATIENT)
    # Longer than an answer, and an episode, may take.
    outcome = stopped(slots, slots.slot(), which, 6.0, source, limits=TIGHT)
    assert outcome.failure is None
    assert essence(outcome) == essence(undisturbed)


def test_a_policy_that_is_stopped_for_good_is_started_again(slots: Slots) -> None:
    slot = slots.slot()
    undisturbed = slots.play(stateful(0.0), limits=PATIENT)
    slot._stderr.clear()
    outcome = stopped(slots, slot, "policy", 2 * monitor.STOPPED_S, stateful(0.7), limits=TIGHT)
    assert essence(outcome) == essence(undisturbed)
    assert any("was stopped for 10 s" in line for line in slot._stderr)


def test_a_slot_whose_environment_is_stopped_for_good_is_given_up(
    slots: Slots, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evopolicy_worker.slots.slot.STOPPED_S", 1.0)
    monkeypatch.setattr("evopolicy_worker.slots.slot._CHECK_S", 0.2)
    with slots.running() as slot, pytest.raises(SlotDiedError):
        stopped(slots, slot, "environment", 5.0, stateful(0.7), limits=TIGHT)


def test_where_a_policy_may_stop_itself_the_time_counts(slots: Slots) -> None:
    source = misbehaving(act="os.kill(os.getpid(), signal.SIGSTOP)")
    failure = failure_of(slots.play(source, tier="none", limits=TIGHT))
    assert failure.category == "act_timeout"


COMPUTES = acting(
    """
        self.n += 1
        if self.n == 4:
            time.sleep(PAUSE)
            OTHERS
            end = time.thread_time() + MINE
            while time.thread_time() < end:
                pass
        return [0.0]
    """,
    init="self.n = 0",
    before="import time, threading",
)


@pytest.mark.system
def test_no_wall_limit_counts_time_without_a_processor(slots: Slots) -> None:
    slot = slots.slot()
    # Long enough to be moved in, well within what an answer may take.
    source = COMPUTES.replace("PAUSE", "1.5").replace("OTHERS", "pass").replace("MINE", "0.02")

    async def work() -> tuple[EpisodeOutcome, ...]:
        task = await begun(slot, slots, source, limits=LESS_TIGHT)
        pid = family(pid_of(slot))[-1]
        group.add(pid)
        os.sched_setaffinity(pid, {0})
        return await asyncio.wait_for(task, 100)

    with starved() as group:
        busy = "import os; os.sched_setaffinity(0, {0})\nwhile True: pass"
        hog = subprocess.Popen([sys.executable, "-c", busy])
        try:
            (outcome,) = slots.run(work())
        finally:
            hog.kill()
            hog.wait()
    # Its fiftieth of a second took longer than an answer may.
    assert outcome.wall_s > 1.5 + LESS_TIGHT.act_wall_s
    assert outcome.failure is None


def test_a_policy_that_waits_for_its_own_threads_is_not_excused(slots: Slots) -> None:
    threads = "[threading.Thread(target=lambda: [None for _ in iter(int, 1)], daemon=True).start() for _ in range(6)]"
    source = COMPUTES.replace("PAUSE", "0.3").replace("OTHERS", threads).replace("MINE", "30")
    failure = failure_of(slots.play(source, limits=TIGHT))
    assert failure.category in ("act_timeout", "cpu_limit")
    assert failure.used is not None
    assert failure.used < 10


def eats(n_bytes: int) -> str:
    return misbehaving(
        act=f"time.sleep(2)\n            self.a = bytes({n_bytes}).replace(bytes(1), b'x')"
    ).replace("def __init__", "again = os.path.exists('x')\n\n    def __init__")


@pytest.mark.parametrize(
    ("eaten", "limit", "category"), [(100 << 20, 48 << 20, "oom"), (12 << 20, 4 << 20, None)]
)
def test_a_policy_killed_for_its_own_memory_has_failed(
    slots: Slots, eaten: int, limit: int, category: str | None
) -> None:
    slot = slots.slot()
    slot._stderr.clear()
    with limited(limit) as group:
        (outcome,) = slots.run(struck(slot, slots, lambda pids: group.add(pids[-1]), eats(eaten)))
    assert category_of(outcome) == category
    if outcome.failure is not None:
        assert outcome.failure.limit == PATIENT.memory_bytes
    else:
        assert any("a policy is started again" in line for line in slot._stderr)
    assert slots.play(HONEST).failure is None
