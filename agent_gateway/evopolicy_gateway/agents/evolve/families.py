"""Starting points of the search: families of controllers that suit a pair of spaces, each an endless source of
candidates.

Families are chosen by the structure of the spaces alone; no environment is named or recognised.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_gateway.agents.evolve.evolved.controllers import parameter_count
from evopolicy_gateway.agents.evolve.evolved.spaces import ActionHead, Features, Schema, bounds

Vector = NDArray[np.float64]

BANG_BANG_GAIN = 30.0
"""Weight that makes a linear controller switch rather than steer."""
MAX_CONSTANTS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Family:
    """Controllers of one kind, with the mutation scale of each of their numbers."""

    name: str
    kind: str
    """A kind of `evolved.controllers.build`."""
    scale: Vector
    """Standard deviation of a mutation of strength 1, for every number of the vector."""
    first: tuple[Vector, ...] = ()
    """Candidates to try before random ones."""
    centre: Vector
    """Mean of the random candidates."""
    spread: Vector
    """Standard deviation of the random candidates."""
    settings: dict[str, Any] = field(default_factory=dict)
    weight: int = 1
    """How many candidates it contributes each time its turn comes in the opening."""

    def sample(self, rng: np.random.Generator) -> Iterator[Vector]:
        """Yields candidates' vectors: the fixed ones first, then random ones without end (none if nothing can vary)."""
        yield from self.first
        while self.spread.any():
            yield self.centre + self.spread * rng.standard_normal(self.centre.size)


def families_for(obs_space: Schema, action_space: Schema) -> list[Family]:
    """Families for these spaces, most promising first."""
    n_outputs = ActionHead(action_space).size
    n_features = Features(obs_space).size
    chooses = action_space["type"] in ("Discrete", "MultiDiscrete")

    def count(kind: str) -> int:
        return parameter_count(kind, obs_space, action_space)

    families = [_constant(action_space, n_outputs)]
    if obs_space["type"] == "Image":
        families.append(_saliency(n_outputs))
    if action_space["type"] == "Discrete":
        families.append(_explorer(n_outputs))
    if n_features:
        families.append(
            _bang_bang(n_outputs, _switchable(obs_space, n_features), n_features, chooses=chooses)
        )
        families.append(_linear(n_outputs, n_features))
    if n_outputs:
        families.append(_oscillator(count("oscillator"), n_outputs))
    return families


def moving_families(settings: dict[str, Any], obs_space: Schema, action_space: Schema) -> list[Family]:
    """The families that use an identified plant; defaults first, then variations."""
    n_outputs = ActionHead(action_space).size
    families = []
    for kind in ("pusher", "carrier"):
        size = parameter_count(kind, obs_space, action_space)
        others = np.zeros(size)
        others[-n_outputs:] = 1.0
        others[-n_outputs:][settings["outputs"]] = 0.0
        parameters = np.zeros(size)
        parameters[:-n_outputs] = 1.0
        families.append(
            Family(
                name=kind,
                kind=kind,
                settings=settings,
                first=(-others, others),
                centre=-others if kind == "pusher" else others,
                spread=0.6 * parameters,
                scale=0.6 * parameters + 0.3 * others,
            )
        )
    return families


def seeking_family(settings: dict[str, Any]) -> Family:
    """The family that plans in a view whose motion was identified from trajectories."""
    first = tuple(np.array(v, dtype=float) for v in ((0, 0, 0), (2, 0, -1), (0, 1, -1), (-2, 1, 0)))
    return Family(
        name="seeker",
        kind="seeker",
        settings=settings,
        first=first,
        centre=np.zeros(3),
        spread=np.array([1.5, 0.7, 1.0]),
        scale=np.array([1.0, 0.5, 0.7]),
    )


