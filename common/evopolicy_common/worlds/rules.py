"""An environment under altered rules: the order, direction, and scale of what its policy sees and does, and
the parameters of its simulator.

Rules that this module owns:
- The altered rules follow from a case's key, the environment's spaces, and the names of its parameters
  alone: one to three kinds of change, drawn from the SHA-256 of the key. Without a key they are those of
  the key of zeros, which is public: for descriptions and checks.
- No change alters a space: a component moves only to a place with the same bounds, turns only about the
  middle of its bounds, and is scaled only if it has none.
- Each change but that of the parameters can be undone. So a policy for the unchanged environment scores in
  such a world as it does there, once it knows the rules (`transformed`).
- Scales are powers of two and shifts multiples of 1/8: only a shift rounds.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Space = dict[str, Any]
"""As in an environment's description."""
PUBLIC = "0" * 32
MOST_KINDS = 3
PARAMETERS = "the parameters of the simulator"
FACTORS = tuple(2.0 ** (n / 8) for n in range(-4, 5) if n)
"""A parameter is multiplied by one of them."""
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
    PARAMETERS: "Each of these quantities may be multiplied by a constant of its own",
}
"""By kind of change, how the task text describes it."""


class Draws:
    """Whole numbers from a key."""

    def __init__(self, key: str) -> None:
        self._key, self._n = hashlib.sha256(f"world {key}".encode()).digest(), 0

    def below(self, n: int) -> int:
        self._n += 1
        return int.from_bytes(hmac.digest(self._key, str(self._n).encode(), "sha256"), "big") % n

    def order(self, n: int) -> list[int]:
        """A permutation of `range(n)`."""
        numbers = list(range(n))
        for i in range(n - 1, 0, -1):
            j = self.below(i + 1)
            numbers[i], numbers[j] = numbers[j], numbers[i]
        return numbers


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


class Rules:
    """How a world alters what a policy sees and does."""

    def __init__(
        self, key: str, obs_space: Space, action_space: Space, parameters: Sequence[str] = ()
    ) -> None:
        """`key`: as `KEY` of the catalogue's worlds. `parameters`: the names of the simulator's."""
        draws = Draws(key)
        possible = kinds(obs_space, action_space, parameters)
        n = min(1 + draws.below(MOST_KINDS), len(possible))
        self.kinds = tuple(possible[i] for i in sorted(draws.order(len(possible))[:n]))
        """The kinds of change in use, keys of `TEXTS`."""
        self.action_change = self._change(draws, action_space, "the actions")
        self.obs_change = self._change(draws, obs_space, "the observation")
        self.factors = {
            name: FACTORS[draws.below(len(FACTORS))]
            for name in sorted(parameters)
            if PARAMETERS in self.kinds
        }
        """By parameter, the number that it is multiplied by; empty if they are unchanged."""

    def observe(self, obs: Any) -> Any:
        """The observation as the policy sees it."""
        return _apply(self.obs_change, obs)

    def act(self, action: Any) -> Any:
        """The action of the unchanged environment that the policy's action stands for."""
        return _apply(self.action_change, action)

    def _change(self, draws: Draws, space: Space, what: str) -> list[int] | _Vector | None:
        ordered, turned, scaled = (
            f"the {kind} of {what}" in self.kinds for kind in ("order", "direction", "scale")
        )
        if not (ordered or turned or scaled):
            return None
        if space["type"] == "Discrete":
            return _really(lambda: draws.order(space["n"]))
        low, high = _bounds(space)
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


def kinds(obs_space: Space, action_space: Space, parameters: Sequence[str] = ()) -> list[str]:
    """The kinds of change that these spaces and parameters allow, keys of `TEXTS`."""
    possible = []
    for space, what in ((action_space, "the actions"), (obs_space, "the observation")):
        if space["type"] == "Discrete" and space["n"] > 1 and not space.get("start", 0):
            possible.append(f"the order of {what}")
        elif space["type"] == "Box" and len(space["shape"]) == 1 and np.dtype(space["dtype"]).kind == "f":
            low, high = _bounds(space)
            if any(len(group) > 1 for group in _groups(low, high)):
                possible.append(f"the order of {what}")
            if (np.isinf(low) == np.isinf(high)).any():
                possible.append(f"the direction of {what}")
            if what == "the observation" and (np.isinf(low) & np.isinf(high)).any():
                possible.append(f"the scale of {what}")
    return [*possible, PARAMETERS] if parameters else possible


def text(possible: list[str], parameters: Sequence[str] = ()) -> str:
    """The section of a task text that tells what may be altered, and no value."""
    texts = TEXTS | {PARAMETERS: f"{TEXTS[PARAMETERS]}: {', '.join(sorted(parameters))}."}
    lines = "\n".join(f"- {texts[kind]}" for kind in possible)
    most = min(MOST_KINDS, len(possible))
    many = "In one way" if most == 1 else f"In one to {most} of these ways"
    return (
        f"\n\n## Altered rules\n\n{many}, the environment differs from the text above:\n\n{lines}\n\nThe stated bounds"
        " still hold. The changes are the same in every episode, train and hidden; find them out by playing."
    )


def _groups(low: NDArray[np.float64], high: NDArray[np.float64]) -> list[list[int]]:
    """Places with the same bounds."""
    groups: dict[tuple[float, float], list[int]] = {}
    for place, pair in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        groups.setdefault(pair, []).append(place)
    return list(groups.values())


def _within_groups(draws: Draws, groups: list[list[int]], n: int) -> list[int]:
    order = list(range(n))
    for group in groups:
        for place, other in zip(group, draws.order(len(group)), strict=True):
            order[place] = group[other]
    return order


def _really(draw: Callable[[], list[int]], not_: list[int] | None = None) -> list[int]:
    """The first draw that changes something: not the numbers in order, or not `not_`."""
    while True:
        drawn = draw()
        if drawn != (list(range(len(drawn))) if not_ is None else not_):
            return drawn


def _apply(change: list[int] | _Vector | None, value: Any) -> Any:
    if change is None:
        return value
    return change[int(value)] if isinstance(change, list) else change.apply(np.asarray(value))


def _bounds(space: Space) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of a vector."""
    low, high = (np.broadcast_to(np.array(space[side], float), space["shape"]) for side in ("low", "high"))
    return low, high
