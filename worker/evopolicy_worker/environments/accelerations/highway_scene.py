"""Every new road of a highway-env environment, and its vehicles, prepared by the accelerations.

highway-env builds a scene anew at every reset, in two steps: the road (`_make_road` or `_create_road`), and then what
drives on it (`_make_vehicles` or `_create_vehicles`). After each step `Scene` calls the functions that `prepare`
was given for it, in order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from highway_env.envs.common.abstract import AbstractEnv

from evopolicy_worker.environments.accelerations.specialise import specialise


class Scene(AbstractEnv):  # type: ignore[misc]
    """An environment with prepared scenes."""

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
