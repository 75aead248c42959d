"""What /proc says of processes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from evopolicy_common.processes import proc

LINE = b"42 (a) Z 7 (b) ) T 7 42 40 0 -1 4194564 1 2 3 4 100 20 3 400 20 0 1 0 5000 1 2"
PROGRAM = """
import os, time
if os.fork() == 0:
    end = time.process_time() + 0.25  # the kernel counts in ticks, and rounds down
    while time.process_time() < end: pass
    os._exit(0)
os.wait()
if os.fork() == 0:
    os._exit(0)
print("ready", flush=True)
input()
"""


def test_a_name_in_the_middle_of_a_line_misleads_nobody() -> None:
    found = proc.parse_stat(LINE)
    ticks = os.sysconf("SC_CLK_TCK")
    assert found == proc.Stat(42, "T", parent=7, session=40, exiting=True, cpu_s=523 / ticks)


@pytest.mark.parametrize("line", [b"", b"42", b"42 (a) R 1", LINE[:50], LINE.replace(b"42 ", b"x ", 1)])
def test_what_is_no_line_of_a_process_is_refused(line: bytes) -> None:
    with pytest.raises(ValueError, match=r"not the stat|invalid literal"):
        proc.parse_stat(line)


def test_a_family_counts_zombies_and_dead_but_not_spared_processes() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        me, *others = proc.family(child.pid)
        assert (me.pid, me.parent) == (child.pid, os.getpid())
        assert me.cpu_s >= 0.2
        assert [each.parent for each in others] == [child.pid]
        assert child.pid in proc.descendants(os.getpid())
        assert child.pid not in proc.descendants(os.getpid(), spare={child.pid})
        space, resident = proc.sizes(child.pid) or (0, 0)
        assert space > resident > 1 << 20
        child.stdin.close()
    assert proc.stat(child.pid) is None
    assert proc.family(child.pid) == []
    assert proc.sizes(child.pid) is proc.proportional_bytes(child.pid) is None
