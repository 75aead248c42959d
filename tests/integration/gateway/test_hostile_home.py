"""A home that refuses: read-only, full, named in no known letters, without a loopback. A line with path and remedy, at
once."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import SMALL

from evopolicy_coordinator.storage.state_folder import StateFolder

pytestmark = pytest.mark.system

EVOPOLICY = f"{sys.executable} -m evopolicy_gateway.cli"
WORKER = f"{sys.executable} -m evopolicy_worker.cli"
COORDINATOR = f"{sys.executable} -m evopolicy_coordinator.cli"
PLAYED = f"--env toy/line --agent evolve --exp-id t {' '.join(SMALL)}"
SUITE = 'name = "t"\nenvironments = ["toy/line"]\n[[agents]]\nname = "e"\nagent = "evolve"\n'
POLICY = "class Policy:\n  def __init__(self, *a): pass\n  def reset(self, i): pass\n  def act(self, obs): return [0.0]\n"  # noqa: E501
TIMEOUT_S = 120
COMMANDS = {
    "try": f"{EVOPOLICY} try policy --env toy/line",
    "local": f"{EVOPOLICY} local {PLAYED}",
    "suite": f"{EVOPOLICY} suite t.toml --local",
    "state": f"{EVOPOLICY} local {PLAYED} --runs /tmp/evopolicy-nowhere --state state",
    "gc": f"{EVOPOLICY} gc --state old",
    "report": f"{EVOPOLICY} report runs --out report",
    "worker": f"{WORKER} --env toy/line --credentials c",
    "coordinator": f"{COORDINATOR} --state state",
    "a coordinator's old state": f"{COORDINATOR} --state old",
}


@functools.cache
def no_namespaces() -> str | None:
    if shutil.which("unshare") is None:
        return "unshare is missing: bash deploy/setup-host.sh --tests"
    tried = subprocess.run(
        ["unshare", "--mount", "--net", "mount", "-t", "tmpfs", "none", "/mnt"],
        capture_output=True,
        text=True,
    )
    if tried.returncode:
        return (
            f"needs a mount and a network namespace, which cannot be made here ({tried.stderr.strip()}): run the tests"
            " as root"
        )
    return None


@functools.cache
def compile_modules() -> None:
    """Python writes its bytecode files now, and not where the disk refuses."""
    made = subprocess.run([*EVOPOLICY.split(), "--help"], capture_output=True)
    assert made.returncode == 0, made.stderr


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with a policy, a suite's file, and an old state."""
    if (why := no_namespaces()) is not None:
        pytest.skip(why)
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "policy").mkdir()
    (folder / "policy/policy.py").write_text(POLICY)
    (folder / "t.toml").write_text(SUITE)
    (folder / "runs").mkdir()
    compile_modules()
    return folder


def refused(where: str, command: str, folder: Path, *namespaces: str, code: int = 2) -> str:
    """What the command says, in a line on stderr, when it is started where the shell words `where` have been carried
    out.

    `code`: what it ends with: 2 for an option, 1 for what the machine may give later.
    """
    script = f"set -e\n{where}\nset +e\n{command}"
    done = subprocess.run(
        ["unshare", "--mount", *namespaces, "sh", "-c", script],
        cwd=folder,
        env={**os.environ, "XDG_STATE_HOME": str(folder / "xdg")},
        capture_output=True,
        timeout=TIMEOUT_S,
    )
    output = done.stderr.decode("utf-8", "replace")
    assert done.returncode == code, (done.returncode, output, done.stdout)
    assert len(output.splitlines()) == 1, output
    assert done.stdout == b""
    return output


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "worker"])
def test_a_read_only_home_is_reported_before_anything_is_begun(home: Path, name: str) -> None:
    StateFolder.open(home / "old").close()
    where = f"mount --bind {home} {home}; mount -o remount,ro,bind {home}; cd {home}"
    output = refused(where, COMMANDS[name], home, code=1)
    assert str(home) in output
    assert "read-only" in output
    assert any(option in output for option in ("--out", "--runs", "--state")), output


@pytest.mark.parametrize("name", ["try", "local", "suite", "worker"])
@pytest.mark.parametrize("limit", ["size=1m", "nr_inodes=20"])
def test_a_full_temporary_folder_is_reported_at_the_start(home: Path, name: str, limit: str) -> None:
    full = home / "tmp"
    full.mkdir()
    where = f"mount -t tmpfs -o {limit} none {full}; export TMPDIR={full}"
    output = refused(where, COMMANDS[name], home, code=1)
    assert str(full) in output
    assert "TMPDIR" in output


@pytest.mark.parametrize("name", ["local", "suite"])
@pytest.mark.parametrize(
    "how", ["true", "ip link set lo up; ip addr del 127.0.0.1/8 dev lo"], ids=["down", "ipv6 only"]
)
def test_a_machine_without_ipv4_loopback_is_reported_at_the_start(home: Path, name: str, how: str) -> None:
    output = refused(how, COMMANDS[name], home, "--net")
    assert "127.0.0.1" in output
    assert "ip link set lo up" in output
    assert list((home / "runs").iterdir()) == []


@pytest.mark.parametrize(
    "command",
    [
        f"{EVOPOLICY} local {PLAYED} --state $ODD",
        f"{EVOPOLICY} local {PLAYED} --runs $ODD",
        f"{EVOPOLICY} try policy --env toy/line --out $ODD",
        f"{EVOPOLICY} suite t.toml --local --runs $ODD",
        f"{COORDINATOR} --state $ODD",
        f"mkdir $ODD && cd $ODD && {EVOPOLICY} local {PLAYED} --runs {{home}}/runs",
    ],
)
def test_a_path_that_is_not_utf8_is_refused_at_the_start(home: Path, command: str) -> None:
    output = refused("export ODD=$(printf 'odd-\\377')", command.replace("{home}", str(home)), home)
    assert r"odd-\xff" in output
    assert "not UTF-8" in output
    assert list((home / "runs").iterdir()) == []
