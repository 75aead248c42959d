"""A hidden episode that is given back unfinished: what its policy had returned, and how it had failed, stands in the
next attempt."""

from __future__ import annotations

import asyncio
import errno
import itertools
import os
import signal
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from slots import HONEST, QUICK, STUCK, Slots, acting, failure_of, going_on, make_job, prefix, rows

from evopolicy_common.errors import SlotDiedError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, PolicyFailure
from evopolicy_common.records.blobs import digest_of
from evopolicy_worker.slot_protocol import begun
from evopolicy_worker.slots.slot import Slot

PATIENT = msgspec.structs.replace(QUICK, act_wall_s=30.0, episode_wall_s=60.0)

CLOCKED = acting(
    """
        self.n += 1
        AHEAD
        return [(time.time_ns() // 1000 % 1_000_000) / 1e6]
    """,
    init="self.n = 0",
    reset="self.n, self.e = 0, episode_index",
    before="import time",
)
SLOW = CLOCKED.replace("AHEAD", "time.sleep(0.03)")


def hidden(**options: Any) -> Job:
    return make_job(**{"record": "actions", "limits": PATIENT, **options})


def begun_by(actions: bytes, *more: bytes) -> bytes:
    """Actions as another worker may have reported them."""
    return msgspec.msgpack.encode({0: begun.PackedBegun(actions=actions, more=more), 7: begun.PackedBegun()})


async def stopped(
    slots: Slots, slot: Slot, job: Job, source: str, steps: int, episodes: int = 0
) -> tuple[EpisodeOutcome, ...]:
    """Plays the job, and stops it after some steps."""
    reached = asyncio.Event()

    def on_progress(episodes_done: int, n_steps: int) -> None:
        if episodes_done >= episodes and n_steps >= steps:
            reached.set()

    task = asyncio.create_task(slot.play_job(job, slots.bundle(source), on_progress))
    await asyncio.wait({task, asyncio.create_task(reached.wait())}, return_when=asyncio.FIRST_COMPLETED)
    await slot.cancel()
    return await asyncio.wait_for(task, 60)


def begin(slots: Slots, slot: Slot, job: Job, source: str, steps: int, episodes: int = 0) -> Job:
    """The job as it goes on after a stop."""
    assert slots.run(stopped(slots, slot, job, source, steps, episodes)) == ()
    return going_on(job, slot)


def end(slots: Slots, slot: Slot, job: Job, source: str) -> tuple[EpisodeOutcome, ...]:
    return slots.run(slot.play_job(job, slots.bundle(source), lambda *progress: None))


def actions(outcome: EpisodeOutcome) -> list[float]:
    return [float(row.action[0]) for row in rows(outcome)]


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_a_policy_that_uses_the_clock_draws_once_despite_stops(slots: Slots, tier: str) -> None:
    slot = slots.slot(tier)  # type: ignore[arg-type]
    job = hidden(tier=tier)
    thrown: list[list[float]] = []
    for _ in range(4):
        # A stop that comes before what stands is played again takes nothing away from it.
        job = begin(slots, slot, job, SLOW, 12)
        thrown.append(prefix(job))
    (outcome,) = end(slots, slot, job, SLOW)
    assert outcome.failure is None
    assert len(thrown[0]) >= 12
    for shorter, longer in itertools.pairwise([*thrown, actions(outcome)]):
        assert longer[: len(shorter)] == shorter


@pytest.mark.parametrize(
    "tier",
    [
        "bwrap",
        pytest.param("landlock", marks=pytest.mark.system),
        pytest.param("none", marks=pytest.mark.system),
    ],
)
def test_actions_stand_when_the_process_of_the_environment_is_killed(slots: Slots, tier: str) -> None:
    slot = slots.new(tier)  # type: ignore[arg-type]
    job = hidden(tier=tier)
    thrown: list[list[float]] = []

    async def killed(job: Job, steps: int) -> None:
        await slot.start()
        assert slot._process is not None
        reached = asyncio.Event()
        playing = asyncio.create_task(
            slot.play_job(job, slots.bundle(SLOW), lambda _, n: reached.set() if n >= steps else None)
        )
        await reached.wait()
        os.killpg(slot._process.pid, signal.SIGKILL)
        with pytest.raises(SlotDiedError):
            await playing

    try:
        # In the first attempt, in one that goes on from it, and in one that ends before it has caught up.
        for steps in (6, 14, 3):
            slots.run(killed(job, steps))
            job = going_on(job, slot)
            thrown.append(prefix(job))
    finally:
        slots.run(slot.close())
    assert [len(each) >= n for each, n in zip(thrown, (6, 14, 14), strict=True)] == [True] * 3
    assert thrown[1][: len(thrown[0])] == thrown[0]
    assert thrown[2] == thrown[1]


