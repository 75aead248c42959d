"""The monitor of a policy's limits: without it nothing is played on."""

from __future__ import annotations

from program_runs import run_python

_PROGRAM = """
import os, time
from evopolicy_worker.episodes.monitor import Monitor

def bug():
    raise LookupError("a bug")

commands, writer = os.pipe()
monitor = Monitor(commands, bug, lambda: None)
monitor.start()
os.write(writer, b"x")
time.sleep(60)
"""


def test_a_monitor_that_fails_ends_its_process_with_the_reason() -> None:
    ended = run_python(_PROGRAM, timeout=50)
    assert ended.returncode == 1
    assert "LookupError: a bug" in ended.stderr
