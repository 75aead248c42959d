"""A small run of the toy environment on public cases: the same agent comes to the same run whenever it is played."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
EARLIER = HERE / "earlier_run"
DATA = EARLIER / "data"


def play(root: Path, agent: Path, budget: int) -> Path:
    """The run directory that `agent` leaves."""
    done = subprocess.run(
        [
            *(
                sys.executable,
                "-m",
                "evopolicy_gateway.cli",
                "local",
                "--env",
                "toy/line",
                "--entry",
                "agent",
            ),
            *("--agent", f"command:{sys.executable} {agent}", "--jail", "none", "--data", str(DATA)),
            *("--budget", str(budget), "--validation", "2", "--heldout", "2", "--exp-id", "t"),
        ],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "runs" / "agent" / "toy_line" / "t"
