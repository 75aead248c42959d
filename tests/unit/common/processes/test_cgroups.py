"""Cgroups of one's own: real ones of version 1 and 2, where this machine has them."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from evopolicy_common.processes import cgroups
from evopolicy_common.processes.parent_death import ending_with_parent

TIMEOUT_S = 60.0
UNIFIED = next(
    (each for each in (cgroups.ROOT, cgroups.ROOT / "unified") if (each / "cgroup.controllers").exists()),
    None,
)


@pytest.fixture
def group() -> Iterator[cgroups.ControlGroup]:
    found = cgroups.ControlGroup({"cpu": 10_000, "memory": 100_000_000, "pids": 4})
    yield found
    found.remove()


@pytest.mark.skipif(
    not {*cgroups.CONTROLLERS} <= cgroups.hierarchies().keys(), reason="needs cgroups: make test-root as root"
)
def test_a_group_limits_and_counts_what_joins_it(group: cgroups.ControlGroup) -> None:
    assert group.held.keys() == {*cgroups.CONTROLLERS}
    busy = "import os\nfor _ in range(8):\n try: os.fork()\n except OSError: pass\nwhile True: pass"
    with subprocess.Popen(ending_with_parent([sys.executable, "-c", busy], joins=group.procs)) as process:
        deadline = time.monotonic() + TIMEOUT_S
        while not (group.hits("cpu") and group.hits("pids") and group.cpu_s() and group.peak_bytes()):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        pids = Path(group.procs[0]).read_text().split()
        assert len(pids) == 4
        for pid in pids:
            os.kill(int(pid), 9)
        process.wait()
    assert group.hits("memory") == 0


def test_a_program_whose_cgroup_is_gone_does_not_start(tmp_path: Path) -> None:
    gone = str(tmp_path / "gone" / "cgroup.procs")
    done = subprocess.run(ending_with_parent(["/bin/echo", "started"], joins=[gone]), capture_output=True)
    assert (done.returncode, done.stdout) == (1, b"")


@pytest.mark.root
@pytest.mark.skipif(UNIFIED is None, reason="this machine has no cgroups of version 2")
@pytest.mark.parametrize("delegated", [True, False])
def test_a_user_gets_groups_only_in_a_delegated_one(delegated: bool) -> None:
    assert UNIFIED is not None
    (controller, *_) = (UNIFIED / "cgroup.controllers").read_text().split()
    with _delegated(UNIFIED, controller, delegated) as folder:
        program = AS_USER.format(controller=controller)
        words = ending_with_parent([sys.executable, "-c", program], joins=[str(folder / "cgroup.procs")])
        done = subprocess.run(words, capture_output=True, text=True, check=True)
    first, again, joined = done.stdout.split("\n")[:3]
    wanted = f"{{'{controller}': Hierarchy(folder={folder!r}, version=2)}}" if delegated else "{}"
    assert (first, again) == (wanted, wanted)
    assert joined == (
        str([str(folder / f"evopolicy-agent-{done.stderr.strip()}" / "cgroup.procs")]) if delegated else "[]"
    )


AS_USER = """
import os, sys
from pathlib import Path
from evopolicy_common.processes import cgroups
cgroups.CONTROLLERS = ("{controller}",)
os.setgroups([]), os.setgid(65534), os.setuid(65534)
print(cgroups.hierarchies())
print(cgroups.hierarchies())
group = cgroups.ControlGroup({{}})
print(list(group.procs))
print(os.getpid(), file=sys.stderr)
if os.fork() == 0:
    for path in group.procs:
        Path(path).write_text(str(os.getpid()))
    os._exit(0)
os.wait()
group.remove()
"""


@contextlib.contextmanager
def _delegated(root: Path, controller: str, delegated: bool) -> Iterator[Path]:
    """A cgroup that belongs to another user, as systemd makes it for a scope with `Delegate=yes`."""
    control, folder = root / "cgroup.subtree_control", root / f"evopolicy-test-{os.getpid()}"
    before = control.read_text().split()
    control.write_text(f"+{controller}")
    folder.mkdir()
    try:
        for path in (
            folder,
            *(folder / f"cgroup.{name}" for name in ("procs", "subtree_control", "threads")),
        ):
            os.chown(path, 65534, 65534)
        if delegated:
            os.setxattr(folder, "user.delegate", b"1")
        yield folder
    finally:
        with contextlib.suppress(FileNotFoundError):
            (folder / cgroups.SIBLINGS).rmdir()
        folder.rmdir()
        if controller not in before:
            control.write_text(f"-{controller}")
