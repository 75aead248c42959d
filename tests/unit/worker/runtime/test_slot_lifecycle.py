"""Starting, cancelling, dying, starting again: what the supervisor relies on."""

from __future__ import annotations

import asyncio
import os
import re
import signal
from asyncio.base_subprocess import BaseSubprocessTransport
from pathlib import Path

import pytest
from program_runs import put_program
from slots import HONEST, STUCK, Slots, begun, failure_of, family, make_job, pid_of, runs
from waiting import wait_until

from evopolicy_common.errors import SandboxError, SlotDiedError, WorkerError
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.processes import distribution
from evopolicy_worker.sandbox import jail
from evopolicy_worker.slots.slot import Slot, available_tiers, why_not


def test_a_cancelled_job_returns_at_once_and_the_slot_plays_the_next(slots: Slots) -> None:
    slot = slots.slot()

    async def work() -> tuple[EpisodeOutcome, ...]:
        task = await begun(slot, slots, STUCK)
        pid = pid_of(slot)
        await slot.cancel()
        assert await asyncio.wait_for(task, 5) == ()
        assert pid_of(slot) == pid
        await slot.cancel()  # nothing runs: no effect
        return await slot.play_job(make_job(), slots.bundle(HONEST), lambda episodes, steps: None)

    (outcome,) = slots.run(work())
    assert outcome.failure is None


def test_an_episode_of_random_actions_can_be_cancelled_too(slots: Slots) -> None:
    slot = slots.slot()

    async def work() -> None:
        job = make_job(bundle=None, n=20_000, policy_scope="submit")
        task = asyncio.create_task(slot.play_job(job, None, lambda episodes, steps: None))
        await asyncio.sleep(0.2)
        await slot.cancel()
        assert await asyncio.wait_for(task, 10) == ()

    slots.run(work())
    assert slots.play(HONEST).failure is None


def test_progress_is_reported_while_a_job_runs(slots: Slots) -> None:
    reports: list[tuple[int, int]] = []
    policy = HONEST.replace("return [", "import time; time.sleep(0.01); return [")
    slot = slots.slot()
    job = make_job(n=2, policy_scope="submit")
    slots.run(slot.play_job(job, slots.bundle(policy), lambda *progress: reports.append(progress)))
    assert reports == sorted(reports)
    assert any(0 < steps < 120 for _, steps in reports)
    assert any(done == 1 for done, _ in reports)


@pytest.mark.parametrize("victim", ["env process", "zygote"])
def test_a_dead_slot_process_is_reported_and_restarted(slots: Slots, victim: str) -> None:
    slot = slots.new()

    async def work() -> tuple[EpisodeOutcome, ...]:
        await slot.start()
        task = await begun(slot, slots, STUCK)
        members = family(pid_of(slot))
        # bwrap and its children stand between the environment's process and the policy's, which is the last.
        os.kill(members[0] if victim == "env process" else members[-3], signal.SIGKILL)
        with pytest.raises(SlotDiedError if victim == "env process" else SandboxError):
            await asyncio.wait_for(task, 30)
        await slot.start()
        assert not [pid for pid in members if runs(pid)]
        return await slot.play_job(make_job(), slots.bundle(HONEST), lambda episodes, steps: None)

    (outcome,) = slots.run(work())
    assert outcome.failure is None
    slots.run(slot.close())


def test_a_closed_slot_leaves_no_process_and_no_file(slots: Slots) -> None:
    slot = slots.new()
    slots.run(slot.start())
    members = family(pid_of(slot))
    assert len(members) > 3
    slots.run(slot.close())
    slots.run(slot.close())
    wait_until(lambda: not any(map(runs, members)))
    assert not slot._scratch.exists()


def test_a_start_that_is_cancelled_leaves_neither_half_of_bubblewrap(
    slots: Slots, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pid_file = tmp_path / "pid"
    text = f"sleep 1000 & echo $! > {pid_file}.new; mv {pid_file}.new {pid_file}; wait"
    put_program(tmp_path / "bwrap", text)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    connect = BaseSubprocessTransport._connect_pipes

    async def connect_late(transport: BaseSubprocessTransport, waiter: object) -> None:
        while not pid_file.exists():
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)
        await connect(transport, waiter)

    monkeypatch.setattr(BaseSubprocessTransport, "_connect_pipes", connect_late)

    async def cancelled() -> None:
        start = asyncio.create_task(slots.new().start())
        while not pid_file.exists():
            await asyncio.sleep(0.01)
        start.cancel()
        await asyncio.gather(start, return_exceptions=True)

    slots.run(cancelled())
    second = int(pid_file.read_text())
    try:
        wait_until(lambda: not runs(second))
    except AssertionError:
        os.kill(second, signal.SIGKILL)
        raise


def test_without_an_own_file_system_the_policys_folder_is_removed(slots: Slots) -> None:
    for _ in range(3):
        slots.play(HONEST, tier="landlock")
    folders = list((slots.slot("landlock")._scratch / "policies").iterdir())
    assert len(folders) <= 1


def test_a_slot_that_was_not_started_says_so(slots: Slots) -> None:
    with pytest.raises(WorkerError, match="not started"):
        slots.run(slots.new().play_job(make_job(), None, lambda episodes, steps: None))


def test_a_job_of_another_tier_is_never_played_in_this_one(slots: Slots) -> None:
    with pytest.raises(WorkerError, match="demands tier bwrap; this slot has landlock"):
        slots.play(HONEST, tier="bwrap", slot=slots.slot("landlock"))


def test_an_unknown_environment_is_the_workers_failure_and_leaves_the_slot_usable(slots: Slots) -> None:
    with pytest.raises(WorkerError, match="toy/none"):
        slots.play(HONEST, env="toy/none")
    assert slots.play(HONEST).failure is None


def test_without_bubblewrap_the_error_says_what_to_install(
    slots: Slots, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    slot = slots.new()
    with pytest.raises(SandboxError, match=re.escape(distribution.install("bubblewrap"))):
        slots.run(slot.start())
    why_not.cache_clear()
    assert "bwrap" not in available_tiers()
    assert distribution.install("bubblewrap") in str(why_not("bwrap"))
    why_not.cache_clear()


def test_working_tiers_are_offered_and_none_only_on_request() -> None:
    assert available_tiers()[0] == "bwrap"
    assert "none" not in available_tiers()
    assert available_tiers(unsandboxed=True) == (*available_tiers(), "none")


def test_a_package_that_is_not_installed_is_named(tmp_path: Path) -> None:
    with pytest.raises(SandboxError, match="'no_such_package'"):
        jail.plan("bwrap", tmp_path, ("numpy", "no_such_package"))


def test_an_allowed_package_can_be_imported_with_what_it_needs(slots: Slots) -> None:
    with slots.running(Slot(None, "bwrap", slots.folder / "with-yaml", ("numpy", "msgpack"))) as slot:
        policy = "import msgpack\n" + HONEST
        assert slots.play(policy, slot=slot).failure is None
        failure = failure_of(slots.play(policy))
        assert failure.category == "import_error"
