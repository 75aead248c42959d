"""An environment under altered rules: the order, direction, and scale of what its policy sees and does.

Rules that this module owns:
- The altered rules follow from a case's key and the environment's spaces alone: one to three kinds of change, drawn
  from the SHA-256 of the key. Without a key they are those of the key of zeros, which is public: for descriptions and
  checks.
- Each change can be undone, and none changes a space: a component moves only to a place with the same bounds, turns
  only about the middle of its bounds, and is scaled only if it has none. So a policy for the unchanged environment
  scores in a world as it does there, once it knows the rules (`Rules.undo`, `Rules.redo`).
- Scales are powers of two and shifts multiples of 1/8: only a shift rounds.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy_common.catalogue.worlds import KEY, OPTION
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case, SpaceSchema
from evopolicy_worker.environments.interface.adapters import adapter
from evopolicy_worker.environments.interface.base import Environment, Frame, Observation, Step
from evopolicy_worker.environments.interface.spaces import bounds

PUBLIC = "0" * 32
MOST_KINDS = 3
TEXTS = {
    "the order of the actions": "An action may do what another one does in the text above.",
    "the direction of the actions": "A component of the action may act the other way round.",
    "the order of the observation": (
        "A component of the observation may stand at the place of another one with the same bounds."
    ),
    "the direction of the observation": (
        "A component of the observation may have the opposite sign, or count from the other bound."
    ),
    "the scale of the observation": (
        "A component without bounds may be multiplied by a constant, and a constant may be added."
    ),
}
"""By kind of change, how the task text describes it."""


class _Draws:
    """Whole numbers from a key."""

    def __init__(self, key: str) -> None:
        self._key, self._n = hashlib.sha256(f"world {key}".encode()).digest(), 0

    def below(self, n: int) -> int:
        self._n += 1
        return int.from_bytes(hmac.digest(self._key, str(self._n).encode(), "sha256"), "big") % n

    def order(self, n: int) -> list[int]:
        """A permutation of `range(n)`."""
        found = list(range(n))
        for i in range(n - 1, 0, -1):
            j = self.below(i + 1)
            found[i], found[j] = found[j], found[i]
        return found


class _Vector(NamedTuple):
    """A change of a vector: component i is `scale` times the one at `order[i]`, plus `shift`."""

    order: NDArray[np.intp]
    scale: NDArray[np.float64]
    shift: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def apply(self, values: NDArray[Any]) -> NDArray[Any]:
        changed = values[self.order] * self.scale + self.shift
        return np.asarray(np.clip(changed, self.low, self.high), values.dtype)

    def undo(self, values: NDArray[Any]) -> NDArray[Any]:
        found = np.empty_like(values)
        found[self.order] = (values - self.shift) / self.scale
        return np.asarray(np.clip(found, self.low, self.high), values.dtype)


class Rules:
    """How a world alters what a policy sees and does."""

    def __init__(self, key: str, obs_space: SpaceSchema, action_space: SpaceSchema) -> None:
        """`key`: 32 hexadecimal digits."""
        draws = _Draws(key)
        possible = kinds(obs_space, action_space)
        n = min(1 + draws.below(MOST_KINDS), len(possible))
        self.kinds = tuple(possible[i] for i in sorted(draws.order(len(possible))[:n]))
        """The kinds of change in use, keys of `TEXTS`."""
        self._action = self._change(draws, action_space, "the actions")
        self._obs = self._change(draws, obs_space, "the observation")

    def observe(self, obs: Observation) -> Observation:
        """What the policy sees of an observation."""
        return _apply(self._obs, obs)

    def act(self, action: Any) -> Any:
        """What an action of the policy does: an action of the unchanged environment."""
        return _apply(self._action, action)

    def undo(self, obs: Observation) -> Observation:
        """The observation of the unchanged environment that the policy sees as `obs`."""
        return _undo(self._obs, obs)

    def redo(self, action: Any) -> Any:
        """The action that does what `action` does in the unchanged environment."""
        return _undo(self._action, action)

    def _change(self, draws: _Draws, space: SpaceSchema, what: str) -> list[int] | _Vector | None:
        ordered, turned, scaled = (
            f"the {kind} of {what}" in self.kinds for kind in ("order", "direction", "scale")
        )
        if not (ordered or turned or scaled):
            return None
        if space["type"] == "Discrete":
            return _really(lambda: draws.order(space["n"]))
        low, high = (each.reshape(-1) for each in bounds(space))
        n, free = len(low), np.isinf(low)
        order, scale, shift = np.arange(n), np.ones(n), np.zeros(n)
        if ordered:
            order = np.array(_really(lambda: _within_groups(draws, _groups(low, high), n)))
        if turned:
            flips = _really(
                lambda: [draws.below(2) if each else 0 for each in np.isinf(low) == np.isinf(high)],
                not_=[0] * n,
            )
            scale = np.where(flips, -1.0, 1.0)
            shift = np.where(
                np.array(flips, dtype=bool) & ~free, np.where(free, 0.0, low) + np.where(free, 0.0, high), 0.0
            )
        if scaled:
            scale = scale * np.array([2.0 ** (draws.below(5) - 2) if each else 1.0 for each in free])
            shift = shift + np.array([(draws.below(33) - 16) / 8 if each else 0.0 for each in free])
        return _Vector(order, scale, shift, low, high)


def kinds(obs_space: SpaceSchema, action_space: SpaceSchema) -> list[str]:
    """The kinds of change that these spaces allow, keys of `TEXTS`."""
    found = []
    for space, what in ((action_space, "the actions"), (obs_space, "the observation")):
        if space["type"] == "Discrete" and space["n"] > 1 and not space.get("start", 0):
            found.append(f"the order of {what}")
        elif space["type"] == "Box" and len(space["shape"]) == 1 and np.dtype(space["dtype"]).kind == "f":
            low, high = bounds(space)
            if any(len(group) > 1 for group in _groups(low, high)):
                found.append(f"the order of {what}")
            if (np.isinf(low) == np.isinf(high)).any():
                found.append(f"the direction of {what}")
            if what == "the observation" and (np.isinf(low) & np.isinf(high)).any():
                found.append(f"the scale of {what}")
    return found


def text(possible: list[str]) -> str:
    """The section of a task text that tells what may be altered, and no value."""
    lines = "\n".join(f"- {TEXTS[kind]}" for kind in possible)
    most = min(MOST_KINDS, len(possible))
    many = "In one way" if most == 1 else f"In one to {most} of these ways"
    return (
        f"\n\n## Altered rules\n\n{many}, the environment differs from the text above:\n\n{lines}\n\nThe stated bounds"
        " still hold. The changes are the same in every episode, train and hidden; find them out by playing."
    )


class World(Environment):
    """A world of `base`, whose cases tell its rules."""

    def __init__(self, env_id: str, title: str, base: Environment) -> None:
        self._base = base
        described = base.description
        self._spaces = described.obs_space, described.action_space
        possible = kinds(*self._spaces)
        self.description = msgspec.structs.replace(
            described,
            env=env_id,
            title=title,
            task_text=described.task_text.rstrip() + text(possible) + "\n",
            definition={**described.definition, "world": env_id.rpartition("@")[2]},
            adapter=f"{described.adapter}/{adapter(World, 1, '')}",
        )
        self.action_codec = base.action_codec
        self.solved_by = base.solved_by
        self.rebuilds = bool(getattr(base, "rebuilds", False))
        self._rules: tuple[str, Rules] | None = None

    def reset(self, case: Case) -> Observation:
        options = dict(case.options or {})
        key = options.pop(OPTION, PUBLIC)
        if not (isinstance(key, str) and KEY.fullmatch(key)):
            raise WorkerError(
                f"{self.description.env}: a case has no valid key of its world; its options need {OPTION!r} with 32"
                " hexadecimal digits"
            )
        if self._rules is None or self._rules[0] != key:
            self._rules = key, Rules(key, *self._spaces)
        return self._rules[1].observe(self._base.reset(Case(seed=case.seed, options=options or None)))

    def step(self, action: Any) -> Step:
        assert self._rules is not None
        rules = self._rules[1]
        step = self._base.step(rules.act(action))
        return step._replace(obs=rules.observe(step.obs))

    def draw(self, rng: np.random.Generator, obs: Observation) -> Any:
        return self.action_codec.sample(rng)

    def render(self) -> Frame:
        return self._base.render()

    def close(self) -> None:
        self._base.close()


def _groups(low: NDArray[np.float64], high: NDArray[np.float64]) -> list[list[int]]:
    """Places with the same bounds."""
    found: dict[tuple[float, float], list[int]] = {}
    for place, pair in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        found.setdefault(pair, []).append(place)
    return list(found.values())


def _within_groups(draws: _Draws, groups: list[list[int]], n: int) -> list[int]:
    order = list(range(n))
    for group in groups:
        for place, other in zip(group, draws.order(len(group)), strict=True):
            order[place] = group[other]
    return order


def _really(draw: Callable[[], list[int]], not_: list[int] | None = None) -> list[int]:
    """The first draw that changes something: not the numbers in order, or not `not_`."""
    while True:
        found = draw()
        if found != (list(range(len(found))) if not_ is None else not_):
            return found


def _apply(change: list[int] | _Vector | None, value: Any) -> Any:
    if change is None:
        return value
    return change[int(value)] if isinstance(change, list) else change.apply(np.asarray(value))


def _undo(change: list[int] | _Vector | None, value: Any) -> Any:
    if change is None:
        return value
    return change.index(int(value)) if isinstance(change, list) else change.undo(np.asarray(value))
