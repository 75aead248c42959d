"""The workers of one machine take different cores, as long as there are any."""

from __future__ import annotations

import os
import subprocess
import sys

TAKES = """
import sys
from evopolicy_worker import cli
cli._CORE_NAME = "\\0{name}-{{}}"
print(cli._take_cores({n}), flush=True)
sys.stdin.read()
"""


def test_workers_take_different_cores_and_share_them_when_all_are_taken() -> None:
    allowed = sorted(os.sched_getaffinity(0))
    taken, workers = [], []
    for n in (1, None, None):
        program = TAKES.format(name=f"evopolicy-test-{os.getpid()}", n=n)
        worker = subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        workers.append(worker)
        assert worker.stdout is not None
        taken.append(worker.stdout.readline().strip())
    for worker in workers:
        worker.communicate()
    assert taken == [str(allowed[:1]), str([*allowed[1:], allowed[0]]), str(allowed)]
