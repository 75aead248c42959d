"""Agents that take all they can get of their machine: what bounds or ends them, and what is told of it.

Attacks, each with its defence:
- starts processes without end, takes all memory, fills shared memory or the disk: cgroups; bounded memory
  file systems, read-only elsewhere; measured files, deleted ones included.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from machines.filters import allowed
from stages.supervisor_process import TIMEOUT_S, SupervisorProcess

from evopolicy_common.processes import cgroups
from evopolicy_common.records.run_record import AgentLimits, AgentResources
from evopolicy_common.seccomp import ALLOW, ERRNO, SET_AFFINITY
from evopolicy_gateway.jail import entry
from evopolicy_gateway.jail.jail import JailOrder
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.jail.syscalls import filter_program
from evopolicy_gateway.jail.view import SHM_BYTES
from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import AgentDoing, AgentEnded, AgentUsed
from evopolicy_gateway.processes.resources import Resources, used_bytes

needs_cgroups = pytest.mark.skipif(
    not {"cpu", "memory", "pids"} <= cgroups.hierarchies().keys(),
    reason="needs cgroups: make test-root as root",
)

FORK_BOMB = """
import os, time
failed = 0
for _ in range(400):
    try:
        if not os.fork():
            time.sleep(1000)
    except OSError:
        failed += 1
