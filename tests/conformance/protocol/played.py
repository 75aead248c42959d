"""A small run of the toy environment on public cases: the same agent comes to the same run whenever it is played."""

from __future__ import annotations

import sys
from pathlib import Path

from commands import evopolicy

HERE = Path(__file__).parent
GOLDEN_RUN = HERE / "golden_run"
DATA = GOLDEN_RUN / "data"


def play(
    root: Path, agent: Path, budget: int, python: str = sys.executable, state: Path | None = None
) -> Path:
    """The run directory that `agent` leaves."""
    done = evopolicy(
        root,
        *("local", "--env", "toy/line", "--entry", "agent", "--exp-id", "t", "--data", str(DATA)),
        *("--agent", f"command:{python} {agent}", "--jail", "none"),
        *("--budget", str(budget), "--validation", "2", "--heldout", "2"),
        *(() if state is None else ("--state", str(state))),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "runs" / "agent" / "toy_line" / "t"