def test_a_failure_stands_and_so_do_the_episodes_before_it(slots: Slots) -> None:
    until = time.time() + 60.0
    fails = f"if self.e == 1 and self.n == 5 and time.time() < {until}: raise ValueError('unlucky')"
    source = SLOW.replace("time.sleep", f"{fails}\n        time.sleep")
    slot = slots.slot()
    job = begin(slots, slot, hidden(n=3, policy_scope="submit"), source, 70, episodes=1)
    known = begun.unpack(job)
    assert known[0].failure is not None
    # Now it would not fail any more.
    lucky = source.replace(str(until), "0")
    outcomes = end(slots, slot, job, lucky)
    failure = failure_of(outcomes[0])
    assert (failure.category, failure.step_index) == ("act_error", 4)
    assert actions(outcomes[0])[:4] == prefix(job, 0)
    assert actions(outcomes[1])[: len(prefix(job, 1))] == prefix(job, 1)
    assert outcomes[2].failure is None


def test_a_policy_that_fails_while_its_actions_are_played_again_keeps_them(slots: Slots) -> None:
    slot = slots.slot()
    job = begin(slots, slot, hidden(), SLOW, 10)
    stands = prefix(job)
    fails = SLOW.replace("self.n += 1", "raise ValueError('I know what comes')")
    (outcome,) = end(slots, slot, job, fails)
    assert outcome.failure is not None
    assert actions(outcome)[: len(stands)] == stands
    # What follows are the random actions of any policy that fails.
    (other,) = slots.play_all(fails, record="actions", limits=PATIENT)
    follow = actions(outcome)[len(stands) :]
    assert follow == actions(other)[: len(follow)]


def test_an_honest_policy_comes_to_the_same_when_it_is_stopped(slots: Slots) -> None:
    source = HONEST.replace("return [", "import time; time.sleep(0.03); return [")
    slot = slots.slot()
    job = begin(slots, slot, hidden(), source, 10)
    (outcome,) = end(slots, slot, job, source)
    (whole,) = slots.play_all(HONEST, record="actions", limits=PATIENT)
    assert outcome.trajectory == whole.trajectory
    assert outcome.episode_return == whole.episode_return


def test_begun_actions_exist_only_for_returned_hidden_actions(slots: Slots) -> None:
    slot = slots.slot()

    async def at_once(job: Job, source: str) -> None:
        task = asyncio.create_task(slot.play_job(job, slots.bundle(source), lambda *progress: None))
        await asyncio.sleep(1.0)
        await slot.cancel()
        assert await task == ()

    slots.run(at_once(hidden(), STUCK))
    assert slot.begun is None
    slots.run(at_once(hidden(record="full"), CLOCKED.replace("AHEAD", "time.sleep(0.1)")))
    assert slot.begun is None
    assert slots.play(HONEST).failure is None


def test_a_failure_by_a_limit_is_reported_as_one(slots: Slots) -> None:
    limits = msgspec.structs.replace(PATIENT, act_wall_s=0.5)
    source = CLOCKED.replace("AHEAD", "time.sleep(9.0 if self.e == 1 and self.n == 3 else 0.03)")
    slot = slots.slot()
    job = hidden(n=2, policy_scope="submit", limits=limits)
    begin(slots, slot, job, source, 65, episodes=1)
    back = slot.begun
    assert back is not None
    assert back.limit_verdict


def test_the_file_of_an_episode_holds_actions_of_any_form_and_length(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, episode = begun.ActionLog(tmp_path), begun.RunningEpisode([(3, 3)])
    odd = [np.arange(3, dtype=np.int8), {"a": (np.float32(0.5), "x")}, "\ud800", 2**70]
    values = [*odd, *[[0.1] * 999] * 99]
    log.begins("job", 2, episode)
    for value in values:
        episode.add_action(value, value)
    assert begun.recovered(tmp_path, "other") == {}
    again = begun.recovered(tmp_path, "job")[2].unpacked()
    kept: list[Any] = [3, [0, 1, 2], {"a": [0.5, "x"]}, "\\ud800", 2**70, *values[4:]]
    array = again.taken[1][1]
    assert array.dtype == np.int8
    again.taken[1] = array, array.tolist()
    assert [action for _, action in again.taken] == kept
    # With the failure after them; and on a full disk, as far as there is room.
    episode.fail(PolicyFailure(category="act_error", step_index=7, message="unlucky"))
    assert begun.recovered(tmp_path, "job")[2].failure == episode.failure

    def no_room(*where: int) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(os, "posix_fallocate", no_room)
    episode = begun.RunningEpisode()
    log.begins("job", 0, episode)
    for number in range(600_000):
        episode.add_action(number, number)
    found = begun.recovered(tmp_path, "job")[0].unpacked().taken
    assert [action for _, action in found] == [*range(len(found))]
    assert 50_000 < len(found) < 600_000


@pytest.mark.parametrize(
    "data",
    [b"\xc1 none of it", begun_by(b"no recording"), begun_by(b""), begun_by(b"", b"\xc1")],
)
def test_what_cannot_be_read_is_begun_anew(slots: Slots, data: bytes) -> None:
    job = hidden(begun=BlobRef(digest=digest_of(data), size=len(data), inline=data))
    (outcome,) = end(slots, slots.slot(), job, HONEST)
    assert outcome.failure is None
