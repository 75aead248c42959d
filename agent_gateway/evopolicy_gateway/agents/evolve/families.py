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

from evopolicy_gateway.agents.evolve.evolved.pushing import Mover
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
    spread: Vector
    """Standard deviation of the random candidates."""
    centre: Vector
    """Mean of the random candidates."""
    scale: Vector
    """Standard deviation of a mutation of strength 1, for every number of the vector."""
    first: tuple[Vector, ...] = ()
    """Candidates to try before random ones."""
    settings: dict[str, Any] = field(default_factory=dict)
    weight: int = 1
    """How many candidates it contributes each time its turn comes in the opening."""

    def sample(self, rng: np.random.Generator) -> Iterator[Vector]:
        """Yields candidates' vectors: the fixed ones first, then random ones without end (none if nothing can vary)."""
        yield from self.first
        while self.spread.any():
            yield self.centre + self.spread * rng.standard_normal(self.centre.size)


def _family(kind: str, spread: Any, **more: Any) -> Family:
    """A family around zero, which mutates by half of its spread."""
    spread = np.asarray(spread, dtype=float)
    usual = {"name": kind, "centre": np.zeros(spread.size), "scale": spread / 2, "weight": 2}
    return Family(kind=kind, spread=spread, **usual | more)


def families_for(obs_space: Schema, action_space: Schema) -> list[Family]:
    """Families for these spaces, most promising first."""
    n_outputs = ActionHead(action_space).size
    n_features = Features(obs_space).size
    families = [_constant(action_space, n_outputs)]
    if obs_space["type"] == "Image":
        spread = np.tile([2.0, 0.5, 0.5, 0.3], n_outputs)
        scale = np.concatenate([np.full(3, 0.4), spread / 2])
        families.append(_family("saliency", [1.0, 1.0, 1.0, *spread], scale=scale, weight=4))
    if action_space["type"] == "Discrete":
        usual = np.array([*np.zeros(n_outputs), 1.0, 0.0, 0.5])
        first = [usual, *(usual + 2.0 * axis for axis in np.eye(n_outputs, usual.size)[: 2 * MAX_CONSTANTS])]
        spread = np.array([*np.full(n_outputs, 1.5), 0.7, 0.7, 0.3])
        families.append(_family("explorer", spread, first=tuple(first), centre=usual))
    if n_features:
        families.append(_bang_bang(obs_space, action_space, n_outputs, n_features))
        row = [*np.full(n_features, 1.5 / np.sqrt(n_features)), 0.2]
        spread = np.tile(row, n_outputs)
        families.append(_family("linear", spread, scale=spread))
    if n_outputs:
        spread = np.array([0.7, *np.repeat([0.6, 0.7, 0.3], n_outputs)])
        centre = np.array([0.0, *np.repeat([0.5, 0.0, 0.0], n_outputs)])
        families.append(_family("oscillator", spread, centre=centre))
    return families


def moving_families(settings: dict[str, Any], obs_space: Schema, action_space: Schema) -> list[Family]:
    """The families that use an identified plant; defaults first, then variations."""
    others = np.ones(ActionHead(action_space).size)
    others[settings["outputs"]] = 0.0
    offsets = np.array([*np.zeros(Mover.PARAMETERS), *others])
    factors = np.array([*np.ones(Mover.PARAMETERS), *np.zeros(others.size)])
    first, scale = (-offsets, offsets), 0.6 * factors + 0.3 * offsets
    same: dict[str, Any] = {"settings": settings, "first": first, "scale": scale, "weight": 1}
    centres = {"pusher": -offsets, "carrier": offsets}
    return [_family(kind, 0.6 * factors, centre=centre, **same) for kind, centre in centres.items()]


def seeking_family(settings: dict[str, Any]) -> Family:
    """The family that plans in a view whose motion was identified from trajectories."""
    first = tuple(np.array(v, dtype=float) for v in ((0, 0, 0), (2, 0, -1), (0, 1, -1), (-2, 1, 0)))
    scale = np.array([1.0, 0.5, 0.7])
    return _family("seeker", [1.5, 0.7, 1.0], settings=settings, first=first, scale=scale, weight=1)


def _constant(action_space: Schema, n_outputs: int) -> Family:
    axes = np.eye(n_outputs)
    if action_space["type"] == "Discrete":
        order = np.linspace(0, n_outputs - 1, min(n_outputs, MAX_CONSTANTS)).round().astype(int)
        return _family("constant", np.zeros(n_outputs), first=tuple(axes[order]))
    pairs = [sign * axis for axis in axes for sign in (0.5, -0.5)] if n_outputs <= MAX_CONSTANTS // 2 else []
    spread = np.full(n_outputs, 0.5)
    return _family("constant", spread, first=(np.zeros(n_outputs), *pairs), scale=spread)


def _bang_bang(obs_space: Schema, action_space: Schema, n_outputs: int, n_features: int) -> Family:
    """Linear controllers, first those that decide by a single feature: for a Box the signed ones, last components
    (often velocities) first."""
    signed = np.ones(n_features, dtype=bool)
    if obs_space["type"] == "Box":
        low, high = bounds(obs_space)
        signed = (low < 0) & (high > 0)
    switchable = [int(i) for i in np.flatnonzero(signed)[::-1]] or list(range(n_features))
    # Choosers switch between the two ends, since neighbours in meaning are neighbours in number.
    chooses = action_space["type"] in ("Discrete", "MultiDiscrete")
    ends = np.linspace(-1, 1, n_outputs) if chooses else np.ones(n_outputs)
    first = []
    for feature in switchable[: 2 * MAX_CONSTANTS]:
        for sign in (1.0, -1.0):
            weights = np.zeros((n_outputs, n_features + 1))
            weights[:, feature] = sign * BANG_BANG_GAIN * ends
            first.append(weights.reshape(-1))
    spread, scale = (np.full(n_outputs * (n_features + 1), BANG_BANG_GAIN / part) for part in (3, 10))
    return _family("linear", spread, name="bang-bang", first=tuple(first), scale=scale, weight=1)
