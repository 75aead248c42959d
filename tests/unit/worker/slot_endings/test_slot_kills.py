"""Real kills of a slot's real processes: what shows in the episode, and whose failure it is."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal

import pytest
from slots import HONEST, Slots, begun, category_of, family, make_job, misbehaving, pid_of, rows
from stateful_policy import PATIENT, essence, in_its_pause, kill_policy, place_of_env, stateful, struck

from evopolicy_common.errors import BrokenEnvironmentError, SandboxError, SlotDiedError, WorkerError
from evopolicy_common.messages.episode import EpisodeOutcome, Tier

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_a_policy_killed_from_outside_restarts_unnoticed(slots: Slots, tier: str) -> None:
    slot = slots.slot(tier)  # type: ignore[arg-type]
    undisturbed = slots.play(stateful(0.0), tier=tier, limits=PATIENT)
    slot._stderr.clear()
    (disturbed,) = slots.run(struck(slot, slots, kill_policy, tier=tier))
    assert undisturbed.failure is None
    assert essence(disturbed) == essence(undisturbed)
    assert any("a policy is started again" in line for line in slot._stderr)


@pytest.mark.parametrize(
    "tier", ["bwrap", *(pytest.param(k, marks=pytest.mark.system) for k in ("landlock", "none"))]
)
def test_a_batch_systems_sigterm_to_every_process_ends_nothing(slots: Slots, tier: str) -> None:
    undisturbed = slots.play(stateful(0.0), tier=tier, limits=PATIENT)
    slot = slots.slot(tier)  # type: ignore[arg-type]
    slot._stderr.clear()

    def strike(pids: list[int]) -> None:
        for pid in pids:
            os.kill(pid, signal.SIGTERM)

    (disturbed,) = slots.run(struck(slot, slots, strike, stateful(2.0), tier=tier))
    assert disturbed.failure is None
    assert essence(disturbed) == essence(undisturbed)
    assert not any("started again" in line for line in slot._stderr)


def test_where_a_policy_may_signal_itself_a_kill_is_its_own(slots: Slots) -> None:
    (outcome,) = slots.run(struck(slots.slot("none"), slots, kill_policy, tier="none"))
    assert category_of(outcome) == "killed"
    assert outcome.length == 60


def test_a_killed_policy_of_several_episodes_is_played_elsewhere(slots: Slots) -> None:
    with pytest.raises(SandboxError, match="SIGKILL, and neither the policy nor a limit can have done that"):
        slots.run(struck(slots.slot(), slots, kill_policy, policy_scope="submit"))
    assert slots.play(HONEST).failure is None


def test_a_policy_that_is_killed_again_and_again_is_played_elsewhere(slots: Slots) -> None:
    slot = slots.slot()

    async def work() -> None:
        task = await begun(slot, slots, stateful(), limits=PATIENT)
        gone = 0
        while not task.done():
            *fixed, pid = family(pid_of(slot))
            # The slot's own processes are five.
            if pid != gone and len(fixed) >= 5:
                # It may be one that is on its way out, or on its way in.
                with contextlib.suppress(OSError):
                    await in_its_pause(slot, pid)
                    os.kill(pid, signal.SIGKILL)
                gone = pid
            await asyncio.sleep(0.05)
        with pytest.raises(SandboxError, match="neither the policy nor a limit"):
            await task

    slots.run(work())
    assert slots.play(HONEST).failure is None


def after(
    slots: Slots, number: int, place: int, source: str = "", *, tier: Tier = "bwrap", **options: object
) -> list[EpisodeOutcome]:
    """The outcome of a job when one process of its slot gets that signal in the policy's pause.

    `place`: in the slot's family, counted from the environment's process.
    """

    def strike(pids: list[int]) -> None:
        os.kill(pids[place_of_env(pids) + place], number)

    with slots.running(slots.new(tier)) as slot:
        return list(slots.run(struck(slot, slots, strike, source, tier=tier, **options)))


# Its two bubblewraps, the two parents of the zygote's as root, the zygote; the policy is the last.
@pytest.mark.parametrize("place", range(1, 6 if os.geteuid() == 0 else 4))
def test_every_end_of_the_sandbox_is_ours(slots: Slots, place: int) -> None:
    with pytest.raises(SandboxError, match="sandbox"):
        after(slots, signal.SIGKILL, place)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGUSR1])
def test_an_end_of_a_policys_parent_starts_the_policy_again(slots: Slots, number: int) -> None:
    undisturbed = slots.play(stateful(0.0), limits=PATIENT)
    (disturbed,) = after(slots, number, 6 if os.geteuid() == 0 else 4)
    assert essence(disturbed) == essence(undisturbed)


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_a_process_killed_before_its_policy_is_no_loss(slots: Slots, tier: str) -> None:
    slot = slots.slot(tier)  # type: ignore[arg-type]
    slots.play(HONEST, tier=tier)

    async def work() -> None:
        await asyncio.sleep(1.0)
        os.kill(family(pid_of(slot))[-1], signal.SIGKILL)

    slots.run(work())
    assert slots.play(HONEST, tier=tier).failure is None


SLOW = stateful(0.05, at=10).replace("self.n == 10", "self.n % 10 == 0")


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.system) for k in (1, 2))])
def test_an_episode_under_kills_and_stops_of_anything_is_the_same_episode(slots: Slots, seed: int) -> None:
    undisturbed = slots.play(SLOW, limits=PATIENT)
    dice = random.Random(seed)
    slot = slots.new()

    async def disturb() -> None:
        """One process of the slot after another, so that each episode is met once or twice."""
        for _ in range(4):
            await asyncio.sleep(dice.uniform(0.2, 1.0))
            with contextlib.suppress(OSError, AssertionError):
                victim = dice.choice(family(pid_of(slot)))
                if dice.random() < 0.5:
                    os.kill(victim, signal.SIGKILL)
                else:
                    os.kill(victim, signal.SIGSTOP)
                    await asyncio.sleep(dice.uniform(0.1, 1.0))
                    os.kill(victim, signal.SIGCONT)

    async def work() -> list[EpisodeOutcome]:
        outcomes: list[EpisodeOutcome] = []
        disturbing = asyncio.create_task(disturb())
        # As a worker does: what was ours is played again, in a new slot.
        while len(outcomes) < 2 or not disturbing.done():
            try:
                if slot._process is None:
                    await slot.start()
                outcomes += await slot.play_job(
                    make_job(limits=PATIENT), slots.bundle(SLOW), lambda *progress: None
                )
            except (SandboxError, WorkerError):
                await slot.close()
        await slot.close()
        return outcomes

    for outcome in slots.run(work()):
        assert essence(outcome) == essence(undisturbed)


def test_an_idle_sandboxs_end_costs_one_retry(slots: Slots) -> None:
    with slots.running() as slot:
        pids = family(pid_of(slot))
        os.kill(pids[place_of_env(pids) + 1], signal.SIGKILL)
        slots.run(asyncio.sleep(0.3))
        with pytest.raises(SandboxError):
            slots.play(HONEST, slot=slot)


@pytest.mark.parametrize(
    ("number", "place", "tier"),
    [
        *((number, 0, tier) for number in (signal.SIGKILL, signal.SIGUSR1) for tier in ("bwrap", "landlock")),
        *((signal.SIGKILL, place, "bwrap") for place in (-2, -1)),
    ],
)
def test_a_kill_of_the_environments_process_or_jail_is_ours(
    slots: Slots, number: int, place: int, tier: Tier
) -> None:
    with pytest.raises(SlotDiedError):
        after(slots, number, place, tier=tier)


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_an_environment_that_crashes_on_a_policys_actions_is_the_policys_failure(
    slots: Slots, tier: Tier
) -> None:
    # It crashes in the second of three episodes of one policy.
    source = (
        stateful()
        .replace("self.n += 1", "self.n += 1 if self.e == 1 else 0")
        .replace("self.seen.update(bytes([", "self.e = episode_index; self.seen.update(bytes([")
    )
    outcomes = after(slots, signal.SIGSEGV, 0, source, tier=tier, first=0, n=3, policy_scope="submit")
    assert [outcome.index for outcome in outcomes] == [0, 1, 2]
    failures = [outcome.failure for outcome in outcomes]
    assert [failure and failure.category for failure in failures] == [None, "killed", None]
    (alone,) = slots.play_all(misbehaving(reset="raise ValueError"), seed=8, tier=tier)
    assert outcomes[1].episode_return == alone.episode_return
    assert [len(rows(outcome)) for outcome in outcomes] == [60] * 3


def test_an_environment_that_crashes_before_a_policys_first_action_is_ours(slots: Slots) -> None:
    with pytest.raises(BrokenEnvironmentError, match="environment toy/line: its process ended while it"):
        after(slots, signal.SIGSEGV, 0, stateful(at=1))
