"""The Policy: in episode k it plays the candidate that `candidates.json` schedules for episode k.

So one submit evaluates a whole population: the file lists candidates, and `reset(k)` selects the one at
`schedule[k]`. A checkpoint that is meant to be scored lists a single candidate, which then plays every episode.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .controllers import build

CANDIDATES_FILE = "candidates.json"


class Policy:
    """The interface of policies: `__init__(obs_space, action_space, env_meta)`, `reset(episode_index)`, `act(obs)`."""

    def __init__(
        self, obs_space: dict[str, Any], action_space: dict[str, Any], env_meta: dict[str, Any]
    ) -> None:
        path = Path(__file__).resolve().parent.parent / CANDIDATES_FILE
        plan = json.loads(path.read_text(encoding="utf-8"))
        self._candidates: list[dict[str, Any]] = plan["candidates"]
        self._schedule: list[int] = plan["schedule"]
        self._spaces = obs_space, action_space
        # The runner seeds numpy's global generator; drawing from it keeps episodes repeatable.
        self._seed = int(np.random.randint(2**31))
        self._controller: Any = None

    def reset(self, episode_index: int) -> None:
        """Starts an episode; `episode_index` is its position in the submit."""
        candidate = self._candidates[self._schedule[episode_index % len(self._schedule)]]
        rng = np.random.default_rng([self._seed, episode_index])
        vector = np.asarray(candidate["vector"], dtype=float)
        self._controller = build(candidate["kind"], vector, candidate.get("settings", {}), *self._spaces, rng)

    def act(self, obs: Any) -> Any:
        """The action for `obs`, in the form of the action space."""
        if self._controller is None:
            self.reset(0)
        return self._controller.act(obs)
