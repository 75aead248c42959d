"""A state folder's disk that is full once the budget is spent costs neither the run nor a second agent."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import SMALL, agent, command, record_in, run_dir
from waiting import wait_until

pytestmark = pytest.mark.system

AGENT = """
open("starts", "a").write("x")
submit([0, 1, 2, 3, 4, 5])
open("spent", "w").close()
while not os.path.exists("full"):
    time.sleep(0.05)
"""
DOUBLE = """
import os, sqlite3

class Full(sqlite3.Connection):
    def execute(self, statement, *more):
        if statement.startswith(("BEGIN IMMEDIATE", "UPDATE")) and os.path.exists({flag!r}):
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorcode = sqlite3.SQLITE_FULL
            raise error
        return super().execute(statement, *more)

connect = sqlite3.connect
sqlite3.connect = lambda *given, **named: connect(*given, factory=Full, **named)
"""
"""Of SQLite: it cannot write while the file `flag` is there."""


class Disk:
    """The disk of the state folder `place`, which is full inside `full`."""

    def __init__(self, root: Path, place: Path) -> None:
        self.place, self._flag = place, root / "flag"
        self.is_double = not os.path.ismount(place)

    @contextlib.contextmanager
    def full(self) -> Iterator[None]:
        ballast, size = self._flag if self.is_double else self.place / "ballast", 1 << 20
        with ballast.open("wb", buffering=0) as file:
            while size and not self.is_double:
                try:
                    file.write(bytes(size))
                except OSError:  # no space is left
                    size //= 2
        yield
        ballast.unlink()


@pytest.fixture(params=["double", pytest.param("mounted", marks=pytest.mark.root)])
def disk(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    place = tmp_path / "disk"
    place.mkdir(mode=0o700)
    if request.param == "double":
        (tmp_path / "sitecustomize.py").write_text(DOUBLE.format(flag=str(tmp_path / "flag")))
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path[1:]]))
        yield Disk(tmp_path, place)
        return
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=48m,mode=700", "none", place], check=True)
    try:
        yield Disk(tmp_path, place)
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("interrupted", [False, True])
def test_a_full_state_disk_after_the_budget_costs_no_run(
    tmp_path: Path, disk: Disk, interrupted: bool
) -> None:
    given = ["--agent", agent(tmp_path, AGENT), "--exp-id", "t", "--state", str(disk.place / "st"), *SMALL]
    with command(tmp_path, "local", "--env", "toy/line", *given) as running:
        wait_until(lambda: [*(tmp_path / "runs").glob("*/*/t/workspace/spent")])
        workspace = run_dir(tmp_path) / "workspace"
        with disk.full():
            (workspace / "full").touch()
            wait_until(lambda: "Runs continue by themselves then" in running.text)
            assert f"make room in {disk.place / 'st'}, 64 MB or more" in running.text
            if interrupted:
                running.process.send_signal(signal.SIGINT)
                assert running.finish()[0] == 130
        if not interrupted:
            assert running.finish()[0] == 0, running.text
    if interrupted:
        assert "--resume --exp-id t" in running.text
        assert "completes the run without starting it" in running.text
        with command(tmp_path, "local", "--env", "toy/line", *given, "--resume") as running:
            assert running.finish()[0] == 0, running.text
    record = record_in(run_dir(tmp_path))
    assert (record.outcome.status, record.outcome.closed_reason) == ("completed", "budget_spent")
    assert (workspace / "starts").read_text() == "x", "the agent was started once"