def _constant(action_space: Schema, n_outputs: int) -> Family:
    zero = np.zeros(n_outputs)
    axes = np.eye(n_outputs)
    if action_space["type"] == "Discrete":
        order = np.linspace(0, n_outputs - 1, min(n_outputs, MAX_CONSTANTS)).round().astype(int)
        first = tuple(axes[i] for i in order)
        return Family(
            name="constant", kind="constant", first=first, centre=zero, spread=zero, scale=zero, weight=2
        )
    pairs = [sign * axis for axis in axes for sign in (1.0, -1.0)] if n_outputs <= MAX_CONSTANTS // 2 else []
    return Family(
        name="constant",
        kind="constant",
        first=(zero, *(0.5 * pair for pair in pairs)),
        centre=zero,
        spread=np.full(n_outputs, 0.5),
        scale=np.full(n_outputs, 0.5),
        weight=2,
    )


def _linear(n_outputs: int, n_features: int) -> Family:
    size = n_outputs * (n_features + 1)
    spread = np.full((n_outputs, n_features + 1), 1.5 / np.sqrt(n_features))
    spread[:, -1] = 0.2
    return Family(
        name="linear",
        kind="linear",
        centre=np.zeros(size),
        spread=spread.reshape(-1),
        scale=spread.reshape(-1),
        weight=2,
    )


def _switchable(obs_space: Schema, n_features: int) -> list[int]:
    """Features that may be switched on alone: for a Box the signed ones, last components (often velocities) first."""
    signed = np.ones(n_features, dtype=bool)
    if obs_space["type"] == "Box":
        low, high = bounds(obs_space)
        signed = (low < 0) & (high > 0)
    return [int(i) for i in np.flatnonzero(signed)[::-1]] or list(range(n_features))


def _bang_bang(n_outputs: int, switchable: list[int], n_features: int, *, chooses: bool) -> Family:
    """Linear controllers, first those that decide by a single feature."""
    first = []
    for feature in switchable[: 2 * MAX_CONSTANTS]:
        for sign in (1.0, -1.0):
            weights = np.zeros((n_outputs, n_features + 1))
            # Choosers switch between the two ends, since neighbours in meaning are neighbours in number.
            weights[:, feature] = sign * (np.linspace(-1, 1, n_outputs) if chooses else 1.0)
            first.append(BANG_BANG_GAIN * weights.reshape(-1))
    size = n_outputs * (n_features + 1)
    sparse = np.full(size, BANG_BANG_GAIN / 10)
    return Family(
        name="bang-bang",
        kind="linear",
        first=tuple(first),
        centre=np.zeros(size),
        spread=np.full(size, BANG_BANG_GAIN / 3),
        scale=sparse,
    )


def _oscillator(size: int, n_outputs: int) -> Family:
    spread = np.concatenate(
        [[0.7], np.full(n_outputs, 0.6), np.full(n_outputs, 0.7), np.full(n_outputs, 0.3)]
    )
    centre = np.zeros(size)
    centre[1 : 1 + n_outputs] = 0.5
    return Family(
        name="oscillator", kind="oscillator", centre=centre, spread=spread, scale=0.5 * spread, weight=2
    )


def _explorer(n_outputs: int) -> Family:
    def vector(logits: Vector, curiosity: float, persistence: float) -> Vector:
        return np.concatenate([logits, [curiosity, persistence, 0.5]])

    zero = np.zeros(n_outputs)
    first = [vector(zero, 1.0, 0.0)]
    first += [vector(2.0 * axis, 1.0, 0.0) for axis in np.eye(n_outputs)[: 2 * MAX_CONSTANTS]]
    spread = np.concatenate([np.full(n_outputs, 1.5), [0.7, 0.7, 0.3]])
    return Family(
        name="explorer",
        kind="explorer",
        first=tuple(first),
        centre=vector(zero, 1.0, 0.0),
        spread=spread,
        scale=spread / 2,
        weight=2,
    )


def _saliency(n_outputs: int) -> Family:
    centre = np.zeros((n_outputs, 4))
    spread = np.tile([2.0, 0.5, 0.5, 0.3], (n_outputs, 1))
    colours = np.concatenate([np.zeros(3), centre.reshape(-1)])
    return Family(
        name="saliency",
        kind="saliency",
        centre=colours,
        spread=np.concatenate([np.ones(3), spread.reshape(-1)]),
        scale=np.concatenate([np.full(3, 0.4), spread.reshape(-1) / 2]),
        weight=4,
    )
