"""A wrapper in which an episode never ends by itself."""

from __future__ import annotations

from typing import Any


class Endless:
    """Where the environment ends an episode, the next one follows in its place."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.seed = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **options: Any) -> Any:
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self.seed += 1
            obs, info = self.env.reset(seed=self.seed)
        return obs, reward, False, False, info
