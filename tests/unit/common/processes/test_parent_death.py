"""Programs end with the process that started them."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

from machines.own_processes import alive
from program_runs import run_program

from evopolicy_common.processes import parent_death


def test_a_program_with_a_parent_death_signal_ends_with_its_parent() -> None:
    parent = """
import subprocess, sys, time
from evopolicy_common.processes.parent_death import ending_with_parent
child = subprocess.Popen(ending_with_parent([sys.executable, "-c", "print('up', flush=True); import time; time.sleep(1000)"]))
print(child.pid, flush=True)
time.sleep(1000)
"""  # noqa: E501
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = sorted(process.stdout.readline().strip() for _ in range(2))
    child = int(lines[0])
    assert lines[1] == "up"
    assert alive(child)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    deadline = time.monotonic() + 20
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(child)


def test_a_program_whose_parent_is_gone_does_not_start() -> None:
    done = run_program(sys.executable, parent_death.__file__, "1", "9", "", "/bin/echo", "started")
    assert (done.returncode, done.stdout) == (1, "")


def test_a_program_that_is_not_there_is_reported_in_one_line() -> None:
    done = run_program(*parent_death.ending_with_parent(["/no/such/program"]))
    assert done.returncode == 127
    assert done.stderr == "cannot start /no/such/program: No such file or directory\n"
