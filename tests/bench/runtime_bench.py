"""`make bench`: what an episode costs through a sandboxed slot, and through the whole cluster, beside a bare loop.

Prints, per environment of Core16 and for one of each family: the bare loop's time per step; the slot's time over the
bare loop's with accelerations off and on, for Core16 also over the limit of `limit.py`; and a whole submit on
two slots, from POST to committed feedback, over (bare time / 2). Then the geometric means, and the paces of web pages.
At last a second small submit on two slots, over the bare loop on one core. The efficiency of two slots is half of the
time of one over theirs.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import frame
import proofs
from bare_loop import POLICY, seeds
from rich.console import Console
from submit_agent import SMALL

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_worker.slots.slot import Slot

HERE = Path(__file__).parent
ACCELERATIONS = "EVOPOLICY_ACCELERATIONS"
AGENT = HERE / "submit_agent.py"
SMALL_SUBMITS = {
    "gym/acrobot": (32, 0.9, 2.0),
    "gym/reacher5": (32, 1.5, 2.8),
    "gym/halfcheetah5": (8, 0.9, 2.3),
    "gymnasium/MiniGrid-FourRooms-v0": (32, 0.6, 2.9),
    "gymnasium/FetchPush-v4": (32, 0.7, 1.7),
}
"""Episodes of a small submit, and its time over the bare loop's on one core: wanted, and of the published software."""
LIMIT_EPISODES = 12
"""Episodes at the limit and in a slot beside it, at least."""
LIMIT_ROUNDS = 3
"""Measurements of the limit, and of a slot beside it."""
SMALL_ROUNDS = 3
"""Bare loops, and runs with small submits, of each environment."""


RATIOS = {
    "slot": "slot_plain_s",
    "slot, acc.": "slot_accelerated_s",
    "slot ÷ limit": "limit_s",
    "submit ×2": "submit_plain_s",
    "submit, acc.": "submit_accelerated_s",
}
"""Columns of the table, and what they are made of."""
CORE16 = set(catalogue.suites()["core16"].environments)
PACES = {"step_median_s": 5.0, "reset_median_s": 10.0}
"""Of a web page, what a step and a reset are wanted to take, ms, without a slot."""


class FailedError(Exception):
    """A measured program failed; its words."""


def quietly(command: list[str], **environment: str) -> str:
    """Runs a program and returns its stdout; what it says on stderr is shown only when it fails."""
    done = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise FailedError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return done.stdout


def jobs(env: str, n: int) -> list[Job]:
    return [
        Job(
            job_id=f"bench-{index}",
            env=env,
            bundle="0" * 64,
            render=True,
            episodes=(
                EpisodeSpec(index=index, episode_index=index, case=Case(seed=seed), policy_seed=bytes(16)),
            ),
        )
        for index, seed in enumerate(seeds(n))
    ]


async def slot_time(env: str, n: int, *, accelerations: bool) -> tuple[float, int]:
    """`n` episodes through one pinned, sandboxed slot that is warm: seconds and steps."""
    os.environ[ACCELERATIONS] = "on" if accelerations else "off"
    core = sorted(os.sched_getaffinity(0))[0]
    with tempfile.TemporaryDirectory(prefix="evopolicy-bench-") as folder:
        bundle = Path(folder) / "bundle"
        bundle.mkdir()
        (bundle / "policy.py").write_text(POLICY)
        slot = Slot(core, "bwrap", Path(folder) / "slot")
        await slot.start()
        try:
            await slot.play_job(jobs(env, 1)[0], bundle, lambda done, steps: None)
            steps, started = 0, time.perf_counter()
            for job in jobs(env, n):
                (outcome,) = await slot.play_job(job, bundle, lambda done, steps: None)
                steps += outcome.length
            return time.perf_counter() - started, steps
        finally:
            await slot.close()
            del os.environ[ACCELERATIONS]


def write_splits(env: str, n: int, folder: Path) -> None:
    """The bare loop's seeds as train cases, and as many hidden cases as runs have."""
    target = folder / env.replace("/", "_")
    target.mkdir(parents=True)
    hidden = [seed + 1_000_000 for seed in seeds(48)]
    for split, cases in (("train", seeds(max(n, 10))), ("valid", hidden[:16]), ("heldout", hidden[16:])):
        document = {"env": env, "split": split, "cases": [{"seed": seed} for seed in cases]}
        (target / f"{split}.json").write_text(json.dumps(document))


def submit_time(env: str, n: int, *, accelerations: bool) -> float:
    """Seconds of one warm submit of `n` episodes on two slots up to committed feedback."""
    hidden = ("--validation", "1", "--heldout", "1")
    measured = agent_measured(env, n, n + 4, *hidden, **{ACCELERATIONS: "on" if accelerations else "off"})
    return float(measured["submit_s"])


