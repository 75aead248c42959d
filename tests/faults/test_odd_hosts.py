"""Whole runs of `evopolicy local` on hosts that are set up in odd ways: each ends as it should, or says what to do."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from evopolicy_common.records.run_record import decode_run_record

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(300)]

NO_SHM = """
mkdir dev && mount -t tmpfs none dev
for name in null zero full random urandom tty; do touch dev/$name && mount --bind /dev/$name dev/$name; done
mkdir dev/pts && mount --bind /dev/pts dev/pts && ln -s pts/ptmx dev/ptmx && ln -s /proc/self/fd dev/fd
mount --move dev /dev && test ! -e /dev/shm
"""


class Host(NamedTuple):
    """How a host is set up."""

    setup: str = ""
    """Shell commands in a mount namespace of its own."""
    temporary: str | None = None
    """TMPDIR."""
    streams: str = ""
    """What the shell does with the command's standard streams."""
    error: str = ""
    """What the command ends with; empty where the run is played."""


HOSTS = {
    "no /dev/shm": Host(setup=NO_SHM),
    "/dev/shm read-only": Host(
        setup="mount -o remount,ro,bind /dev/shm || mount -t tmpfs -o ro none /dev/shm"
    ),
    "TMPDIR noexec": Host(setup="mkdir t && mount -t tmpfs -o noexec none t", temporary="t"),
    "TMPDIR read-only": Host(setup="mkdir t && mount -t tmpfs -o ro none t", temporary="t"),
    "TMPDIR missing": Host(temporary="no/such/folder"),
    "TMPDIR a file": Host(setup="touch t", temporary="t"),
    "TMPDIR of 200 characters": Host(setup=f"mkdir {'t' * 200}", temporary="t" * 200),
    "TMPDIR full": Host(
        setup="mkdir t && mount -t tmpfs -o size=64k none t",
        temporary="t",
        error="error: cannot work in .*/t: 64 KiB .* make room, or choose another folder with TMPDIR",
    ),
    "stdin closed": Host(streams="0<&-"),
    "stdout closed": Host(streams="1>&-"),
    "all streams closed": Host(streams="0<&- 1>&- 2>&-"),
}


def can_mount() -> bool:
    return not subprocess.run(
        ["unshare", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"], check=False
    ).returncode


@pytest.mark.parametrize("name", HOSTS)
def test_a_run_is_played_or_refused_on_a_host_with(name: str, tmp_path: Path) -> None:
    if not can_mount():
        pytest.skip(
            "needs mount namespaces: make test-system as root, in a container that was started with --privileged"
        )
    host = HOSTS[name]
    command = f"{sys.executable} -m evopolicy_gateway.cli local --env toy/line --agent evolve --budget 2"
    command += " --validation 1 --heldout 1 --runs runs --exp-id x"
    temporary = "" if host.temporary is None else f"TMPDIR={tmp_path}/{host.temporary} "
    script = f"set -e\n{host.setup}\n{temporary}exec {command} {host.streams}"
    done = subprocess.run(
        ["unshare", "--mount", "bash", "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    if host.error:
        assert done.returncode == 1
        assert re.search(host.error, done.stderr), done.stderr
    else:
        assert done.returncode == 0, done.stdout + done.stderr
        (record,) = tmp_path.glob("runs/*/*/x/run.json")
        assert decode_run_record(record.read_bytes()).outcome.status == "completed"
    assert "Traceback" not in done.stdout + done.stderr
