"""A policy that guesses its split from the time between its calls guesses no better than chance.

Attacks, each with its defence:
- measures the time between its calls, to tell hidden from train episodes: the same work between calls in
  every split: each step is recorded as feedback has it, and hidden episodes discard it; with policy scope
  `submit`, as much is sent between two episodes; pictures are compressed after the episode, up to 32 MiB;
  videos are made after the job's last policy.
"""

from __future__ import annotations

import random
from typing import Any

import msgspec
import numpy as np
import pytest
from attacks import gaps
from slots import Slots, make_job

from evopolicy_worker.slot_protocol.slot_messages import Finished

CHANCE = 0.001
"""A test like this one fails this often where there is nothing to find. It asks again before it does."""


def collected(slots: Slots, env: str, action: Any, seed: int, **options: Any) -> gaps.Gaps:
    return gaps.collect(slots, env, action, n=24, steps=40, rng=random.Random(seed), **options)


@pytest.mark.parametrize(
    ("env", "action", "per_policy", "video"),
    [
        pytest.param("gym/acrobot", 1, 1, False, id="numbers", marks=pytest.mark.system),
        pytest.param("gym/acrobot", 1, 4, True, id="numbers and pauses for videos", marks=pytest.mark.system),
        pytest.param("gymnasium/ALE/Pong-v5", 0, 1, False, id="pictures"),
        pytest.param(
            "gymnasium/ALE/Pong-v5", 0, 4, False, id="pictures and pauses", marks=pytest.mark.system
        ),
    ],
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


def test_as_much_is_sent_between_two_hidden_episodes_as_between_train_ones(
    slots: Slots, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: dict[str, list[int]] = {}
    policy = {"policy.py": gaps.POLICY, "given.json": '{"steps": 9, "action": 0}'}
    slot = slots.slot()
    for kind, options in gaps.KINDS.items():
        received: list[Finished] = []
        reply = slot._reply

        async def noted(reply: Any = reply, received: list[Finished] = received) -> Any:
            message = await reply()
            received += [message] if isinstance(message, Finished) else []
            return message

        job = make_job(env="gymnasium/ALE/Pong-v5", n=3, max_steps=9, policy_scope="submit", **options)
        with monkeypatch.context() as patch:
            patch.setattr(slot, "_reply", noted)
            slots.run(slot.play_job(job, slots.bundle(policy), lambda *_: None))
        sizes[kind] = [len(msgspec.msgpack.encode(message)) for message in received]
        assert all(message.outcome.failure is None for message in received)
    assert sizes["train"][0] > 5_000
    # A hidden episode's own actions, and the policy's, are few bytes more.
    assert sizes["hidden"] == pytest.approx(sizes["train"], abs=600)


def test_a_millisecond_more_in_hidden_episodes_would_be_noticed(slots: Slots) -> None:
    found = collected(slots, "gym/acrobot", 1, 0)
    found.features[found.hidden, list(gaps.FEATURES).index("median")] += 1000.0
    _, p = gaps.by_chance(found, 1000, np.random.default_rng(0))
    assert p <= CHANCE
