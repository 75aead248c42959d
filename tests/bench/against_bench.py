"""`make bench-against`: another revision of this project and the files here play in turns on the same machine.

The revision has a clone and an installation of its own in `build/against/`, which stay for the next time. A pair is a
new local cluster of each revision, with an agent that submits when it is told to; with `--slots`, a new slot of each on
one core. Both play the same episodes in turns, `TURNS` times after the first. The figure of a pair is the median of its
turns' ratios, since a machine's speed varies; the table has the mean of `--rounds` pairs, with its standard error.
"""

from __future__ import annotations

import contextlib
import os
import select
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import frame
import runtime_bench
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
TURNS = {"slots": 40, "submits": 20}
SLOT_EPISODES = 4
"""A slot plays one in so many of a submit's episodes in a turn."""
SLOT = """
import asyncio, os, sys, time
from pathlib import Path
import msgspec, runtime_bench
env, n, folder = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])

async def main():
    bundle = folder / "bundle"
    bundle.mkdir()
    (bundle / "policy.py").write_text(runtime_bench.POLICY)
    slot = runtime_bench.Slot(min(os.sched_getaffinity(0)), "bwrap", folder / "slot")
    play = getattr(slot, "play_job", None) or slot.play
    jobs = [msgspec.structs.replace(job, render=True) for job in runtime_bench.jobs(env, n)]
    await slot.start()
    try:
        for line in sys.stdin:
            if line == "end\\n":
                return
            started = time.perf_counter()
            for job in jobs:
                await play(job, bundle, lambda done, steps: None)
            print(time.perf_counter() - started, flush=True)
    finally:
        await slot.close()

asyncio.run(main())
"""
"""Plays with one slot, by the code of its interpreter: a line in, a turn's seconds out, until `end`."""


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


@contextlib.contextmanager
def player(clone: Path, env: str, n: int, *, slots: bool) -> Iterator[Callable[[], float]]:
    """A new slot or cluster of a revision: a call plays a turn of `n` episodes and returns its seconds."""
    python = sys.executable if clone == ROOT else str(clone / ".venv" / "bin" / "python")
    path = os.pathsep.join(str(clone / "tests" / name) for name in ("bench", "support"))
    with tempfile.TemporaryDirectory(prefix="evopolicy-against-") as name:
        folder = Path(name)
        # A state folder of another revision cannot be read, and must not be changed.
        variables = os.environ | {"PYTHONPATH": path, "XDG_STATE_HOME": name}
        (folder / "errors").touch()
        orders, answers = folder / "orders", folder / "answers"
        command = [python, "-c", SLOT, env, str(n), name]
        if not slots:
            runtime_bench.write_splits(env, n, folder / "data")
            agent = f"command:{python} {HERE / 'submit_agent.py'} {n} {answers} {orders}"
            budget = n * (TURNS["submits"] + 1)
            command = [python, "-m", "evopolicy_gateway.cli", "local", "--env", env, "--jail", "none"]
            command += ["--agent", agent, "--budget", str(budget), "--validation", "1", "--heldout", "1"]
            command += ["--data", f"{folder}/data", "--runs", f"{folder}/runs"]
        for fifo in (orders, answers):
            os.mkfifo(fifo)
        # Both ways, so that neither side waits for the other to open.
        to_player, from_player = (os.fdopen(os.open(fifo, os.O_RDWR), "r+b", 0) for fifo in (orders, answers))
        with to_player, from_player, (folder / "errors").open("w") as errors:
            process = subprocess.Popen(
                command,
                cwd=clone,
                env=variables,
                stdin=to_player,
                stdout=from_player if slots else errors,
                stderr=errors,
            )

            def play_turn() -> float:
                to_player.write(b"\n")
                while not select.select([from_player], [], [], 1.0)[0]:
                    if process.poll() is not None:
                        why = (folder / "errors").read_text().strip()[-1000:]
                        raise SystemExit(f"error: {env} in {clone}: {why}")
                return float(from_player.readline())

            try:
                yield play_turn
            finally:
                to_player.write(b"end\n")
                process.wait()


def pair(clones: dict[str, Path], env: str, n: int, *, slots: bool) -> dict[str, list[float]]:
    """The turns' seconds of a new pair, by revision."""
    times: dict[str, list[float]] = {name: [] for name in clones}
    with contextlib.ExitStack() as ended:
        plays = {
            name: ended.enter_context(player(clone, env, n, slots=slots)) for name, clone in clones.items()
        }
        for number in range(TURNS["slots" if slots else "submits"] + 1):
            for name in sorted(plays, reverse=number % 2 == 0):
                times[name].append(plays[name]())
    # The first turn starts the environment.
    return {name: each[1:] for name, each in times.items()}


def main() -> None:
    options = frame.options(
        __doc__,
        revision=(REVISION.read_text().strip(), "a commit of this clone"),
        envs=(list(ENVIRONMENTS), f"ids; episodes of a submit: {ENVIRONMENTS}, others 8"),
        rounds=(3, "pairs"),
        slots=(False, "pairs of slots instead of clusters"),
        json=(Path, "also write all numbers to this file"),
    )
    console = frame.console()
    clones = {"then": installed(options.revision, console), "now": ROOT}
    found: dict[str, list[dict[str, list[float]]]] = {}
    kind = "slots" if options.slots else "clusters"
    title = f"{options.revision} and now, {options.rounds} pairs of {kind}"
    columns = ("shortest now, s", "now over then", "standard error")
    table = frame.table("environment", *columns, title=f"{title} (load {os.getloadavg()[0]:.1f})")
    for env in options.envs:
        n = ENVIRONMENTS.get(env, 8) // (SLOT_EPISODES if options.slots else 1)
        found[env] = pairs = [pair(clones, env, n, slots=options.slots) for _ in range(options.rounds)]
        turns = [zip(each["now"], each["then"], strict=True) for each in pairs]
        ratios = [statistics.median(now / then for now, then in each) for each in turns]
        error = f"{statistics.stdev(ratios) / len(ratios) ** 0.5:.3f}" if len(ratios) > 1 else ""
        shortest = min(min(each["now"]) for each in pairs)
        table.add_row(env, f"{shortest:.3f}", f"{statistics.fmean(ratios):.3f}", error)
    console.print(table)
    frame.save(options.json, found)


if __name__ == "__main__":
    main()
