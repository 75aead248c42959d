"""Ending whole process trees, in a process of its own that may adopt orphans."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from machines.own_processes import alive
from program_runs import run_python

from evopolicy_common.processes.proc import descendants
from evopolicy_gateway.processes.trees import end_orphans

SUPERVISOR = """
import os, subprocess, sys, time
from evopolicy_common.processes import proc
from evopolicy_gateway.processes import trees as processes
processes.become_subreaper()
stubborn = "import os, signal, time; signal.signal(15, signal.SIG_IGN); {} open(os.environ['N'] + str(os.getpid()), 'w'); time.sleep(1000)"
kinds = ["", "os.setsid() if os.getpgrp() != os.getpid() else 0;", "os.fork() and os._exit(0);",
         "os.fork() and os._exit(0); os.setsid(); os.fork() and os._exit(0);", "[os.fork() for _ in range(3)];"]
spared = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
mine = [subprocess.Popen([sys.executable, "-c", stubborn.format(kind)]) for kind in kinds]
wanted = 1 + 1 + 1 + 1 + 8
while len(os.listdir(os.environ["N"])) < wanted:
    time.sleep(0.01)
left = processes.end_descendants(0.05, spare={spared.pid})
assert left == [], left
assert proc.descendants(os.getpid()) == [spared.pid]
spared.kill()
spared.wait()
assert processes.end_descendants(0.0) == []
try:
    os.waitpid(-1, os.WNOHANG)
except ChildProcessError:
    print("nothing left")
"""  # noqa: E501


def test_nothing_below_survives_however_it_hides(tmp_path: Path) -> None:
    done = run_python(SUPERVISOR, env={**os.environ, "N": f"{tmp_path}/"})
    assert done.stdout == "nothing left\n", done.stderr
    assert not any(alive(int(path.name)) for path in tmp_path.iterdir())


def test_a_process_that_is_no_subreaper_ends_nobodys_children() -> None:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
    try:
        end_orphans(())
        assert child.poll() is None
        assert child.pid in descendants(os.getpid())
    finally:
        child.kill()
        child.wait()


BREEDER = """
import os, sys, time
# Starts a process at every moment, and tells if one of them was touched. It ends with its parent, too.
parent = os.getppid()
while not os.path.exists(sys.argv[1]) and os.getppid() == parent:
    pid = os.fork()
    if pid == 0:
        time.sleep(0.002)
        os._exit(0)
    _, status = os.waitpid(pid, os.WUNTRACED)
    if status:
        open(sys.argv[2], "w").write(str(status))
        break
"""

SEARCHER = """
import subprocess, sys
from evopolicy_gateway.processes import trees as processes
processes.become_subreaper()
breeder = subprocess.Popen([sys.executable, "-c", sys.argv[1], *sys.argv[2:]])
for _ in range(60):  # a search that looks twice at the processes touches one in every twentieth
    processes.end_orphans({breeder.pid})
open(sys.argv[2], "w").close()
sys.exit(breeder.wait())
"""


def test_children_of_a_spared_process_are_spared_too(tmp_path: Path) -> None:
    done, touched = tmp_path / "done", tmp_path / "touched"
    assert run_python(SEARCHER, BREEDER, done, touched, timeout=600).returncode == 0
    assert not touched.exists()


CHAIN = """
import os, time
# Each forks once and ends: at whatever moment one looks, all that one has seen are dead.
end = time.monotonic() + 30
while time.monotonic() < end:
    if os.fork():
        os._exit(0)
    os.setsid()
"""

HEADLESS = """
import ctypes, os, threading, time
threading.Thread(target=time.sleep, args=(30,)).start()
# The first thread ends alone: the system shows the process as a zombie.
ctypes.CDLL(None).syscall({"x86_64": 60, "aarch64": 93}[os.uname().machine], 0)
"""

ENDS = """
import os, subprocess, sys, time
from evopolicy_common.processes import proc
from evopolicy_gateway.processes import trees as processes
processes.become_subreaper()
child = subprocess.Popen([sys.executable, "-S", "-c", sys.argv[1]])
deadline = time.monotonic() + 20
while proc.stat(child.pid).state != "Z" and time.monotonic() < deadline:
    time.sleep(0.01)
left = processes.end_descendants(0.0)
found = set()
for _ in range(50):
    found.update(proc.family(os.getpid())[1:])
    time.sleep(0.002)
print(left, sorted(found))
"""


@pytest.mark.parametrize("program", [CHAIN, HEADLESS])
def test_a_process_that_looks_dead_does_not_survive(program: str) -> None:
    done = run_python(ENDS, program)
    assert done.stdout == "[] []\n", done.stdout + done.stderr
