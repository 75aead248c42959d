"""A whole study in which every figure of a report has something to show. It follows from its arguments and a seed."""

from __future__ import annotations

import random
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from evopolicy_common import catalogue
from evopolicy_common.records.run_record import Tokens
from invented.policies import Version, png, policy
from invented.run_dirs import write_run

AGENTS: Mapping[str, tuple[str, str, float]] = {
    "Northwind": ("codex", "codex", 0.9),
    "Kestrel": ("claude-code", "claude", 0.75),
    "Tern": ("claude-code", "claude", 0.5),
    "evolve": ("evolve", "turns", 0.35),
}
"""Invented entries: harness, log form, skill in [0, 1]."""

RANDOM = {
    "gym/acrobot": (-499.0, -80.0), "gym/continuouscar": (-33.0, 98.0), "gym/bipedal": (-100.0, 260.0),
    "gym/racing": (-30.0, 640.0), "gym/reacher5": (-43.0, -3.4), "gym/halfcheetah5": (-291.0, 620.0),
    "gym/ant5": (-34.0, 995.0), "gym/pusher5": (-147.0, -36.0),
    "gymnasium/MiniGrid-DoorKey-16x16-v0": (0.0, 0.98), "gymnasium/MiniGrid-KeyCorridorS4R3-v0": (0.0, 0.93),
    "gymnasium/MiniGrid-FourRooms-v0": (0.04, 0.7), "gymnasium/MiniGrid-ObstructedMaze-1Q-v1": (0.0, 0.91),
    "gymnasium/parking-v0": (-47.0, -30.0), "gymnasium/roundabout-v0": (7.2, 10.2),
    "gymnasium/FetchPush-v4": (-46.0, -18.0), "gymnasium/FetchPickAndPlace-v4": (-43.0, -11.0),
}  # fmt: skip
"""Random and good return of each Core16 environment, for plausible scales."""


def evolution(generator: random.Random, env: str, skill: float, n_submits: int, budget: int) -> list[Version]:
    """A run's versions: every edit type, some failures, scores that rise with skill."""
    low, high = RANDOM.get(env, (0.0, 1.0))
    per_submit = max(1, budget // n_submits)
    gain, bias, mix, integral, planner = 0.5, 0.0, 0.9, False, False
    history: list[Version] = []
    level = 0.05
    for index in range(n_submits):
        kinds = ("parametric", "synthesis", "rollback", "retest", "broken")
        kind = generator.choices(kinds, (5, 3, 1, 1, 0.6))[0] if index else "first"
        says = ""
        if kind == "synthesis":
            integral, planner = (
                (not integral, planner) if generator.random() < 0.5 else (integral, not planner)
            )
            says = (
                "The summary shows a steady error at the end of the episodes, so the controller needs another"
                " mechanism."
            )
        elif kind in ("parametric", "first"):
            gain, mix = round(generator.uniform(0.1, 3.0), 3), round(generator.uniform(0.5, 0.99), 3)
            bias = round(generator.gauss(0.0, 0.2), 3)
            says = f"Episodes 1 and 3 overshoot; I set the gain to {gain}."
        files = policy(gain=gain, bias=bias, mix=mix, integral=integral, planner=planner)
        if kind == "rollback":
            files = dict(generator.choice([v for v in history if v.status == "ok"] or [Version(files)]).files)
            says = "The last change made it worse: back to the earlier policy."
        elif kind == "retest" and history:
            files = dict(history[-1].files)
        if kind == "broken":
            files = {"policy.py": "import nothing_like_this\n"}
            history.append(Version(files, (0.0,) * per_submit, None, "import_error"))
            continue
        if kind != "retest":
            level = min(1.0, max(0.0, level + generator.gauss(0.12 * skill, 0.12)))
        val = low + (high - low) * level * skill
        same = next((v.val for v in history if v.files == files and v.val is not None), None)
        val = val if same is None else same  # hidden validation of equal bytes is equal
        noise = abs(high - low) * 0.05
        returns = [val + generator.gauss(0.0, noise) for _ in range(per_submit)]
        images = {"probe.png": png(seed=index)} if index == 2 else {}
        failed = (0,) if index == 1 else ()
        history.append(Version(files, returns, val, images=images, says=says, failed=failed))
    return history


def write_suite(
    runs: Path,
    *,
    environments: Sequence[str] | None = None,
    agents: Mapping[str, tuple[str, str, float]] = AGENTS,
    repeats: int = 1,
    n_submits: int = 9,
    budget: int = 128,
    seed: int = 0,
) -> list[Path]:
    """One run of every agent on every environment (Core16 by default), `repeats` times."""
    environments = environments or catalogue.suites()["core16"].environments
    out: list[Path] = []
    for env in environments:
        low, high = RANDOM.get(env, (0.0, 1.0))
        for entry, (harness, log, skill) in agents.items():
            for repeat in range(repeats):
                generator = random.Random(f"{seed} {env} {entry} {repeat}")
                versions = evolution(generator, env, skill * generator.uniform(0.6, 1.1), n_submits, budget)
                best = max((v.val for v in versions if v.val is not None), default=low)
                heldout = [best + generator.gauss(0.0, abs(high - low) * 0.04) for _ in range(32)]
                tokens = Tokens(
                    input_noncached=generator.randrange(50_000, 500_000),
                    cache_read=generator.randrange(500_000, 20_000_000),
                    cache_creation=generator.randrange(10_000, 500_000),
                    output=generator.randrange(20_000, 300_000),
                    cost=round(generator.uniform(0.5, 9.0), 2),
                )
                folder = write_run(
                    runs,
                    versions,
                    entry=entry,
                    harness=harness,
                    env=env,
                    repeat=repeat,
                    budget=budget,
                    heldout=heldout if any(v.val is not None for v in versions) else None,
                    random_mean=low,
                    tokens=tokens if log != "turns" else None,
                    log=log,
                    rejected=generator.randrange(3),
                )
                out.append(folder)
    return out


if __name__ == "__main__":  # RUNS ENV...: the runs in the documentation's pictures
    write_suite(Path(sys.argv[1]), environments=sys.argv[2:], repeats=5)
