"""How the accelerations of highway-env reach what an environment makes anew at every reset: its road and its vehicles.

highway-env builds a scene in two steps, the road (`_make_road` or `_create_road`) and then what drives on it
(`_make_vehicles` or `_create_vehicles`). `Scene` calls `_road_made` and `_vehicles_made` after them; accelerations
override those, and `super()` chains them.
"""

from __future__ import annotations

from typing import Any

from highway_env.envs.common.abstract import AbstractEnv

from evopolicy_worker.environments.accelerations.specialise import specialise


class Scene(AbstractEnv):  # type: ignore[misc]
    """Base of accelerations of a highway-env environment."""

    def _make_road(self) -> None:
        super()._make_road()
        self._road_made()

    def _create_road(self, *args: Any) -> None:
        super()._create_road(*args)
        self._road_made()

    def _make_vehicles(self, *args: Any) -> None:
        super()._make_vehicles(*args)
        self._vehicles_made()

    def _create_vehicles(self) -> None:
        super()._create_vehicles()
        self._vehicles_made()

    def _road_made(self) -> None:
        """There is a new road, with nothing on it yet."""

    def _vehicles_made(self) -> None:
        """All vehicles and objects are on the road."""


def take_over(env: Any, mixin: type[Any]) -> None:
    """`mixin`, which may be a `Scene`, in front of the class of this bare environment, for scenes to come."""
    if not isinstance(env, Scene):
        specialise(env, Scene)
    specialise(env, mixin)
