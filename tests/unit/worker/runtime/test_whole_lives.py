"""Whole lives of a slot, an episode, and a zygote with its policies, as the tables at the head of their files say."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
from slots import HONEST, STUCK, Slots, begun, make_job, misbehaving, pid_of

from evopolicy_common.errors import SlotDiedError
from evopolicy_worker.environments.families.toy import MassOnLine
from evopolicy_worker.episodes import loop
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policies import RunningJob
from evopolicy_worker.sandbox import jail
from evopolicy_worker.sandbox.inside import policy_server
from evopolicy_worker.sandbox.zygote import Zygote
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slots.slot import Slot, bundle_files


def test_a_slots_whole_life(slots: Slots, monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    send, hear = Slot._send, Slot._reply

    async def sent(slot: Slot, message: messages.SlotMessage) -> None:
        lines.append(f"> {type(message).__name__}")
        await send(slot, message)

    async def heard(slot: Slot) -> messages.Reply:
        reply = await hear(slot)
        if not isinstance(reply, messages.JobProgress):
            lines.append(f"< {type(reply).__name__}")
        return reply

    monkeypatch.setattr(Slot, "_send", sent)
    monkeypatch.setattr(Slot, "_reply", heard)
    slot = slots.new()

    async def life() -> None:
        await slot.prepare(["toy/line"])
        assert len(await slot.play_job(make_job(n=2), slots.bundle(HONEST), lambda *progress: None)) == 2
        stuck = await begun(slot, slots, STUCK)
        await slot.cancel()
        assert await stuck == ()
        stuck = await begun(slot, slots, STUCK)
        os.kill(pid_of(slot), signal.SIGKILL)
        with pytest.raises(SlotDiedError):
            await stuck
        await slot.prepare([])
        lines.append("it is not started again by itself")
        await slot.start()
        await slot.close()
        assert slot._process is None

    slots.run(life())
    assert " ".join(lines) == (
        "> SlotStart < SlotReady > Describe < Described"
        " > Play < Acting < Finished < Acting < Finished < Played"
        " > Play > Cancel < Played"
        " > Play it is not started again by itself"
        " > SlotStart < SlotReady"
    )


def test_an_episodes_whole_life(
    tmp_path: Path, slots: Slots, monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three episodes: an honest one, one whose policy fails, and one whose environment breaks down on an action."""
    lines: list[str] = []
    begin, source, step = loop._Episode._begin, loop._Episode._source, MassOnLine.step

    def begins(episode: loop._Episode) -> Any:
        lines.append("begin")
        return begin(episode)

    def chosen(episode: loop._Episode, policy: Any, recorded: Any = None) -> loop.Source:
        lines.append("random" if policy is None else "asked")
        return source(episode, policy, recorded)

    def stepped(environment: MassOnLine, action: Any) -> Any:
        if float(action[0]) == 1.0:
            lines.append("breaks")
            raise RuntimeError("unknown element")
        return step(environment, action)

    monkeypatch.setattr(loop._Episode, "_begin", begins)
    monkeypatch.setattr(loop._Episode, "_source", chosen)
    monkeypatch.setattr(MassOnLine, "step", stepped)
    plan = jail.plan("none", tmp_path, ("numpy",))
    zygote = Zygote(plan, tmp_path)

    def told(frame: bytes) -> None:
        lines.append(type(messages.replies.decode(frame[messages.LENGTH.size :])).__name__)

    policy = misbehaving(
        reset="self.n, self.episode = 0, episode_index",
        act="if self.episode > 1: return [1.0] if self.episode == 3 else 1 / 0",
    )
    player = loop.JobPlayer(zygote, plan, monitor, tmp_path)
    try:
        bundle = bundle_files(slots.bundle(policy))
        told(player.play_job(make_job(tier="none", n=3), bundle, RunningJob(), told))
    finally:
        zygote.close()
    assert " ".join(lines) == (
        "begin asked Acting Finished"
        " begin asked Acting random Finished"
        " begin asked Acting breaks random Finished"
    )


def test_a_zygotes_whole_life(tmp_path: Path) -> None:
    zygote = Zygote(jail.plan("none", tmp_path, ("numpy",)), tmp_path)
    child = zygote.spawn()
    os.write(child.requests, policy_server.REQUEST_HEADER.pack(0, policy_server.ACT, 0))
    _, tag = policy_server.REPLY_HEADER.unpack(os.read(child.replies, policy_server.REPLY_HEADER.size))
    assert tag == policy_server.FAULT
    assert b"the first request is not INIT" in os.read(child.replies, 1000)
    assert zygote.wait(child).describe() == "exited with status 71"
    child.close()
    child = zygote.spawn()
    child.kill()
    assert zygote.wait(child).describe() == "was ended by SIGKILL"
    child.close()
    zygote.close()
    assert zygote._process.returncode == 0
    with pytest.raises(SlotDiedError, match="zygote is gone"):
        zygote.spawn()
