"""`make bench-against`: small submits of another revision of this project and of the files here, in turns on the same
machine.

The revision has a clone and an installation of its own in `build/against/`, which stay for the next time. Each measures
itself by its own `runtime_bench.agent_measured`, so both play what they would play for a user. The figure of a
revision is the shortest of all its submits after the first; the spread is how far the medians of its rounds are apart.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import frame
from rich.console import Console

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
REVISION = HERE / "revision.txt"
"""The revision that `.ci/run` compares with."""
ENVIRONMENTS = {
    "gym/acrobot": 32,
    "gym/reacher5": 32,
    "gym/halfcheetah5": 8,
    "gymnasium/MiniGrid-FourRooms-v0": 32,
    "gymnasium/parking-v0": 4,
}
"""Episodes of a submit by id."""
MEASURE = """
import json, sys
import runtime_bench
env, n = sys.argv[1], int(sys.argv[2])
hidden = "--validation", "1", "--heldout", "1"
print(json.dumps(runtime_bench.agent_measured(env, n, runtime_bench.SMALL * n, *hidden, how="--small")["small_s"]))
"""


def run(*command: str | Path, folder: Path = ROOT) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"error: {' '.join(map(str, command))}: {done.stderr.strip()[-1000:]}")
    return done.stdout


def installed(revision: str, console: Console) -> Path:
    """The revision's clone, with its installation."""
    commit = run("git", "rev-parse", "--verify", f"{revision}^{{commit}}").strip()
    clone = ROOT / "build" / "against" / commit[:12]
    python = clone / ".venv" / "bin" / "python"
    if (clone / ".installed").exists():
        return clone
    console.print(f"installing {commit[:12]} into {clone.relative_to(ROOT)}")
    if not (clone / ".git").exists():
        run("git", "clone", "-q", "--no-checkout", ROOT, clone)
    run("git", "checkout", "-q", commit, folder=clone)
    run(sys.executable, "-m", "venv", clone / ".venv")
    pip = (python, "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", "constraints.txt")
    run(*pip, "-e", ".[local]", folder=clone)
    (clone / ".installed").touch()
    return clone


def measured(clone: Path, env: str, n: int) -> list[float]:
    """Seconds of each small submit of one run."""
    local = clone / ".venv" / "bin" / "python"
    python = str(local) if clone != ROOT else sys.executable
    path = os.pathsep.join(str(clone / "tests" / name) for name in ("bench", "support"))
    # A state folder of another revision cannot be read, and must not be changed.
    with tempfile.TemporaryDirectory(prefix="evopolicy-against-") as state:
        done = subprocess.run(
            [python, "-c", MEASURE, env, str(n)],
            cwd=clone,
            env=os.environ | {"PYTHONPATH": path, "XDG_STATE_HOME": state},
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise SystemExit(f"error: {env} in {clone}: {done.stderr.strip()[-1000:]}")
    return list(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    options = frame.options(
        __doc__,
        revision=(REVISION.read_text().strip(), "a commit of this clone"),
        envs=(list(ENVIRONMENTS), f"ids; episodes of a submit: {ENVIRONMENTS}, others 8"),
        rounds=(3, "runs of each revision"),
        json=(Path, "also write all numbers to this file"),
    )
    console = frame.console()
    clones = {"then": installed(options.revision, console), "now": ROOT}
    found: dict[str, dict[str, list[list[float]]]] = {}
    columns = ("then, s", "now, s", "now over then", "spread")
    title = f"the shortest submit, {options.revision} and now (load {os.getloadavg()[0]:.1f})"
    table = frame.table("environment", *columns, title=title)
    for env in options.envs:
        rounds: dict[str, list[list[float]]] = {"then": [], "now": []}
        for number in range(options.rounds):
            # In turns, and the other first the next time: a machine's speed varies.
            for name in sorted(clones, reverse=number % 2 == 0):
                rounds[name].append(measured(clones[name], env, ENVIRONMENTS.get(env, 8)))
        found[env] = rounds
        then, now = (min(map(min, rounds[name])) for name in ("then", "now"))
        medians = [[statistics.median(each) for each in rounds[name]] for name in rounds]
        spread = max(max(each) / min(each) for each in medians) - 1
        table.add_row(env, f"{then:.3f}", f"{now:.3f}", f"{now / then:.2f}", f"{spread:.0%}")
    console.print(table)
    frame.save(options.json, found)


if __name__ == "__main__":
    main()