print("failed", failed, flush=True)
"""
MEMORY_HOG = """
import os, signal
if os.fork():
    print("child", os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
else:
    held = [b"x" * (1 << 24) for _ in range(64)]
"""
TMPFS_FILLER = """
import os
total = 0
for folder in ("/dev/shm", "/dev", "/run", "/etc"):
    try:
        with open(folder + "/filler", "wb", 0) as file:
            while True:
                total += file.write(b"x" * (1 << 24))
    except OSError as error:
        print(folder, error.strerror, flush=True)
print("wrote", total, flush=True)
"""
FILLER = """
import os, time
with open({path}, "wb") as file:
    {unlink}
    for _ in range(30):
        file.write(os.urandom(1 << 20))
        file.flush()
    time.sleep(1000)
"""


class Played(NamedTuple):
    ended: AgentEnded
    used: AgentResources
    notes: str
    log: str


NESTED = """
import os, time
for _ in range(400):
    os.mkdir("d")
    os.chdir("d")
time.sleep(1000)
"""


def play(
    folder: Path, program: str, *, wall_limit_s: float = 1000.0, jailed: bool = True, **limits: Any
) -> Played:
    path = folder / "program.py"
    path.write_text(program)
    jail = JailOrder(settings=JailSettings(), private=str(folder / "private"))
    supervisor = SupervisorProcess(
        folder,
        wall_limit_s,
        f"command:{sys.executable} {path}",
        jail=jail if jailed else None,
        limits=AgentLimits(**limits),
    )
    assert supervisor.process.stdout is not None
    events = [child_messages.event_of(line) for line in supervisor.process.stdout]
    supervisor.process.communicate(timeout=TIMEOUT_S)
    (ended,) = (each for each in events if isinstance(each, AgentEnded))
    used = [each.resources for each in events if isinstance(each, AgentUsed)][-1]
    notes = "\n".join(each.note for each in events if isinstance(each, AgentDoing))
    # Not by `glob`, which fails where another test removes its own group meanwhile.
    group = f"evopolicy-agent-{supervisor.process.pid}"
    assert not [folder for folder, *_ in os.walk(cgroups.ROOT) if folder.endswith(group)]
    return Played(ended, used, notes, (folder / "logs/agent.jsonl").read_text())


@needs_cgroups
def test_a_fork_bomb_is_bounded_and_told(tmp_path: Path) -> None:
    played = play(tmp_path, FORK_BOMB, pids=64)
    assert played.ended.reason == "agent_stopped"
    assert played.used.refused_forks > 300
    assert played.used.limits.pids == 64
    assert f"failed {played.used.refused_forks}" in played.log


@needs_cgroups
def test_a_memory_hog_is_ended_and_told(tmp_path: Path) -> None:
    played = play(tmp_path, MEMORY_HOG, memory_bytes=200_000_000)
    assert "child -9" in played.log
    assert (played.used.ended_for_memory, played.used.kept_by["memory_bytes"][:6]) == (1, "cgroup")
    assert 150_000_000 < played.used.memory_peak_bytes <= 200_000_000


@needs_cgroups
def test_an_agent_that_dies_of_its_memory_limit_has_the_reason(tmp_path: Path) -> None:
    played = play(tmp_path, "held = [b'x' * (1 << 24) for _ in range(64)]", memory_bytes=200_000_000)
    assert played.ended.reason == "agent_failed"
    assert "its memory limit of 200,000,000 bytes (agent_memory)" in played.ended.detail


def test_memory_file_systems_of_the_jail_are_bounded(tmp_path: Path) -> None:
    played = play(tmp_path, TMPFS_FILLER)
    assert "/dev/shm No space left on device" in played.log
    assert f"wrote {SHM_BYTES}" in played.log
    for folder in ("/dev", "/run", "/etc"):
        assert f"{folder} Read-only file system" in played.log


@pytest.mark.parametrize(
    ("path", "unlink"),
    [
        ("'filler'", ""),
        ("'/tmp/filler'", ""),
        ("os.path.expanduser('~/f')", ""),
        ("'f'", "os.unlink('f')"),
    ],
)
def test_an_agent_that_fills_its_disk_is_ended(tmp_path: Path, path: str, unlink: str) -> None:
    played = play(tmp_path, FILLER.format(path=path, unlink=unlink), disk_bytes=10_000_000)
    assert played.ended.reason == "disk_limit"
    assert "10,000,000 are allowed (agent_disk)" in played.ended.detail
    assert played.used.disk_bytes > 30_000_000


def test_folders_too_deep_to_measure_end_the_agent(tmp_path: Path) -> None:
    played = play(tmp_path, NESTED)
    assert (played.ended.reason, "nested deeper" in played.ended.detail) == ("disk_limit", True)


def test_only_the_agents_own_space_counts_and_each_file_once(tmp_path: Path) -> None:
    workspace = tmp_path / "workspace"
    for name in ("feedback", "a/feedback"):
        (workspace / name).mkdir(parents=True)
        (workspace / name / "file").write_bytes(b"x" * 1_000_000)
    os.link(workspace / "a/feedback/file", workspace / "again")
    with (workspace / "sparse").open("wb") as file:
        file.truncate(1 << 40)
    (workspace / "elsewhere").symlink_to("/")
    used = used_bytes([workspace, tmp_path / "missing"], workspace / "feedback", ())
    assert 1_000_000 < used < 1_100_000


def test_without_cgroups_the_jail_limits_cores_and_pids(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cgroups, "hierarchies", dict)
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    before = os.sched_getaffinity(0)
    try:
        asked = AgentLimits(cpus=0.5, memory_bytes=10**9, pids=64)
        held = Resources(asked, [tmp_path], tmp_path / "feedback", jailed=True)
        assert len(os.sched_getaffinity(0)) == 1
        loose = Resources(asked, [tmp_path], tmp_path / "feedback", jailed=False)
    finally:
        os.sched_setaffinity(0, before)
    assert held.used().limits == AgentLimits(cpus=1.0, pids=64)
    assert held.used().kept_by == {"cpus": "affinity", "pids": "rlimit"}
    assert (held.fixed_cores, held.own_pids, held.joins) == (True, 64, ())
    assert "memory 1,000,000,000 bytes (no cgroup can be made here: unlimited)" in held.limits_text()
    assert loose.used().limits == AgentLimits()


def test_processes_are_counted_in_the_jail_alone() -> None:
    program = "import os, time\nn = 0\ntry:\n while True:\n  os.fork() or time.sleep(5)\n  n += 1\n"
    program += "except OSError: print(n)"
    command = ["bwrap", "--unshare-user", "--unshare-pid", "--die-with-parent", "--ro-bind", "/", "/"]
    command += ["--dev", "/dev", "/usr/bin/python3", "-I", "-S", entry.__file__, "-", "-", "16"]
    user: dict[str, Any] = {"user": 65534} if os.getuid() == 0 else {}
    others = [subprocess.Popen(["sleep", "60"], **user) for _ in range(20)]
    try:
        words = [*command, "/usr/bin/python3", "-c", program]
        done = subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT_S, **user)
    finally:
        for each in others:
            each.kill()
            each.wait()
    assert (done.stdout.strip(), done.stderr) == ("14", "")


def test_affinity_stays_where_it_limits() -> None:
    number = SET_AFFINITY[os.uname().machine]
    for fixed, verdict in ((True, ERRNO | 1), (False, ALLOW)):
        assert allowed(filter_program(fixed_cores=fixed), number, machine=os.uname().machine) == verdict
