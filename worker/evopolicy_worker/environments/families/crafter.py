"""Crafter: survive, collect and build in a world seen from above.

The package walks through sets of objects, whose order depends on addresses in memory: sets in order of insertion take
their place. Its pictures draw from the world's random numbers, so these are put back after a frame for people.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted, GymnasiumFamily
from evopolicy_worker.environments.tasks import template

_SIDE_FOR_PEOPLE = 360
"""Height and width of a frame for people, pixels."""
_EFFECTS = {
    "noop": "nothing",
    "do": "act on what is in front: collect a material, drink water, hit a creature, eat a ripe plant",
    "sleep": "sleep, which restores energy; one wakes up rested, or when hurt",
}


class CrafterFamily(GymnasiumFamily):
    distributions = ("crafter",)
    also = ("opensimplex", "pillow", "numba")
    modules = ("gymnasium", "crafter")
    extra = "crafter"

    def load(self) -> None:
        super().load()
        if find_spec("numba") is None:
            _hasten()

    def make(self, entry: Entry, *, render: bool) -> Any:
        return _Game()

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        from crafter import constants

        choices = ((f"`{k}`", _choice(name)) for k, name in enumerate(constants.actions))
        achievements = ", ".join(f"`{name}`" for name in constants.achievements)
        return {
            "Action": f"One choice a step.\n\n{template.table(('choice', 'what it does'), choices)}\n\n"
            f"What is needed:\n\n{template.table(('for', 'of the inventory', 'where'), _needs(constants))}",
            "Reward": (
                "1 at a step that unlocks achievements, each for the first time; a tenth for each point of health that"
                " is won, and the same less for each that is lost. `info['unlocked']` names what the step unlocked,"
                " `info['achievements']` how many have been unlocked so far, `info['inventory']` what is carried. The"
                f" achievements: {achievements}."
            ),
        }


def _hasten() -> None:
    """Gives the noise that makes worlds its tables as lists, from which Python reads a number much faster than from
    arrays. The noise is the same, bit for bit. (Where numba compiles it, it needs arrays.)"""
    import opensimplex
    from crafter import worldgen
    from opensimplex import internals

    def noise(seed: int) -> Any:
        made = opensimplex.OpenSimplex(seed=seed)
        made._perm, made._perm_grad_index3 = made._perm.tolist(), made._perm_grad_index3.tolist()
        return made

    internals.GRADIENTS3 = np.asarray(internals.GRADIENTS3).tolist()
    worldgen.opensimplex = SimpleNamespace(OpenSimplex=noise)


def _choice(name: str) -> str:
    """The effect of an action, from its name, such as `place_stone`."""
    verb, _, thing = name.partition("_")
    thing = thing.replace("_", " ")
    if verb == "move":
        return f"turn {thing}, and move there if the square is free"
    if verb == "place":
        return f"put down a {thing} in front" if thing != "plant" else "plant a sapling in front"
    if verb == "make":
        return f"make {'an' if thing.startswith('iron') else 'a'} {thing}"
    return _EFFECTS[name]


def _needs(constants: Any) -> Iterator[tuple[str, str, str]]:
    """Rows of what collecting, placing and making take, from the package's own table."""

    def listed(items: Mapping[str, int]) -> str:
        return ", ".join(f"{n} {item.replace('_', ' ')}" for item, n in items.items()) or "nothing"

    for material, recipe in constants.collect.items():
        yield f"collecting from {material}", listed(recipe["require"]), material
    for name, recipe in constants.place.items():
        yield f"placing {name}", listed(recipe["uses"]), " or ".join(recipe["where"])
    for name, recipe in constants.make.items():
        where = "near " + " and ".join(recipe["nearby"])
        yield f"making {name.replace('_', ' ')}", listed(recipe["uses"]), where


class _Ordered(dict[Any, None]):
    """A set in order of insertion, with what the package calls of a set."""

    def add(self, each: Any) -> None:
        self[each] = None

    def remove(self, each: Any) -> None:
        del self[each]


class _Game(Adapted):
    def __init__(self) -> None:
        import crafter
        from gymnasium import spaces

        # It draws a world from this seed only in `reset`, which sets it.
        self._game: Any = crafter.Env(seed=0)
        self._world: Any = self._game._world
        usual = self._world.reset

        def reset(seed: int | None = None) -> None:
            usual(seed)
            self._world._chunks = defaultdict(_Ordered)

        self._world.reset = reset
        self._unlocked = 0
        self.action_space = spaces.Discrete(int(self._game.action_space.n))
        self.observation_space = spaces.Box(0, 255, self._game.observation_space.shape, np.uint8)

    def reset(self, *, seed: int, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._game._seed, self._game._episode = seed, 0
        self._unlocked = 0
        return self._game.reset(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        before = set(self._game._unlocked)
        obs, reward, _, game_info = self._game.step(action)
        new = [name for name in game_info["achievements"] if name in self._game._unlocked - before]
        self._unlocked += len(new)
        inventory = game_info["inventory"]
        info = {"inventory": inventory, "achievements": self._unlocked, "unlocked": ", ".join(new)}
        # Its own end includes its limit, which the adapter keeps.
        return obs, reward, not game_info["discount"], False, info

    def render(self) -> Any:
        random = self._world.random
        state = random.get_state()
        try:
            return self._game.render((_SIDE_FOR_PEOPLE, _SIDE_FOR_PEOPLE))
        finally:
            random.set_state(state)


FAMILY = CrafterFamily()
