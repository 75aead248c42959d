"""Whoever reads a command's output may stop reading, as `head -1` does: the command ends quietly, as SIGPIPE would have
it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import SMALL, STILL
from documents import commands
from forked import Forks
from waiting import wait_until

from evopolicy_common.terminal import READER_GONE

MODULES = {
    "evopolicy": "evopolicy_gateway.cli",
    "evopolicy-coordinator": "evopolicy_coordinator.cli",
    "evopolicy-worker": "evopolicy_worker.cli",
}
TIMEOUT_S = 300


def closed(*words: str, lines: int = 0, cwd: Path | None = None) -> tuple[int, str]:
    """Exit status of a command whose output is read for so many lines and no further, and its stderr but for what it
    waits for."""
    reader, writer = os.pipe()
    program = [sys.executable, "-m", MODULES[words[0]], *words[1:]]
    if not lines:
        os.close(reader)
    process = subprocess.Popen(program, stdout=writer, stderr=subprocess.PIPE, cwd=cwd, text=True)
    os.close(writer)
    if lines:
        with os.fdopen(reader) as output:
            for _ in range(lines):
                assert output.readline()
    _, errors = process.communicate(timeout=TIMEOUT_S)
    lines_shown = [line for line in errors.splitlines(keepends=True) if not line.startswith("waiting for ")]
    return process.returncode, "".join(lines_shown)


FIRST = {name.split()[0]: name for name, _ in commands() if " " in name}
"""A command of each program: all print through `common/terminal.py` (tests/unit/test_rooms.py)."""


@pytest.mark.parametrize("name", [*FIRST.values()])
def test_a_command_ends_quietly_when_nobody_reads_it(name: str, forked: Forks) -> None:
    assert forked([*name.split(), "--help"], unread=True) == (READER_GONE, "", "")


@pytest.mark.parametrize("name", MODULES)
def test_every_program_ends_quietly_when_nobody_reads_it(name: str) -> None:
    assert closed(name, "--help") == (READER_GONE, "")


@pytest.mark.system
def test_results_that_nobody_reads_end_their_commands_quietly(tmp_path: Path) -> None:
    for command in (
        "evopolicy-coordinator certs init --state state --host there",
        "evopolicy-worker doctor",
        "evopolicy data make --env gym/acrobot --root splits",
        "evopolicy data check splits",
        "evopolicy-coordinator certs issue worker gpu-7 --state state --out issued",
        "evopolicy-coordinator certs list --state state",
        f"evopolicy try {STILL} --env toy/line --cases 0,1 --fresh",
    ):
        assert closed(*command.split(), cwd=tmp_path) == (READER_GONE, ""), command


@pytest.mark.system
def test_a_run_that_nobody_watches_any_more_ends_as_with_ctrl_c(tmp_path: Path) -> None:
    """It is cancelled; its cluster, gateway and agent end with it."""
    run = ["evopolicy", "local", "--env", "toy/line", "--agent", "evolve", "--exp-id", "t", *SMALL]
    run += ["--runs", str(tmp_path / "runs"), "--state", str(tmp_path / "state")]
    assert closed(*run, lines=1) == (READER_GONE, "")
    assert not [pid for pid in os.listdir("/proc") if pid.isdecimal() and mentions(int(pid), tmp_path)]


def test_a_command_without_streams_does_its_work_and_says_nothing_elsewhere(tmp_path: Path) -> None:
    evopolicy, coordinator = (
        f"{sys.executable} -m {MODULES[name]}" for name in ("evopolicy", "evopolicy-coordinator")
    )
    wrong = subprocess.run(
        ["sh", "-c", f"exec {evopolicy} diff a b 2>&-"], stdout=subprocess.PIPE, cwd=tmp_path
    )
    assert (wrong.returncode, wrong.stdout) == (2, b"")
    nowhere = subprocess.run(["sh", "-c", f"exec {evopolicy} --help <&- >&- 2>&-"])
    assert nowhere.returncode == 0
    ready = tmp_path / "ready"
    serve = f"exec {coordinator} --state {tmp_path / 's'} --ready-file {ready} <&- >&- 2>&-"
    process = subprocess.Popen(["sh", "-c", serve])
    try:
        wait_until(ready.exists)
        opened = [os.readlink(f"/proc/{process.pid}/fd/{fd}") for fd in range(3)]
    finally:
        process.terminate()
    assert (process.wait(), opened) == (0, [os.devnull] * 3)


def mentions(pid: int, folder: Path) -> bool:
    """Whether that process was started for that folder."""
    try:
        return os.fsencode(folder) in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def test_what_cannot_be_told_on_stderr_changes_no_exit_code(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    program = [sys.executable, "-m", MODULES["evopolicy"], "diff", str(tmp_path / "a"), str(tmp_path / "b")]
    assert subprocess.run(program, stderr=writer, stdout=writer).returncode == 2
    os.close(writer)
