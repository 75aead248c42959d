"""Plays the run in this folder anew: `python tests/conformance/protocol/golden_run/record.py`, from the root.

Later versions have to read the recorded one. Record it anew only when a release changes the files of a run."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[2] / "support"), str(HERE.parent)]

from played import play  # noqa: E402

AT = Path("/tmp/evopolicy-golden-run")
"""The recorded files name this folder."""


def main() -> None:
    shutil.rmtree(AT, ignore_errors=True)
    AT.mkdir()
    shutil.copy(HERE / "agent.py", AT)
    run = play(AT, AT / "agent.py", 8, sys.argv[1] if len(sys.argv) > 1 else "/usr/bin/python3")
    shutil.rmtree(HERE / "run", ignore_errors=True)
    shutil.copytree(run, HERE / "run", ignore=shutil.ignore_patterns(".passed.json", ".replay.json"))
    shutil.rmtree(AT)


if __name__ == "__main__":
    main()
