"""Children of an operator's command, while orphans are sought beside their start."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

OPERATOR = """
import asyncio, sys
from pathlib import Path
from evopolicy_gateway.processes import child_rpc
from evopolicy_gateway.processes import trees as processes
from evopolicy_gateway.processes.child_rpc import Child

async def main():
    processes.become_subreaper()
    stop = asyncio.Event()

    async def seek():
        while not stop.is_set():
            await child_rpc.end_orphans()

    seeking = asyncio.create_task(seek())
    program = [sys.executable, "-c", "import sys; sys.stdin.read(); sys.exit(7)"]
    started = await asyncio.gather(*(Child.start(program, Path(sys.argv[1]), talks=True) for _ in range(30)))
    stop.set()
    await seeking
    for child in started:
        child._process.stdin.close()
    print([await child.ended() for child in started].count(7))

asyncio.run(main())
"""


def test_a_child_that_is_just_being_started_is_no_orphan(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", OPERATOR, str(tmp_path / "log")],
        env=dict(os.environ),
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert done.stdout == "30\n", done.stderr
