"""Makes the state in this folder anew: `python tests/conformance/protocol/golden_state/record.py`, from the root.

Later versions have to open the recorded one. Record it anew only when a release changes the schema or the rows."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[2] / "support"), str(HERE.parent)]

from played import GOLDEN_RUN, play  # noqa: E402

from evopolicy_coordinator.storage.backup import back_up  # noqa: E402


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        play(root, GOLDEN_RUN / "agent.py", 8, state=root / "state")
        shutil.rmtree(HERE / "state", ignore_errors=True)
        back_up(root / "state", HERE / "state")


if __name__ == "__main__":
    main()