def small_submit(env: str, n: int) -> dict[str, Any]:
    """Seconds of the second and the next submits of `n` episodes on two slots and on one, and of the bare loop on one
    core.

    They are measured in turns, so that a machine whose speed varies is as fast for one as for the other.
    """
    bare_s: list[float] = []
    small_s: list[float] = []
    one_s: list[float] = []
    for _ in range(SMALL_ROUNDS):
        bare = quietly([sys.executable, str(HERE / "bare_loop.py"), env, "inf", str(n)])
        bare_s.append(json.loads(bare)["seconds"])
        small_s += agent_measured(env, n, SMALL * n, how="--small")["small_s"]
        one_s += agent_measured(env, n, SMALL * n, "--slots", "1", how="--small")["small_s"]
    return {"env": env, "episodes": n, "bare_s": bare_s, "small_s": small_s, "one_s": one_s}


def agent_measured(env: str, n: int, budget: int, *options: str, how: str = "", **environment: str) -> Any:
    """What `submit_agent.py` wrote at the end of a run on this machine."""
    with tempfile.TemporaryDirectory(prefix="evopolicy-bench-") as folder:
        result = Path(folder) / "result.json"
        write_splits(env, n, Path(folder) / "data")
        quietly(
            [
                *(sys.executable, "-m", "evopolicy_gateway.cli", "local", "--env", env, "--jail", "none"),
                *("--agent", f"command:{sys.executable} {AGENT} {n} {result} {how}".strip()),
                *("--budget", str(budget), "--data", f"{folder}/data", "--runs", f"{folder}/runs", *options),
            ],
            **environment,
        )
        return json.loads(result.read_text())


def beside_the_limit(env: str, n: int) -> dict[str, float]:
    """The shortest time of `n` episodes at the limit and in a slot, measured in turns: a machine's speed varies."""
    limit_s, slot_s = math.inf, math.inf
    for _ in range(LIMIT_ROUNDS):
        found = quietly([sys.executable, str(HERE / "limit.py"), env, str(n)])
        limit_s = min(limit_s, json.loads(found.splitlines()[-1])["limit_s"])
        slot_s = min(slot_s, asyncio.run(slot_time(env, n, accelerations=True))[0])
    return {"limit_s": limit_s, "slot_beside_limit_s": slot_s}


def measure(env: str, seconds: float, most: int, *, submits: bool) -> dict[str, Any]:
    # The last line: what comes before it, a simulator has printed.
    printed = quietly([sys.executable, str(HERE / "bare_loop.py"), env, str(seconds), str(most)])
    bare = json.loads(printed.splitlines()[-1])
    n = int(bare["episodes"])
    row: dict[str, Any] = {"env": env, "episodes": n, "steps": bare["steps"], "bare_s": bare["seconds"]}
    row |= {name: bare[name] for name in PACES if name in bare}
    if env in CORE16:
        # A collection of Python's garbage takes as long as an episode of some environments: more than a few of them.
        row |= beside_the_limit(env, max(n, min(most, LIMIT_EPISODES)))
    for name, accelerations in (("plain", False), ("accelerated", True)):
        slot_s, steps = asyncio.run(slot_time(env, n, accelerations=accelerations))
        row[f"slot_{name}_s"], row[f"slot_{name}_steps"] = slot_s, steps
        if submits:
            row[f"submit_{name}_s"] = submit_time(env, n, accelerations=accelerations)
    return row


def measure_elsewhere(python: str, env: str, seconds: float, most: int) -> dict[str, Any]:
    """As `measure`, without whole submits, by the interpreter of a virtual environment that can play it."""
    with tempfile.TemporaryDirectory(prefix="evopolicy-bench-") as folder:
        target = Path(folder) / "rows.json"
        options = ["--env", env, "--seconds", str(seconds), "--episodes", str(most), "--slots-only"]
        quietly([python, str(HERE / "runtime_bench.py"), *options, "--json", str(target)])
        (row,) = json.loads(target.read_text())["rows"]
    return dict(row)


def geometric_mean(values: list[float]) -> float:
    return math.exp(statistics.fmean(math.log(value) for value in values))


def over(row: dict[str, Any], name: str) -> float:
    """A time over the bare loop's on as many cores; for "limit_s" the slot's time over the limit."""
    if name == "limit_s":
        return float(row["slot_beside_limit_s"] / row[name])
    return float(row[name] / (row["bare_s"] / (2 if name.startswith("submit") else 1)))


