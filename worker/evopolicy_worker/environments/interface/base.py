"""The interface to all environments, independent of the simulator.

Rules that this module owns:
- One process uses an environment for many episodes, one after another. `reset(case)` and the same actions give the same
  episode bit for bit, independent of earlier episodes; where a simulator does not guarantee this, the adapter creates
  it again.
- Observations are plain: numpy arrays (C-contiguous, exactly the dtype of the space, never an alias of a buffer that
  the simulator reuses), ints, strings, dicts in the order of the space, tuples.
- `info` is plain too (see `info.py`) and names no seed.
- `step` trusts its action: the caller repairs a policy's actions first (`action_codec.repair`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_worker.environments.interface.actions import ActionCodec

Observation = Any
"""numpy array, int, str, dict or tuple of these, as the observation space says."""
Frame = NDArray[np.uint8]
"""A rendered picture, height × width × 3, RGB."""


class Step(NamedTuple):
    """The result of one step. `obs` is the next observation of the policy."""

    obs: Observation
    reward: float
    terminated: bool
    """The task itself ended: goal reached, fallen, crashed."""
    truncated: bool
    """The step limit was reached."""
    info: dict[str, Any]
    """Plain values only; parts of the reward under the names in `description.reward_components`."""


class Environment(ABC):
    """One environment, kept warm for episode after episode. Not thread-safe."""

    description: EnvironmentDescription
    action_codec: ActionCodec
    """Repairs what a policy returns, and draws uniform random actions."""
    solved_by: str = ""
    """Key of `info` that reports at the last step whether the task was solved, where the definition names none. Not
    part of the definition, so that runs of earlier versions stay comparable."""

    rebuilds: bool = False
    """Whether each episode gets an environment made anew."""
    parameters: tuple[str, ...] = ()
    """Names of the simulator's parameters that `alter` knows."""

    def alter(self, factors: dict[str, float]) -> None:
        """Multiply parameters from the next `reset` on; those without a factor are as they were made."""
        if factors:
            raise WorkerError(f"{self.description.env}: its simulator has no parameters to alter")

    @abstractmethod
    def reset(self, case: Case) -> Observation:
        """Start the episode of `case`; its first observation."""

    @abstractmethod
    def step(self, action: Any) -> Step:
        """Play one valid action. Not defined after an episode has ended."""

    def draw(self, rng: np.random.Generator, obs: Observation) -> Any:
        """A random action after an observation, for checks: of the action space, or one that means more where its
        family knows."""
        return self.action_codec.sample(rng)

    def render(self) -> Frame:
        """The current state as a picture. WorkerError unless made with `render=True` and `description.renders`.

        Rendering never changes what the episode does next.
        """
        raise WorkerError(f"{self.description.env} was not made to render; make it with render=True")

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds. The environment is not used afterwards; a second close does nothing."""
