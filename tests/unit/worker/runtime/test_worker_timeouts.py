"""Every timeout of the worker's fires: what it waits for never comes, and it says so or takes it down."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from program_runs import put_program
from slots import HONEST, QUICK, Slots, acting, make_job

from evopolicy_common.errors import SandboxError, SlotDiedError, WorkerError
from evopolicy_worker import doctor, environments
from evopolicy_worker.episodes import policy_process, video
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policy_process import PolicyProcess
from evopolicy_worker.sandbox import jail, zygote
from evopolicy_worker.sandbox.zygote import ForkedPolicy, Zygote
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slots import slot

SOON_S = 0.2


@pytest.fixture
def found(tmp_path: Path) -> Iterator[Zygote]:
    """A zygote without a sandbox, as tier `none` has it."""
    with contextlib.closing(Zygote(jail.plan("none", tmp_path, ("numpy",)), tmp_path)) as made:
        yield made


def test_a_zygote_that_does_not_start_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zygote, "START_TIMEOUT_S", SOON_S)
    mute = jail.PolicyJail(command=("sleep", "1000"), config={}, home=None, user=None)
    with pytest.raises(SandboxError, match="does not start: timed out"):
        Zygote(mute, tmp_path)


def test_a_zygote_that_stands_still_has_died(found: Zygote, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zygote, "ANSWER_TIMEOUT_S", SOON_S)
    os.kill(found._process.pid, signal.SIGSTOP)
    with pytest.raises(SlotDiedError, match="timed out"):
        found.spawn()


def test_a_zygote_whose_worker_is_gone_ends_by_itself(found: Zygote) -> None:
    found.bury_later(found.spawn())
    found.bury()
    found._control.close()
    assert found._process.wait(60) == 0


def test_a_policys_process_that_survives_being_killed_is_reported(
    found: Zygote, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zygote, "DEATH_TIMEOUT_S", SOON_S)
    child = found.spawn()
    monkeypatch.setattr(ForkedPolicy, "kill", lambda self: None)
    found.bury_later(child)
    with pytest.raises(SandboxError, match="does not end"):
        found.bury()
    monkeypatch.undo()
    child.kill()


def test_a_child_that_does_not_seal_itself_is_killed(
    found: Zygote, monitor: Monitor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy_process, "_SEAL_S", SOON_S)
    child = found.spawn()
    os.kill(child.host_pid, signal.SIGSTOP)
    none = jail.plan("none", tmp_path, ("numpy",))
    policy = PolicyProcess(found, child, monitor, none, QUICK, str(tmp_path))
    description = environments.describe("toy/line")
    meta = {"obs_space": description.obs_space, "action_space": description.action_space}
    with pytest.raises(SandboxError, match="could not seal itself"):
        policy.seal(messages.BundleFiles([], b""), bytes(16), meta, "arrays")
    assert policy.dead
    policy.end()


@pytest.mark.parametrize("options", [{}, {"policy_scope": "submit", "first": 0, "n": 2}])
def test_a_policy_that_holds_its_output_is_not_awaited(slots: Slots, options: dict[str, Any]) -> None:
    held = """
        import sys, time
        class Held:
            def write(self, text): pass
            def flush(self): time.sleep(1000)
    """
    outcomes = slots.play_all(acting(reset="sys.stdout = Held()", before=held), **options)
    assert outcomes[0].failure is None
    assert slots.play(HONEST).failure is None


def test_a_slot_that_does_not_start_is_ended(slots: Slots, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slot, "START_TIMEOUT_S", 0.001)
    new = slots.new()
    with pytest.raises(WorkerError, match="did not start"):
        slots.run(new.start())
    assert new._process is None


def test_a_slot_that_does_not_heed_a_cancel_is_ended(slots: Slots, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slot, "CANCEL_TIMEOUT_S", SOON_S)
    own = slots.new("none")
    slots.run(own.start())
    assert own._process is not None
    os.kill(own._process.pid, signal.SIGSTOP)

    async def cancelled() -> None:
        job = make_job(bundle=None, tier="none")
        playing = asyncio.create_task(own.play_job(job, None, lambda *progress: None))
        while own._idle.is_set():
            await asyncio.sleep(0)
        await own.cancel()
        with pytest.raises(SlotDiedError):
            await playing
        await own.close()

    slots.run(cancelled())


def test_a_slot_process_that_hangs_up_is_reported(slots: Slots, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slot, "LAST_WORDS_S", SOON_S)
    own = slots.new("none")

    async def last_words() -> str:
        own._process = await asyncio.create_subprocess_exec("sleep", "1000", start_new_session=True)
        try:
            return await own._last_words()
        finally:
            await own.close()

    assert "ended with status ?" in slots.run(last_words())


@pytest.mark.parametrize(("bound", "frames"), [("start_s", 0), ("frame_s", 1), ("MAX_S", 1)])
def test_a_video_that_takes_too_long_is_done_without(
    bound: str, frames: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    allowed: dict[str, Any] = {"start_s": 0.0, "frame_s": 0.0} if bound != "MAX_S" else {}
    if bound == "MAX_S":
        monkeypatch.setattr(video, "MAX_S", 0.0)
    recorder = video.VideoRecorder(**allowed)
    run, waits = subprocess.Popen, [sys.executable, "-c", "input()"]
    monkeypatch.setattr(subprocess, "Popen", lambda words, **more: run(waits, **more))
    description = environments.describe("toy/maze")
    assert description.renders
    case = make_job().episodes[0].case
    assert recorder.record(description, case, b"", frames, lambda: False) is None
    assert "it took too long" in capfd.readouterr().err
    recorder.close()


def test_a_bubblewrap_that_does_not_answer_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "_TIMEOUT_S", SOON_S)
    put_program(tmp_path / "bwrap", "exec sleep 1000")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    version, why = doctor._bubblewrap()
    assert (version, "timed out" in why) == ("", True)
