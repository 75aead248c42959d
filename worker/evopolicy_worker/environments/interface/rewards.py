"""Vector rewards: recorded in full, and scored by a weighted sum."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError

if TYPE_CHECKING:
    import gymnasium

_MAX_ELEMENTS = 64


class Scalarisation:
    """Maps reward vectors to scalar rewards."""

    def __init__(self, env_id: str, weights: Mapping[str, float]) -> None:
        self.weights = dict(weights)
        """By element name, in the order of the vector."""
        self._env = env_id
        self._values = np.array(list(weights.values()), dtype=np.float64)

    @classmethod
    def of(cls, entry: Entry, env: gymnasium.Env[Any, Any]) -> Scalarisation | None:
        """The scalarisation of an environment; None when its rewards are scalars.

        The definition names the elements; otherwise the environment's `reward_space` gives their number. Raises
        WorkerError when the two disagree, or beyond `_MAX_ELEMENTS` elements.
        """
        shape = getattr(getattr(env.unwrapped, "reward_space", None), "shape", None)
        n = math.prod(shape) if shape else 0
        names = entry.reward_vector or tuple(f"reward_{k}" for k in range(n))
        if not names:
            return None
        if n and n != len(names):
            raise WorkerError(
                f"environment {entry.id}, reward_vector: it names {len(names)} elements, and the environment's rewards"
                f" have {n}"
            )
        if len(names) > _MAX_ELEMENTS:
            raise WorkerError(
                f"environment {entry.id}, reward_vector: {len(names)} elements; {_MAX_ELEMENTS} are the limit"
            )
        return cls(entry.id, {name: entry.reward_weights.get(name, 1.0) for name in names})

    def texts(self, descriptions: Mapping[str, str]) -> dict[str, str]:
        """A text for each element: its description, or a default, and its weight."""
        return {
            name: f"{descriptions.get(name, 'element of the reward vector')}; weight {weight:g}"
            for name, weight in self.weights.items()
        }

    def scalar(self, reward: Any, info: dict[str, Any]) -> float:
        """The weighted sum of a vector. Puts the elements into `info`: as `reward_vector`, and by name as `rewards`.
        Raises WorkerError when their number is wrong."""
        vector = np.asarray(reward, dtype=np.float64).reshape(-1)
        if vector.size != self._values.size:
            raise WorkerError(
                f"environment {self._env}, reward: a vector of {vector.size} elements, and {self._values.size} are"
                " declared; name them all in reward_vector"
            )
        info["reward_vector"] = values = vector.tolist()
        info["rewards"] = dict(zip(self.weights, values, strict=True))
        return float(vector @ self._values)
