"""What the accelerations of highway-env share: prepared scenes, and scalar arithmetic.

highway-env builds a scene anew at every reset, in two steps: the road (`_make_road` or `_create_road`), and then what
drives on it (`_make_vehicles` or `_create_vehicles`). After each step `Scene` calls the functions that `prepare`
was given for it, in order.

The arithmetic has the results of the numpy calls that highway-env makes for single numbers, bit for bit. Sums,
products, quotients, square roots, remainders and comparisons of doubles are the same in Python as in numpy, being
exactly defined. Not so trigonometric functions and powers, for which numpy has its own, and dot products, for which
its BLAS may use fused multiply-adds: those stay numpy's, everywhere in these accelerations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from highway_env.envs.common.abstract import AbstractEnv

from evopolicy_worker.environments.accelerations.specialise import specialise

PI = math.pi
TWO_PI = 2 * math.pi
DOUBT = 1e-6
"""Metres; far more than the error of an estimate."""


class Scene(AbstractEnv):  # type: ignore[misc]
    _on_road: tuple[Callable[[Any], None], ...] = ()
    _on_vehicles: tuple[Callable[[Any], None], ...] = ()

    def _make_road(self) -> None:
        super()._make_road()
        self._prepare(self._on_road)

    def _create_road(self, *args: Any) -> None:
        super()._create_road(*args)
        self._prepare(self._on_road)

    def _make_vehicles(self, *args: Any) -> None:
        super()._make_vehicles(*args)
        self._prepare(self._on_vehicles)

    def _create_vehicles(self) -> None:
        super()._create_vehicles()
        self._prepare(self._on_vehicles)

    def _prepare(self, functions: tuple[Callable[[Any], None], ...]) -> None:
        for function in functions:
            function(self)


def prepare(env: Any, road: Callable[[Any], None], vehicles: Callable[[Any], None] | None = None) -> None:
    """Have a bare environment call `road` with itself when a new road has nothing on it yet, and `vehicles` when all
    vehicles and objects are there."""
    if not isinstance(env, Scene):
        specialise(env, Scene)
    env._on_road += (road,)
    env._on_vehicles += (vehicles,) if vehicles else ()


def clip(value: float, low: float, high: float) -> float:
    """`np.clip` of one number: NaN stays, and so does a zero at a limit of zero, with its sign."""
    if value < low:
        return low
    return high if value > high else value


def wrap(angle: float) -> float:
    """`highway_env.utils.wrap_to_pi`."""
    return ((angle + PI) % TWO_PI) - PI


def not_zero(value: float) -> float:
    """`highway_env.utils.not_zero`."""
    if abs(value) > 1e-2:
        return value
    return 1e-2 if value >= 0 else -1e-2
