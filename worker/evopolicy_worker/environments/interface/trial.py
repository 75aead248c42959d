"""Checks of environments that do not ship: in every episode, and in a few random steps before they are offered.

Spaces must not change, observations must have the form of their space, and rewards must be finite. In the trial, an
observation beyond the bounds of its space is refused, and so is another episode of the same seed and actions, unless
the definition says so. In an episode, the operator gets a report of the first one, since
a policy can drive an imprecise environment there.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from evopolicy_common.errors import EvopolicyError, WorkerError
from evopolicy_common.messages.environment import Case, SpaceSchema
from evopolicy_common.records.episodes import columns
from evopolicy_common.terminal import one_line
from evopolicy_worker.environments.interface import spaces
from evopolicy_worker.environments.interface.base import Environment, Step
from evopolicy_worker.environments.interface.calls import current as call
from evopolicy_worker.environments.interface.calls import described, note

STEPS = 32
SEEDS = (0, 1, 0)
SEEDED = (
    "draw from self.np_random alone, which super().reset(seed=seed) seeds, or say deterministic = false in an"
    " environment file"
)
"""The remedy for an environment that does not repeat an episode."""
_OF_FORM = "an array of shape"
_WRAP = "; if it is not yours, name a wrapper that corrects it in an environment file (wrappers)"
_ROUNDING = 1e-6
"""By so much of a bound an observation may be beyond it, as sums and products of floating-point numbers are."""


class Promises:
    """Checks one environment after its calls. Raises WorkerError that names environment, call, field and remedy."""

    def __init__(self, schema_of: Callable[[str], SpaceSchema], success: str) -> None:
        """`schema_of`: the environment's present `observation_space` or `action_space`. `success`: the key in
        `info`."""
        self._schema_of = schema_of
        self._success = success
        self.strict = self._reported = False
        """`strict`: whether values beyond bounds, and a success that is no truth value, are refused, too."""
        self._spaces = {name: schema_of(name) for name in ("observation_space", "action_space")}
        obs_space = self._spaces["observation_space"]
        self._outside = spaces.compile_checker(obs_space)
        self._far_outside = spaces.compile_checker(_widened(obs_space))

    def after_reset(self, returned: Any) -> None:
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], Mapping)):
            raise WorkerError(
                f"{call}: it returned {_shown(returned)}; it has to return an observation and a dict, as Gymnasium 1.x"
                " has it"
            )
        self._check_spaces()

    def after_step(self, step: Step, raw: Any, reward: Any, *ends: Any) -> None:
        """`raw`, `reward`, `ends`: as the environment gave them."""
        if isinstance(reward, str | bytes):  # of which `float` makes a number, too
            raise WorkerError(f"{call}, reward: it is {_shown(reward)}; a reward has to be one number")
        for name, end in zip(("terminated", "truncated"), ends, strict=True):
            if isinstance(end, str | bytes | list | tuple | Mapping):  # true, unless empty
                raise WorkerError(f"{call}, {name}: it is {_shown(end)}; it has to be true or false")
        if not math.isfinite(step.reward):
            raise WorkerError(f"{call}, reward: it is {step.reward}; rewards have to be finite")
        self.observation(step.obs, raw)
        if self.strict and (told := step.info.get(self._success)) is not None and solved(told) is None:
            raise WorkerError(
                f"{call}, info[{self._success!r}]: it is {_shown(told)}; success is true or false"
            )
        if self.strict or step.terminated or step.truncated:
            self._check_spaces()

    def _check_spaces(self) -> None:
        for name, schema in self._spaces.items():
            if self._schema_of(name) != schema:
                raise WorkerError(
                    f"{call}, {name}: it has changed; a space has to stay as it was when the environment was made"
                )

    def observation(self, obs: Any, raw: Any) -> None:
        fault = self._outside(obs) or _altered(obs, raw)
        if not fault:
            return
        text = f"{call}, observation: {fault}; correct the environment, or its observation_space"
        far = _altered(obs, raw) or self._far_outside(obs)
        if _OF_FORM in fault or (self.strict and far):
            raise WorkerError(f"{text}{_WRAP}")
        if not self._reported:
            self._reported = True
            note(text)


def _widened(schema: SpaceSchema) -> SpaceSchema:
    """The space with bounds that rounding errors do not pass."""
    if isinstance(inner := schema.get("spaces"), dict):
        return {**schema, "spaces": {key: _widened(part) for key, part in inner.items()}}
    if inner is not None:
        return {**schema, "spaces": list(map(_widened, inner))}
    if "space" in schema:
        return {**schema, "space": _widened(schema["space"])}
    if schema["type"] != "Box" or not schema["dtype"].startswith("float"):
        return schema
    ends = zip(("low", "high"), spaces.bounds(schema), (-_ROUNDING, _ROUNDING), strict=True)
    return schema | {name: (end + part * np.maximum(1.0, abs(end))).tolist() for name, end, part in ends}


def _altered(obs: Any, raw: Any) -> str:
    """How the observation differs from the raw one, as integers and texts are made of anything; empty where it does
    not."""
    if isinstance(obs, dict):
        parts = [(key, raw[key] if isinstance(raw, Mapping) else getattr(raw, key)) for key in obs]
        return next((f"[{key!r}] {why}" for key, each in parts if (why := _altered(obs[key], each))), "")
    if isinstance(obs, tuple):
        pairs = enumerate(zip(obs, raw, strict=True))
        return next((f"[{k}] {why}" for k, (one, each) in pairs if (why := _altered(one, each))), "")
    if isinstance(obs, str):
        return "" if isinstance(raw, str) else f"it is {_shown(raw)}, not a text"
    if isinstance(obs, int):
        return "" if raw == obs else f"it is {_shown(raw)}, not an integer"
    if not isinstance(obs, np.ndarray) or obs.dtype.kind == "f":
        return ""
    given = np.asarray(raw).reshape(obs.shape)
    if given.dtype == obs.dtype or not len(wrong := np.argwhere(given != obs)):
        return ""
    where = tuple(wrong[0].tolist())
    return f"element {where} is {given[where]}, which {obs.dtype} does not have"


def misshapen(returned: Any, error: Exception, *, vector: bool) -> str:
    """The error in the values that `step` returned, with field and remedy. `error`: the exception from reading them.
    `vector`: whether rewards are vectors."""
    if not isinstance(returned, tuple | list) or len(returned) != 5:
        return (
            f"returned values: {_shown(returned)}; it has to return observation, reward, terminated, truncated and"
            " info, as Gymnasium 1.x has it"
        )
    remedy = (
        "numbers, one for each name in reward_vector"
        if vector
        else "one number, or its elements be named in reward_vector"
    )
    fields: tuple[tuple[str, Callable[[Any], object], str], ...] = (
        (
            "reward",
            (lambda value: np.asarray(value, np.float64)) if vector else float,
            f"a reward has to be {remedy}",
        ),
        ("terminated", bool, "it has to be true or false"),
        ("truncated", bool, "it has to be true or false"),
        ("info", lambda value: value.items() if value else None, "it has to be a dict"),
    )
    for value, (name, read, wanted) in zip(returned[1:], fields, strict=True):
        try:
            read(value)
        except (TypeError, ValueError, OverflowError, AttributeError):
            return f"{name}: it is {_shown(value)}; {wanted}"
    return no_observation(returned[0], error)


def no_observation(obs: Any, error: Exception) -> str:
    """The text for a value that has not the form of the observation space."""
    return (
        f"observation: it is {_shown(obs)}, and cannot be read as its observation_space tells ({type(error).__name__}:"
        f" {one_line(str(error))[:120]}); correct one of them"
    )


def _shown(value: Any) -> str:
    """A value with its type, short and on one line."""
    return f"{one_line(repr(value))[:60]} ({type(value).__name__})"


def solved(told: Any) -> bool | None:
    """What the value of a success key in a plain `info` says; None if it is no number."""
    value = told[0] if isinstance(told, list) and len(told) == 1 else told
    return value == value and bool(value) if isinstance(value, int | float) else None


def play_trial(environment: Environment) -> None:
    """Plays random episodes of a few steps. Raises WorkerError that names the environment, the field and the remedy."""
    earlier: dict[int, list[dict[str, bytes]]] = {}
    try:
        for seed in SEEDS:
            played = [_digests(step) for step in _steps(environment, seed)]
            again = zip(earlier.get(seed, played), played, strict=False)
            for n, (one, other) in enumerate(again if environment.description.deterministic else ()):
                if fields := [name for name in one | other if one.get(name) != other.get(name)]:
                    where = f"environment {environment.description.env}, {f'step {n - 1}' if n else 'reset'}"
                    raise WorkerError(
                        f"{where}, {fields[0]}: it is another one when seed {seed} and the same actions are played"
                        f" again; {SEEDED}"
                    )
            earlier[seed] = played
    except EvopolicyError:
        raise
    except BaseException as error:  # such as an environment's sys.exit
        wanted = "seed" if call.what == "reset" else "action of its action_space"
        remedy = "" if isinstance(error, OSError) else f"; it has to take any {wanted}"
        raise WorkerError(f"{call}: it raised {described(error)}{remedy}") from error


def _steps(environment: Environment, seed: int) -> Iterator[Step]:
    """The first observation, and the steps that follow random actions."""
    rng = np.random.default_rng(seed)
    step = Step(environment.reset(Case(seed=seed)), 0.0, False, False, {})
    yield step
    for _ in range(STEPS):
        try:
            action = environment.action_codec.sample(rng)
        except Exception as error:
            raise WorkerError(
                f"environment {environment.description.env}, action_space: no random action can be drawn from"
                f" it ({type(error).__name__}: {error}); correct its bounds"
            ) from error
        step = environment.step(action)
        yield step
        if step.terminated or step.truncated:
            return


def _digests(step: Step) -> dict[str, bytes]:
    """By field, and of an info by key, digests that are equal for equal bits only."""
    obs, reward, terminated, truncated, info = step
    fields = {"observation": obs, "reward": reward, "terminated": terminated, "truncated": truncated}
    fields |= {f"info[{key!r}]": value for key, value in info.items()}
    return {name: hashlib.sha256(columns.encode(value)).digest() for name, value in fields.items()}
