"""Checks of environments that do not ship: in every episode, and in a few random steps before they are offered.

Spaces must not change, observations must have the form of their space, and rewards must be finite. In the trial, an
observation beyond the bounds of its space is refused. In an episode, the operator gets a report of the first one, since
a policy can drive an imprecise environment there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from evopolicy_common.errors import EvopolicyError, WorkerError
from evopolicy_common.messages.environment import Case, SpaceSchema
from evopolicy_common.terminal import one_line
from evopolicy_worker.environments import spaces
from evopolicy_worker.environments.base import Environment, Step
from evopolicy_worker.environments.calls import current as call
from evopolicy_worker.environments.calls import note

STEPS = 32
SEEDS = (0, 1)
_OF_FORM = "an array of shape"


class Promises:
    """Checks one environment after its calls. Raises WorkerError that names environment, call, field and remedy."""

    def __init__(
        self, obs_space: SpaceSchema, action_space: SpaceSchema, schema_of: Callable[[str], SpaceSchema]
    ) -> None:
        """`schema_of`: the environment's present `observation_space` or `action_space`."""
        self._schema_of = schema_of
        self.strict = False
        """Whether values beyond bounds are refused, too."""
        self._reported = False
        self._spaces = {"observation_space": obs_space, "action_space": action_space}
        self._outside = spaces.compile_checker(obs_space)

    def after_reset(self, returned: Any) -> None:
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Mapping)):
            raise WorkerError(
                f"{call}: it returned {_shown(returned)}; it has to return an observation and a dict, as Gymnasium 1.x has it"
            )
        for name, schema in self._spaces.items():
            if self._schema_of(name) != schema:
                raise WorkerError(
                    f"{call}, {name}: it has changed; a space has to stay as it was when the environment was made"
                )

    def after_step(self, step: Step) -> None:
        if not math.isfinite(step.reward):
            raise WorkerError(f"{call}, reward: it is {step.reward}; rewards have to be finite")
        self.observation(step.obs)

    def observation(self, obs: Any) -> None:
        fault = self._outside(obs)
        if not fault:
            return
        text = f"{call}, observation: {fault}; correct the environment, or its observation_space"
        if self.strict or _OF_FORM in fault:
            raise WorkerError(text)
        if not self._reported:
            self._reported = True
            note(text)


def misshapen(returned: Any, error: Exception, *, vector: bool) -> str:
    """The error in the values that `step` returned, with field and remedy. `error`: the exception from reading them.
    `vector`: whether rewards are vectors."""
    if not isinstance(returned, tuple | list) or len(returned) != 5:
        return (
            f"returned values: {_shown(returned)}; it has to return observation, reward, terminated, truncated and info, as"
            " Gymnasium 1.x has it"
        )
    obs, reward, terminated, truncated, info = returned
    remedy = "numbers, one for each name in reward_vector" if vector else "one number"
    rest = "" if vector else ", or its elements be named in reward_vector"
    fields: tuple[tuple[str, Any, Callable[[Any], object], str], ...] = (
        ("reward", reward, _numbers if vector else float, f"a reward has to be {remedy}{rest}"),
        ("terminated", terminated, bool, "it has to be true or false"),
        ("truncated", truncated, bool, "it has to be true or false"),
        ("info", info, _items, "it has to be a dict"),
    )
    for name, value, read, wanted in fields:
        try:
            read(value)
        except (TypeError, ValueError, OverflowError, AttributeError):
            return f"{name}: it is {_shown(value)}; {wanted}"
    return no_observation(obs, error)


def no_observation(obs: Any, error: Exception) -> str:
    """The text for a value that has not the form of the observation space."""
    return (
        f"observation: it is {_shown(obs)}, and cannot be read as its observation_space tells ({type(error).__name__}:"
        f" {one_line(str(error))[:120]}); correct one of them"
    )


def _numbers(value: Any) -> object:
    return np.asarray(value, dtype=np.float64)


def _items(value: Any) -> object:
    return value.items() if value else None


def _shown(value: Any) -> str:
    """A value with its type, short and on one line."""
    return f"{one_line(repr(value))[:60]} ({type(value).__name__})"


def play(environment: Environment) -> None:
    """Plays random episodes of a few steps. Raises WorkerError that names the environment, the field and the remedy."""
    rng = np.random.default_rng(0)
    try:
        for seed in SEEDS:
            environment.reset(Case(seed=seed))
            for _ in range(STEPS):
                step = environment.step(_sampled(environment, rng))
                if step.terminated or step.truncated:
                    break
    except EvopolicyError:
        raise
    except Exception as error:
        remedy = (
            "it has to take any seed"
            if call.what == "reset"
            else "it has to take any action of its action_space"
        )
        raise WorkerError(f"{call}: it raised {type(error).__name__}: {error}; {remedy}") from error


def _sampled(environment: Environment, rng: np.random.Generator) -> Any:
    try:
        return environment.action_codec.sample(rng)
    except Exception as error:
        raise WorkerError(
            f"environment {environment.description.env}, action_space: no random action can be drawn from it"
            f" ({type(error).__name__}: {error}); correct its bounds"
        ) from error
