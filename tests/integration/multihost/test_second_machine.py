"""The five lines of docs/how-to/second-machine.md, run as they stand on two hosts with nothing in common but a
cable."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from machines import hosts
from machines.hosts import Host

from evopolicy_common.records.run_record import decode_run_record

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(900)]

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "second-machine.md"
FIRST = "10.92.1.1"
TIMEOUT_S = 300.0


class Machine:
    """A host, and the home of the one who sits at it: the only folder that is known there."""

    def __init__(self, host: Host, home: Path) -> None:
        self.host = host
        self.home = home

    def _words(self, line: str) -> list[str]:
        # Ours are on the PATH, and no setting of whoever runs the tests is seen.
        settings = {"HOME": str(self.home), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        clean = ["env", "-u", "XDG_STATE_HOME", "-u", "EVOPOLICY_STATE"]
        clean += [f"{name}={value}" for name, value in settings.items()]
        return [*clean, "bash", "-c", f"cd {self.home} && {line}"]

    def leave_running(self, line: str, log: str) -> subprocess.Popen[bytes]:
        return self.host.start(self._words(f"exec {line}"), self.home / log)

    def says(self, line: str) -> str:
        done = subprocess.run(
            [*self.host.enter, *self._words(line)],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@pytest.fixture
def machines() -> Iterator[tuple[Machine, Machine]]:
    hosts.require()
    with tempfile.TemporaryDirectory(prefix="evs-", dir="/tmp") as root, hosts.network() as network:
        first, second = (Machine(network.host(name), Path(root, name)) for name in ("first", "second"))
        network.cable(first.host, f"{FIRST}/24", second.host, "10.92.1.2/24")
        for machine in (first, second):
            machine.home.mkdir(mode=0o700)
        first.host.hide(second.home)
        second.host.hide(first.home)
        yield first, second


def lines() -> list[str]:
    """The block of commands, without what is said about them."""
    block = PAGE.read_text().split("```\n")[1]
    return [line.partition("#")[0].strip().replace("FIRST", FIRST) for line in block.splitlines()]


def wait(first: Machine, worker: str, running: subprocess.Popen[bytes], log: Path) -> None:
    """Until the coordinator knows the worker."""
    deadline = time.monotonic() + TIMEOUT_S
    while True:
        document = json.loads(first.says("evopolicy status --json"))
        if any(one["worker"].startswith(worker) and one["state"] == "active" for one in document["workers"]):
            return
        assert running.poll() is None, log.read_text()
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(1)


def test_the_readmes_five_lines_bring_in_a_second_machine(machines: tuple[Machine, Machine]) -> None:
    first, second = machines
    init, listen, issue, carry, join = lines()
    first.says(init)
    coordinator = first.leave_running(listen, "coordinator.log")
    first.says(issue)
    # There is no SSH between the two; the command's own words say what goes where.
    assert carry.split()[:3] == ["scp", "-rp", "worker-second"]
    shutil.copytree(first.home / "worker-second", second.home / "worker-second")
    worker = second.leave_running(join, "worker.log")
    wait(first, "second", worker, second.home / "worker.log")
    assert coordinator.poll() is None
    first.says(
        "evopolicy run --env gym/continuouscar --agent random --runs runs --entry e --exp-id x"
        " --budget 1 --validation 1 --heldout 1"
    )
    run = first.home / "runs" / "e" / "gym_continuouscar" / "x" / "run.json"
    assert decode_run_record(run.read_bytes()).outcome.status == "completed"
    assert re.search(r"^second +worker ", first.says("evopolicy-coordinator certs list"), re.MULTILINE)


def test_a_worker_that_is_there_before_its_coordinator_waits_and_joins(
    machines: tuple[Machine, Machine],
) -> None:
    first, second = machines
    init, listen, issue, _, join = lines()
    first.says(init)
    first.says(issue)
    shutil.copytree(first.home / "worker-second", second.home / "worker-second")
    log = second.home / "worker.log"
    worker = second.leave_running(join.replace("core16", "toy"), log.name)
    deadline = time.monotonic() + TIMEOUT_S
    while not log.read_bytes():
        assert worker.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    time.sleep(3)  # a few of its tries
    assert worker.poll() is None, log.read_text()
    first.leave_running(listen, "coordinator.log")
    deadline = time.monotonic() + TIMEOUT_S
    while "ready: " not in (output := (first.home / "coordinator.log").read_text()):
        assert time.monotonic() < deadline, output
        time.sleep(0.1)
    wait(first, "second", worker, log)
