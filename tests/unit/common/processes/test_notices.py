"""Notices of commands before they begin."""

from __future__ import annotations

import os

import pytest

from evopolicy_common.cli.conventions import setup_notices
from evopolicy_common.processes.notices import MANY_SLOTS, notify_of_many_slots


def test_more_slots_than_cores_can_play_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    setup_notices()
    most = MANY_SLOTS * len(os.sched_getaffinity(0))
    notify_of_many_slots(most)
    assert capsys.readouterr().err == ""
    notify_of_many_slots(most + 1)
    assert f"{most + 1} slots on" in capsys.readouterr().err
