"""A policy that guesses its split from the time between its calls guesses no better than chance."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from attacks import gaps
from slots import Slots

CHANCE = 0.001
"""A test like this one fails this often where there is nothing to find. It asks again before it does."""


def collected(slots: Slots, env: str, action: Any, seed: int, **options: Any) -> gaps.Gaps:
    return gaps.collect(slots, env, action, n=24, steps=40, rng=random.Random(seed), **options)


@pytest.mark.parametrize(
    ("env", "action", "per_policy", "video"),
    [
        ("gym/acrobot", 1, 1, False),
        ("gym/acrobot", 1, 4, True),
        ("gymnasium/ALE/Pong-v5", 0, 1, False),
        ("gymnasium/ALE/Pong-v5", 0, 4, False),
    ],
    ids=["numbers", "numbers and pauses for videos", "pictures", "pictures and pauses"],
)
def test_the_time_between_calls_does_not_tell_a_policy_its_split(
    slots: Slots, env: str, action: Any, per_policy: int, video: bool
) -> None:
    for seed in range(2):
        found = collected(slots, env, action, seed, video=video, per_policy=per_policy)
        share, p = gaps.by_chance(found, 1000, np.random.default_rng(seed))
        if p > CHANCE:
            return
    medians = {
        name: [float(np.median(values[found.hidden == kind])) for kind in (False, True)]
        for name, values in zip(gaps.FEATURES, found.features.T, strict=True)
    }
    pytest.fail(f"{share:.2f} of the guesses are right, p = {p}; medians of train and hidden: {medians}")


def test_a_millisecond_more_in_hidden_episodes_would_be_noticed(slots: Slots) -> None:
    found = collected(slots, "gym/acrobot", 1, 0)
    found.features[found.hidden, list(gaps.FEATURES).index("median")] += 1000.0
    _, p = gaps.by_chance(found, 1000, np.random.default_rng(0))
    assert p <= CHANCE
