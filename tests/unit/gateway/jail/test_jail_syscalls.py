"""System calls that the jail's filter refuses, on every processor that has tables of calls.

Attacks, each with its defence:
- leaves a set-id program, which runs with the operator's rights for every local user, also root's: the filter
  refuses set-id bits in every call that gives a file its mode, and calls that it cannot read or does not
  know; no other user may enter a run's folder; closing the run takes such bits away, also without a jail.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from machines.filters import allowed

from evopolicy_common.errors import ConfigError
from evopolicy_common.seccomp import ALLOW, ATTRIBUTES, ERRNO, MODES
from evopolicy_gateway.jail import syscalls
from evopolicy_gateway.jail.jail import Jail, JailOrder
from evopolicy_gateway.jail.settings import JailSettings, Mode

HERE, PATH, FILE = (1 << 64) - 100, 0x7F00DEADB000, 3
EPERM, ENOSYS, ENOTSUP = ERRNO | 1, ERRNO | 38, ERRNO | 95
MAKE, TEMPORARY = os.O_CREAT | os.O_WRONLY, 0o20000000 | os.O_WRONLY


@pytest.mark.parametrize("machine", sorted(MODES))
def test_no_call_gives_a_file_a_set_id_bit(machine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(syscalls.os, "uname", lambda: SimpleNamespace(machine=machine))
    program = syscalls.filter_program()
    numbers = MODES[machine]

    def verdict(call: str, *arguments: int) -> int:
        return allowed(program, numbers[call], *arguments, machine=machine)

    def calls(mode: int) -> dict[str, tuple[int, ...]]:
        by_call = {"chmod": (PATH, mode), "fchmod": (FILE, mode), "fchmodat": (HERE, PATH, mode)}
        by_call |= {"creat": (PATH, mode), "fchmodat2": (HERE, PATH, mode, 0)}
        by_call |= {"mknod": (PATH, mode, 0), "mknodat": (HERE, PATH, mode, 0)}
        by_call |= {"open": (PATH, MAKE, mode), "openat": (HERE, PATH, MAKE, mode)}
        return {name: arguments for name, arguments in by_call.items() if name in numbers}

    for mode in (0o4755, 0o2755, 0o6000, 0o107755):
        assert {verdict(name, *arguments) for name, arguments in calls(mode).items()} == {EPERM}
    for mode in (0o755, 0o1777, 0, 0o100644):
        assert {verdict(name, *arguments) for name, arguments in calls(mode).items()} == {ALLOW}
    assert calls(0).keys() | {"openat2"} == numbers.keys()
    assert verdict("openat", HERE, PATH, TEMPORARY, 0o4755) == EPERM
    # Without a new file there may be anything in place of a mode.
    assert verdict("openat", HERE, PATH, os.O_RDONLY, 0o7777) == ALLOW
    assert verdict("openat2", HERE, PATH, PATH, 24) == ENOSYS
    assert {allowed(program, number, machine=machine) for number in ATTRIBUTES[machine]} == {ENOTSUP}


@pytest.mark.parametrize("mode", ["bwrap", "open-network", "none"])
def test_a_processor_without_a_table_of_calls_has_no_jail(
    mode: Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(syscalls.os, "uname", lambda: SimpleNamespace(machine="riscv64"))
    refused = pytest.raises(ConfigError, match=r"aarch64 and x86_64 processors, not on riscv64.*--jail none")
    with contextlib.nullcontext() if mode == "none" else refused:
        JailSettings(mode=mode).check()


def test_a_program_asked_for_its_version_is_filtered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    workspace = tmp_path / "workspace"
    workspace.mkdir()
    program = [sys.executable, "-c", "import os; os.close(os.open('left', os.O_CREAT, 0o4755))"]
    jail = Jail(
        JailOrder(settings=JailSettings(), private=str(tmp_path / "private")),
        harness="command",
        command=program,
        workspace=workspace,
        urls={},
        started_in=tmp_path,
    )
    way = jail.sealed(program)
    done = subprocess.run(way.words, pass_fds=way.pass_fds, capture_output=True, check=False, timeout=60)
    way.failed()
    assert b"PermissionError" in done.stderr
    assert not (workspace / "left").exists()
