"""What a report over many runs takes: `python tests/bench/report_scale.py [REPEATS]`. Prints it, asserts nothing.

Writes four agents × Core16 × REPEATS made-up runs of nine submits each (16 repeats: 1,024 runs), and has `evopolicy
report` read them in a process of its own.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from invented.study import write_suite


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 16
    with tempfile.TemporaryDirectory(prefix="evopolicy-report-") as name:
        folder = Path(name)
        n_runs = len(write_suite(folder / "runs", repeats=repeats))
        program = [*(sys.executable, "-m", "evopolicy_gateway.cli", "report"), str(folder / "runs")]
        started = time.monotonic()
        subprocess.run([*program, "--out", str(folder / "report")], check=True, stdout=subprocess.DEVNULL)
        wall_s = time.monotonic() - started
        peak_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        files = [path for path in (folder / "report").rglob("*") if path.is_file()]
        size_mib = sum(path.stat().st_size for path in files) / 2**20
        print(
            f"{n_runs} runs: {wall_s:.0f} s, {peak_mib:.0f} MiB at most; a report of {len(files)} files,"
            f" {size_mib:.0f} MiB"
        )


if __name__ == "__main__":
    main()
