"""Episodes with random actions, and their digests: equal digests mean the same episode."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments.interface.base import Environment, Step


def rollout(
    environment: Environment, seed: int, steps: int, *, drawn: bool = False
) -> Iterator[tuple[Any, Step]]:
    """Plays at most `steps` steps with random actions drawn from `seed` (`Environment.draw`). Yields each action with
    its step; the first item is None with the first observation. `drawn`: draws each state before the action."""
    rng = np.random.default_rng(seed)
    step = Step(environment.reset(Case(seed=seed)), 0.0, False, False, {})
    yield None, step
    for _ in range(steps):
        if drawn:
            environment.render()
        action = environment.draw(rng, step.obs)
        step = environment.step(action)
        yield action, step
        if step.terminated or step.truncated:
            return


def digest(environment: Environment, seed: int, steps: int, *, drawn: bool = False) -> str:
    """Plays an episode, and returns the digest of all its observations, rewards, end flags, and infos."""
    return digest_of(rollout(environment, seed, steps, drawn=drawn))


def digest_of(episode: Iterator[tuple[Any, Step]]) -> str:
    """The digest of an episode that `rollout` plays."""
    state = hashlib.sha256()
    for n, (_, step) in enumerate(episode):
        add(state, tuple(step) if n else step.obs)
    return state.hexdigest()[:16]


def add(state: Any, value: Any) -> None:
    """Adds a value to a hash, so that any difference shows, including types and signs of zero."""
    if isinstance(value, np.ndarray):
        state.update(f"{value.dtype.str}{value.shape}".encode())
        state.update(value.tobytes())
    elif isinstance(value, dict):
        for key, item in value.items():
            state.update(str(key).encode())
            add(state, item)
    elif isinstance(value, list | tuple):
        state.update(f"{len(value)}".encode())
        for item in value:
            add(state, item)
    else:
        exact = value.hex() if isinstance(value, float) else value
        state.update(f"{type(value).__name__}:{exact!r}".encode())
