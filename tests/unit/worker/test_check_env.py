"""`evopolicy-worker check-env`: verdicts, and environments that another installation plays."""

from __future__ import annotations

import secrets
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from evopolicy_worker.check_env import MOST_MEMORY_MB, CheckedEnvironment, InASlot
from evopolicy_worker.environments.checks import conformance
from evopolicy_worker.environments.checks.conformance import CheckResult

CARTPOLE, PENDULUM = "gymnasium/CartPole-v1", "gymnasium/Pendulum-v1"


def checked(env: str, memory_mb: int, fault: str = "") -> CheckedEnvironment:
    played = CheckResult(env=env, digest="d", fresh=True, reused=True)
    return CheckedEnvironment(played, played, InASlot(memory_mb=memory_mb, fault=fault))


def test_a_slot_that_needs_too_much_memory_is_a_fault() -> None:
    assert checked(CARTPOLE, MOST_MEMORY_MB).verdict == "ok"
    assert checked(CARTPOLE, 601).verdict == "its slot needs 601 MB; 600 are the limit"
    both = checked(CARTPOLE, 601, fault="in a slot: no")
    assert both.verdict == "in a slot: no; its slot needs 601 MB; 600 are the limit"


MARK = f"of test_check_env {secrets.token_hex()}".encode()
"""Other plays of the tests on this machine have processes of their own."""
BUSY = [sys.executable, "-S", "-c", f"while True: '{MARK.decode()}'"]


@pytest.mark.parametrize(
    ("play", "limit_s", "told"),
    [
        (lambda: time.sleep(1000), 0.5, "it hangs: it has used no processor time for 0.5 s"),
        (lambda: subprocess.run(BUSY, check=False), 2.0, "it was not done within 2 s of processor time"),
    ],
    ids=["hangs", "computes in another process"],
)
def test_an_idle_or_busy_environment_is_ended_with_its_processes(
    play: Callable[[], object], limit_s: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conformance, "TIMEOUT_S", limit_s)
    monkeypatch.setattr(conformance, "_POLL_S", 0.05)
    monkeypatch.setattr(conformance, "_WORKS_S", 0.0)
    monkeypatch.setattr(conformance, "play_checked", lambda env_id, steps: play())
    monkeypatch.setattr(conformance.registry, "load", lambda env_id: None)
    (played,) = conformance.play_all(["slow"], 1)
    assert played.faults == [told]
    assert not [each for each in Path("/proc").glob("[0-9]*") if MARK in _command_line(each)]


def _command_line(process: Path) -> bytes:
    try:
        return (process / "cmdline").read_bytes()
    except OSError:
        return b""


@pytest.mark.parametrize(
    ("turns", "passes_s", "uses_s", "then", "told"),
    [
        # A tenth of a processor, for almost an hour.
        (299, 10.0, 1.0, (0.0, 2.0), "processor time"),
        # As much as `while True: time.sleep(0.01)` uses.
        (3600, 1.0, 0.01, (1.0, 0.0), "not done within 3600 s"),
    ],
    ids=["waits for the processor", "only polls"],
)
def test_an_environment_has_an_hour_of_which_waiting_costs_little(
    monkeypatch: pytest.MonkeyPatch,
    turns: int,
    passes_s: float,
    uses_s: float,
    then: tuple[float, float],
    told: str,
) -> None:
    now = used = 0.0
    monkeypatch.setattr(conformance.proc, "family", lambda pid: [SimpleNamespace(cpu_s=used)])
    monkeypatch.setattr(time, "monotonic", lambda: now)
    limits = conformance._passed_limits(1)
    next(limits)
    for _ in range(turns):
        now, used = now + passes_s, used + uses_s
        assert next(limits) == ""
    now, used = now + then[0], used + then[1]
    assert told in next(limits)


def test_a_killed_check_leaves_no_environment() -> None:
    program = """
import sys, time
from evopolicy_worker.environments.checks import conformance
conformance.play_checked = lambda env_id, steps: (sys.__stderr__.write("plays\\n"), time.sleep(1000))
conformance.registry.load = lambda env_id: None
conformance.os.dup2 = lambda old, new: None
print(list(conformance.play_all(["slow"], 1)))
"""
    command = [sys.executable, "-c", program, MARK.decode()]
    started = subprocess.Popen(command, stderr=subprocess.PIPE)
    assert started.stderr is not None
    assert started.stderr.readline() == b"plays\n"
    started.kill()
    started.wait()
    # Closed by the last process that has it.
    assert started.stderr.read() == b""
    started.stderr.close()
    assert not [each for each in Path("/proc").glob("[0-9]*") if MARK in _command_line(each)]


def test_a_process_whose_environment_forbids_files_ends_and_is_no_second_check(tmp_path: Path) -> None:
    program = """
import os, resource, sys
from evopolicy_worker.environments.checks import conformance

def play(env_id, steps):
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    return conformance.CheckResult(env=env_id)

conformance.play_checked = play
conformance.registry.load = lambda env_id: None
log = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
try:
    (played,) = conformance.play_all(["greedy"], 1)
finally:
    os.write(log, b"went on\\n")
"""
    log = tmp_path / "log"
    subprocess.run([sys.executable, "-P", "-c", program, str(log)], check=True, timeout=60)
    assert log.read_bytes() == b"went on\n"