def report(rows: list[dict[str, Any]], console: Console) -> dict[str, Any]:
    """Prints the table and the summary; returns the summary."""
    headings = ("environment", "episodes", "bare µs/step", *RATIOS)
    table = frame.table(*headings, title="time over the bare loop's (below 1: faster)")
    # The means are those of Core16, so that they compare with earlier ones; of other environments where it is not
    # there.
    measured = CORE16.intersection(row["env"] for row in rows)
    ratios: dict[str, list[float]] = {}
    for row in rows:
        cells = [row["env"], str(row["episodes"]), f"{1e6 * row['bare_s'] / row['steps']:.0f}"]
        for name in RATIOS.values():
            if name not in row:
                cells.append("")
                continue
            ratio = over(row, name)
            if row["env"] in CORE16 or not measured:
                ratios.setdefault(name, []).append(ratio)
            cells.append(f"{ratio:.2f}")
        table.add_row(*cells)
    console.print(table)
    summary: dict[str, Any] = {name: geometric_mean(values) for name, values in ratios.items()}
    if "limit_s" in summary:
        summary["slot_over_limit"] = summary.pop("limit_s")
    for name, value in summary.items():
        console.print(f"{name:28} {value:8.3f}")
    return summary


def tell_paces(rows: list[dict[str, Any]], console: Console) -> None:
    paced = [row for row in rows if PACES.keys() <= row.keys()]
    if not paced:
        return
    headings = ("environment", "a step", "a reset", "a step in a slot, mean")
    table = frame.table(*headings, title="web pages: medians in ms, without a slot (wanted), and in a slot")
    for row in paced:
        medians = [f"{1000 * row[name]:.1f} ({wanted:g})" for name, wanted in PACES.items()]
        table.add_row(row["env"], *medians, f"{1000 * row['slot_plain_s'] / row['slot_plain_steps']:.1f}")
    console.print(table)


def tell_small(rows: list[dict[str, Any]], console: Console) -> None:
    headings = ["environment", "episodes", "bare ms", "submit ms", "ratio of the shortest", "of the medians"]
    headings += ["wanted", "published software", "two slots over one"]
    table = frame.table(*headings, title="a second small submit on two slots, over the bare loop on one core")
    for row in rows:
        _, wanted, published = SMALL_SUBMITS[row["env"]]
        bare, small = row["bare_s"], row["small_s"]
        row["ratio"] = min(small) / min(bare)
        row["ratio_median"] = statistics.median(small) / statistics.median(bare)
        cells = [f"{1000 * min(bare):.0f}", f"{1000 * min(small):.0f}", f"{row['ratio']:.2f}"]
        row["efficiency"] = min(row["one_s"]) / (2 * min(small))
        cells += [f"{row['ratio_median']:.2f}", str(wanted), str(published), f"{row['efficiency']:.2f}"]
        table.add_row(row["env"], str(row["episodes"]), *cells)
    console.print(table)


def main() -> None:
    usual = ["core16", *(each.env for each in proofs.table())]
    options = frame.options(
        __doc__,
        env=(usual, "suites, ids or globs"),
        seconds=(4.0, "bare time per environment"),
        episodes=(128, "most episodes per environment"),
        slots_only=(False, "leave the whole submits out"),
        small_only=(False, "only the second small submits"),
        json=(Path, "also write all numbers to this file"),
    )
    console = frame.console()
    envs = catalogue.resolve(options.env)
    small = [] if options.slots_only else [env for env in SMALL_SUBMITS if env in envs]
    if options.small_only:
        tell_small([small_submit(env, SMALL_SUBMITS[env][0]) for env in small], console)
        return
    rows: list[dict[str, Any]] = []
    failed = []
    for env in envs:
        console.print(f"measuring {env}", style="dim")
        try:
            (python,) = installs.divided([env])
            if python == sys.executable:
                rows.append(measure(env, options.seconds, options.episodes, submits=not options.slots_only))
            else:
                rows.append(measure_elsewhere(python, env, options.seconds, options.episodes))
        except ConfigError as error:
            console.print(f"left out: {error}")
        except FailedError as error:
            # One environment that fails costs its own row, not those of the others.
            console.print(f"failed: {error}", markup=False)
            failed.append(env)
    summary = report(rows, console)
    tell_paces(rows, console)
    submits = [small_submit(env, SMALL_SUBMITS[env][0]) for env in small]
    if submits:
        tell_small(submits, console)
    frame.save(options.json, {"rows": rows, "summary": summary, "small": submits})
    if failed:
        raise SystemExit(f"not measured: {', '.join(failed)}")


if __name__ == "__main__":
    main()
