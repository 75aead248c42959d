"""Every environment through a sandboxed slot: the policy receives exactly what the environment gave, bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import pytest
from environment_checks import IDS
from slots import Slots, make_job, rows

from evopolicy_common.messages.episode import ResourceLimits
from evopolicy_worker.environments import Environment

SEED = 77
COMPARED_STEPS = 60

POLICY = """
import hashlib
import numpy as np

def mark(obs, digest):
    if isinstance(obs, dict):
        for key in obs: mark(obs[key], digest)
    elif isinstance(obs, tuple):
        for part in obs: mark(part, digest)
    elif isinstance(obs, np.ndarray):
        digest.update(f"{obs.dtype}{obs.shape}".encode() + obs.tobytes())
    else:
        digest.update(repr(obs).encode())

class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.space = action_space
        self.rng = np.random.default_rng(5)
        self.n = 0

    def reset(self, episode_index): pass

    def act(self, obs):
        self.n += 1
        if self.n <= 60:
            digest = hashlib.sha256()
            mark(obs, digest)
            print(digest.hexdigest())
        if self.space["type"] == "Discrete":
            return int(self.rng.integers(self.space["n"]))
        return self.rng.uniform(-1, 1, self.space["shape"]).astype(self.space["dtype"])
"""


@pytest.mark.parametrize("env_id", IDS)
def test_a_slot_plays_what_the_environment_plays(
    slots: Slots, env_id: str, warm: Callable[[str], Environment]
) -> None:
    namespace: dict[str, object] = {}
    exec(POLICY, namespace)
    mark: Callable[[object, object], None] = namespace["mark"]  # type: ignore[assignment]
    outcome = slots.play(POLICY, env=env_id, seed=SEED, limits=ResourceLimits())
    assert outcome.failure is None
    played = rows(outcome)
    words = outcome.stdout.decode().split()
    assert len(played) == outcome.length
    assert len(words) == min(60, outcome.length)
    assert (played[-1].terminated, played[-1].truncated) == (outcome.terminated, outcome.truncated)
    environment = warm(env_id)
    obs = environment.reset(make_job(seed=SEED).episodes[0].case)
    total = 0.0
    for row, digest in zip(played[:COMPARED_STEPS], words, strict=True):
        for seen in (obs, row.obs):
            expected = hashlib.sha256()
            mark(seen, expected)
            assert expected.hexdigest() == digest
        obs, reward, _, _, _ = environment.step(environment.action_codec.repair(row.action)[0])
        assert np.float64(reward).tobytes() == np.float64(row.reward).tobytes()
        total += reward
    if outcome.length <= COMPARED_STEPS:
        assert total == outcome.episode_return
