"""Notices of commands before they begin."""

from __future__ import annotations

import os

import pytest

from evopolicy_common.cli.conventions import setup_notices
from evopolicy_common.processes import notices
from evopolicy_common.processes.notices import MANY_SLOTS, notify_of_many_slots


def test_more_slots_than_cores_can_play_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    setup_notices()
    most = MANY_SLOTS * len(os.sched_getaffinity(0))
    notify_of_many_slots(most)
    assert capsys.readouterr().err == ""
    notify_of_many_slots(most + 1)
    assert f"{most + 1} slots on" in capsys.readouterr().err


async def test_a_reason_to_wait_is_worth_saying_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notices, "AFTER_S", 0.0)
    waiting = notices.Waiting()
    assert waiting.worth_saying("a worker")
    waiting.ended()
    assert not waiting.worth_saying("a worker")
    assert waiting.worth_saying("an agent to end")
    assert not waiting.worth_saying("")
    monkeypatch.setattr(notices, "AFTER_S", 1000.0)
    assert not waiting.worth_saying("a slot")  # a short wait
