"""`make bench-against`: small submits of another revision of this project and of the files here, in turns on the same
machine.

The revision has a clone and an installation of its own in `build/against/`, which stay for the next time. Each measures
itself by its own `runtime_bench.agent_measured`, so both play what they would play for a user. The figure of a
revision is the shortest of all its submits after the first; the spread is how far the medians of its rounds are apart.

Differences below a tenth are lost in that spread. `--slots` compares single slots on one core instead: a new slot of
each revision, which play the same episodes in turns, `TURNS` times. The figure of a pair is the median of its turns'
ratios; the table has the mean of `--rounds` pairs, with its standard error.
"""

from __future__ import annotations

import contextlib
import json
import math
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
TURNS = 40
SLOT = """
import asyncio, sys, tempfile, time
from pathlib import Path
import msgspec, runtime_bench
env, n = sys.argv[1], int(sys.argv[2])

async def main(folder):
    bundle = folder / "bundle"
    bundle.mkdir()
    (bundle / "policy.py").write_text(runtime_bench.POLICY)
    slot = runtime_bench.Slot(min(runtime_bench.os.sched_getaffinity(0)), "bwrap", folder / "slot")
    play = getattr(slot, "play_job", None) or slot.play
    jobs = [msgspec.structs.replace(job, render=True) for job in runtime_bench.jobs(env, n)]
    await slot.start()
    try:
        while True:
            started = time.perf_counter()
            for job in jobs:
                await play(job, bundle, lambda done, steps: None)
            print(time.perf_counter() - started, flush=True)
            if not sys.stdin.readline():
                return
    finally:
        await slot.close()

with tempfile.TemporaryDirectory(prefix="evopolicy-against-") as folder:
    asyncio.run(main(Path(folder)))
"""
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


def program(clone: Path, source: str, env: str, n: int, state: str) -> subprocess.Popen[str]:
    """Starts one of the programs above in a revision's installation."""
    local = clone / ".venv" / "bin" / "python"
    python = str(local) if clone != ROOT else sys.executable
    path = os.pathsep.join(str(clone / "tests" / name) for name in ("bench", "support"))
    # A state folder of another revision cannot be read, and must not be changed.
    variables = os.environ | {"PYTHONPATH": path, "XDG_STATE_HOME": state}
    pipe = subprocess.PIPE
    command = [python, "-c", source, env, str(n)]
    return subprocess.Popen(
        command, cwd=clone, env=variables, stdin=pipe, stdout=pipe, stderr=pipe, text=True
    )


def failed(env: str, clone: Path, stderr: str) -> SystemExit:
    return SystemExit(f"error: {env} in {clone}: {stderr.strip()[-1000:]}")


def measured(clone: Path, env: str, n: int) -> list[float]:
    """Seconds of each small submit of one run."""
    with tempfile.TemporaryDirectory(prefix="evopolicy-against-") as state:
        done = program(clone, MEASURE, env, n, state)
        stdout, stderr = done.communicate()
    if done.returncode:
        raise failed(env, clone, stderr)
    return list(json.loads(stdout.splitlines()[-1]))


def ratio_of_slots(clones: dict[str, Path], env: str, n: int) -> tuple[float, float]:
    """Of a new slot of each revision: the shortest time of now, seconds, and the median of the turns' ratios."""
    times: dict[str, list[float]] = {name: [] for name in clones}
    with contextlib.ExitStack() as ended:
        slots = {}
        for name, clone in clones.items():
            state = ended.enter_context(tempfile.TemporaryDirectory(prefix="evopolicy-against-"))
            slots[name] = slot = program(clone, SLOT, env, n, state)
            # Ended, each closes its slot.
            ended.callback(slot.communicate)
        # The first turn starts the environment.
        for number in range(TURNS + 1):
            for name in sorted(slots, reverse=number % 2 == 0):
                slot = slots[name]
                assert slot.stdin is not None
                assert slot.stdout is not None
                if number:
                    print(file=slot.stdin, flush=True)
                if not (line := slot.stdout.readline()):
                    raise failed(env, clones[name], slot.communicate()[1])
                times[name] += [float(line)] if number else []
    pairs = zip(times["now"], times["then"], strict=True)
    return min(times["now"]), statistics.median(now / then for now, then in pairs)


def compare_slots(
    clones: dict[str, Path], envs: list[str], rounds: int, console: Console
) -> dict[str, list[float]]:
    """Prints the table of `--slots`; returns all ratios."""
    found = {}
    table = frame.table(
        "environment", "now, s", "now over then", "standard error", title=f"{rounds} pairs of slots"
    )
    for env in envs:
        pairs = [ratio_of_slots(clones, env, max(1, ENVIRONMENTS.get(env, 8) // 4)) for _ in range(rounds)]
        found[env] = ratios = [ratio for _, ratio in pairs]
        error = statistics.stdev(ratios) / rounds**0.5 if rounds > 1 else math.nan
        table.add_row(env, f"{min(pairs)[0]:.3f}", f"{statistics.fmean(ratios):.3f}", f"{error:.3f}")
    console.print(table)
    return found


def main() -> None:
    options = frame.options(
        __doc__,
        revision=(REVISION.read_text().strip(), "a commit of this clone"),
        envs=(list(ENVIRONMENTS), f"ids; episodes of a submit: {ENVIRONMENTS}, others 8"),
        rounds=(3, "runs of each revision, or pairs of slots"),
        slots=(False, "compare single slots, to a hundredth"),
        json=(Path, "also write all numbers to this file"),
    )
    console = frame.console()
    clones = {"then": installed(options.revision, console), "now": ROOT}
    if options.slots:
        frame.save(options.json, compare_slots(clones, options.envs, options.rounds, console))
        return
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
