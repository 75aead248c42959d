"""`make bench-channels`: what a policy can tell others on its machine, at once and after it has ended.

Prints bits a second that arrive in an agent's jail, and in another policy, by each way that is known; then, of episodes
some of which did all that lasts, which share a jailed agent tells apart by each number it can read, `--wait` seconds
after they ended (0.5 is guessing). On a machine that does other things less arrives.

With `--gaps N` instead: whether a policy tells hidden from train episodes by the time between its calls, from N
episodes of each kind. The last table has a verdict for each environment, policy scope, with and without video: told
apart if more guesses are right than in all but a few random assignments of the kinds (p of at most 0.05 over the number
of rows). Another size:
`--gaps 40 --gap-steps 50 --gap-envs gym/acrobot`.
"""

from __future__ import annotations

import argparse
import os
import random
import tempfile
import time
from pathlib import Path

import frame
import numpy as np
from attacks import channels, gaps
from rich.console import Console
from rich.table import Table
from scipy.stats import ks_2samp
from slots import Slots

ACTIONS = {
    "gym/acrobot": 1,
    "gym/ant5": [0.0] * 8,
    "gym/racing": [0.0, 0.05, 0.0],
    "gymnasium/MiniGrid-FourRooms-v0": 0,
    "gymnasium/ALE/Pong-v5": 0,
}
"""Environments for the gaps: flat observations, then symbols and pictures. Actions that end no episode early."""
PICTURES = ("gym/racing", "gymnasium/ALE/Pong-v5")
PER_POLICY = 4
"""Episodes of each policy with policy scope "submit"."""
VARIANTS = ((False, 1), (True, 1), (False, PER_POLICY), (True, PER_POLICY))
"""With video or without, and the episodes of a policy."""
ASSIGNMENTS = 1000
"""Random ones, which give the p-value."""


def tell_gaps(slots: Slots, console: Console, chosen: argparse.Namespace) -> None:
    """A table for each environment and variant: what an episode's gaps say about its kind; then the verdicts."""
    rng = random.Random(chosen.seed)
    level = 0.05 / (len(chosen.gap_envs) * len(VARIANTS))
    verdicts = Table("environment", "shows", "scope", "video", "right", "p", "told apart", "took, s")
    for env in chosen.gap_envs:
        for video, per_policy in VARIANTS:
            begun = time.monotonic()
            found = gaps.collect(
                slots,
                env,
                ACTIONS[env],
                n=chosen.gaps,
                steps=chosen.gap_steps,
                video=video,
                per_policy=per_policy,
                rng=rng,
            )
            hidden = found.hidden
            share, p = gaps.by_chance(found, ASSIGNMENTS, np.random.default_rng(chosen.seed))
            scope = "submit" if per_policy > 1 else "episode"
            table = Table(
                "gap (µs)",
                "train",
                "hidden",
                "hidden is longer",
                "KS p",
                title=f"{env}, policy scope {scope}, {'with' if video else 'without'} video: {len(hidden)} episodes;"
                f" guessed rightly {share:.3f}, p = {p:.3f}",
            )
            for name, values in zip(gaps.FEATURES, found.features.T, strict=True):
                train, other = values[~hidden], values[hidden]
                medians = (f"{np.median(train):.2f}", f"{np.median(other):.2f}")
                test = ks_2samp(train, other).pvalue
                table.add_row(name, *medians, f"{gaps.area(hidden, values):.3f}", f"{test:.2g}")
            console.print(table)
            verdicts.add_row(
                env,
                "pictures" if env in PICTURES else "flat",
                scope,
                "with" if video else "without",
                f"{share:.3f}",
                f"{p:.3f}",
                "yes" if p <= level else "no",
                f"{time.monotonic() - begun:.0f}",
            )
    console.print(verdicts)
    console.print(
        f"told apart: p of at most {level:.4f}; load: {os.getloadavg()[1]:.1f} on {os.cpu_count()} CPUs"
    )


def main() -> None:
    chosen = frame.options(
        __doc__,
        wait=(60.0, "seconds after an episode's end"),
        episodes=(10, "of each wait"),
        gaps=(0, "episodes of each kind; only the gaps are measured"),
        gap_steps=(100, "of each of their episodes"),
        gap_envs=(list(ACTIONS), "environments of the gaps", ACTIONS),
        seed=(0, "of their order and cases"),
    )
    console = frame.console()
    with tempfile.TemporaryDirectory(prefix="evopolicy-channels-") as name:
        folder = Path(name)
        (folder / "slots").mkdir()
        slots = Slots(folder / "slots")
        try:
            if chosen.gaps:
                return tell_gaps(slots, console, chosen)
            reader = channels.JailedReader(folder)
            at_once = Table("the policy", "the other reads", "bits/s")
            for way in channels.WAYS:
                for reading, rate in channels.live(slots, reader, way).items():
                    at_once.add_row(way, f"{reading} (agent)", f"{rate:.1f}")
            cores = sorted(os.sched_getaffinity(0))
            for what, pair in (
                ("another core", (cores[0], cores[-1])),
                ("the same core", (cores[0], cores[0])),
            ):
                rate = channels.between_policies(slots, pair)
                at_once.add_row("computes", f"own speed (policy on {what})", f"{rate:.1f}")
            console.print(at_once)
            later = Table("read by an agent", "told apart after 2 s", f"after {chosen.wait:g} s")
            found = [channels.afterwards(slots, reader, wait, chosen.episodes) for wait in (2.0, chosen.wait)]
            for reading in found[0]:
                later.add_row(reading, *(f"{one[reading]:.2f}" for one in found))
            console.print(later)
            console.print(
                f"load of this machine meanwhile: {os.getloadavg()[1]:.1f} on {os.cpu_count()} CPUs"
            )
        finally:
            slots.close()


if __name__ == "__main__":
    main()
