"""A policy that guesses its split from the time between its calls, and how often such guesses are right.

The policy reads the clock at the begin and the end of each call, and prints the gaps (ns) at one step of its episode.
Train and hidden episodes of the same cases are played in one slot in random order, by jobs with what
`core/leasing/jobs.py` gives each.
"""

from __future__ import annotations

import json
import random
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from slots import Slots, make_job

from attacks.channels import LIMITS

POLICY = """
import json, time
now = time.perf_counter_ns
GIVEN = json.load(open("given.json"))

class Policy:
    def __init__(self, *spaces):
        self.end = now()

    def reset(self, episode_index):
        self.gaps = [now() - self.end]
        self.end = now()

    def act(self, obs):
        self.gaps.append(now() - self.end)
        if len(self.gaps) == GIVEN["steps"] + 1:
            print(json.dumps(self.gaps), flush=True)
        self.end = now()
        return GIVEN["action"]
"""

KINDS: dict[str, dict[str, Any]] = {
    "train": {"record": "full", "render": True},
    "hidden": {"record": "actions", "render": False},
}
FEATURES = {
    "before reset": lambda gaps: gaps[0],
    "first act": lambda gaps: gaps[1],
    "last act": lambda gaps: gaps[-1],
    "median": lambda gaps: np.median(gaps[2:]),
    "p90": lambda gaps: np.quantile(gaps[2:], 0.9),
    "p99": lambda gaps: np.quantile(gaps[2:], 0.99),
    "longest": lambda gaps: gaps[2:].max(),
    "total": lambda gaps: gaps[1:].sum(),
}
"""What a guess can go by. The gap before `reset` is a pause between two episodes where a policy plays several."""


class Gaps(NamedTuple):
    """Episodes in the order in which they were played."""

    hidden: NDArray[np.bool_]
    features: NDArray[np.float64]
    """Episodes × `FEATURES`, µs."""


def collect(
    slots: Slots,
    env: str,
    action: Any,
    *,
    n: int,
    steps: int,
    video: bool = False,
    per_policy: int = 1,
    rng: random.Random,
) -> Gaps:
    """Plays at least `n` episodes of each kind, `per_policy` by each policy, and keeps those that have `steps` steps.

    `video`: of train episodes, which alone have them. A policy's first episode is left out where it plays several.
    """
    order = list(KINDS) * -(-n // per_policy)
    rng.shuffle(order)
    next_seed = dict.fromkeys(KINDS, rng.randrange(1 << 20))
    hidden, found = [], []
    policy = {"policy.py": POLICY, "given.json": json.dumps({"steps": steps, "action": action})}
    for kind in order:
        job = make_job(
            env=env,
            n=per_policy,
            seed=next_seed[kind],
            limits=LIMITS,
            max_steps=steps,
            video=video and kind == "train",
            policy_scope="submit" if per_policy > 1 else "episode",
            **KINDS[kind],
        )
        next_seed[kind] += per_policy
        outcomes = slots.run(
            slots.slot().play_job(job, slots.bundle(policy), lambda *_: None), timeout_s=900.0
        )
        for outcome in outcomes[per_policy > 1 :]:
            assert outcome.failure is None, outcome.failure
            if outcome.stdout:
                gaps = np.array(json.loads(outcome.stdout)) / 1000
                hidden.append(kind == "hidden")
                found.append([feature(gaps) for feature in FEATURES.values()])
    return Gaps(np.array(hidden), np.array(found, dtype=float))


def area(hidden: NDArray[np.bool_], values: NDArray[np.float64]) -> float:
    """How often a hidden episode's value is above a train episode's, ties half: 0.5 tells nothing."""
    ranks = _ranks(values)
    n = int(hidden.sum())
    return float((ranks[hidden].sum() - n * (n + 1) / 2) / (n * (len(hidden) - n)))


def accuracy(gaps: Gaps, folds: int = 5) -> float:
    """Share of right guesses by all features together: the nearer mean of the ranks, learnt from the other folds.

    A mean of both kinds' shares, so that 0.5 is chance. Folds are stretches of time.
    """
    ranks = np.stack([_ranks(column) for column in gaps.features.T], axis=1) / len(gaps.hidden)
    fold = np.arange(len(gaps.hidden)) * folds // len(gaps.hidden)
    right = np.zeros(len(gaps.hidden), dtype=bool)
    for k in range(folds):
        known, asked = fold != k, fold == k
        means = [ranks[known & (gaps.hidden == kind)].mean(axis=0) for kind in (False, True)]
        scatter = np.cov(ranks[known].T) + 1e-3 * np.eye(ranks.shape[1])
        direction = np.linalg.solve(scatter, means[1] - means[0])
        right[asked] = ((ranks[asked] - (means[0] + means[1]) / 2) @ direction > 0) == gaps.hidden[asked]
    return float((right[gaps.hidden].mean() + right[~gaps.hidden].mean()) / 2)


def by_chance(gaps: Gaps, n: int, rng: np.random.Generator) -> tuple[float, float]:
    """The accuracy, and the share of `n` random assignments of the kinds that are guessed as well (its p-value)."""
    found = accuracy(gaps)
    as_good = sum(accuracy(gaps._replace(hidden=rng.permutation(gaps.hidden))) >= found for _ in range(n))
    return found, (as_good + 1) / (n + 1)


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranks from 1; equal values share their mean rank."""
    _, where, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return ((ends - counts + 1 + ends) / 2)[where]
