"""A job's reports of progress end before its last answer, whatever the monitor's thread is doing then."""

from __future__ import annotations

import os

import pytest

from evopolicy_worker.environments.interface.calls import USUAL
from evopolicy_worker.episodes.env_process import Channel, EnvProcess
from evopolicy_worker.episodes.policies import RunningJob
from evopolicy_worker.slot_protocol import slot_messages as messages


@pytest.mark.parametrize("given_up", [False, True])
def test_a_monitor_that_still_sees_a_finished_job_reports_nothing(given_up: bool) -> None:
    commands, commands_in = os.pipe()
    replies, replies_in = os.pipe()
    process = EnvProcess(Channel(commands, replies_in), commands, USUAL)
    process._progress = progress = RunningJob()
    progress.steps = 7
    if given_up:
        progress.give_up(None)
    process._check_and_report()
    for fd in (replies_in, commands_in, commands):
        os.close(fd)
    with open(replies, "rb") as sent:
        frames = messages.unframed(bytearray(sent.read()))
    expected = [] if given_up else [messages.JobProgress(episodes_done=0, steps=7)]
    assert [messages.replies.decode(frame) for frame in frames] == expected
