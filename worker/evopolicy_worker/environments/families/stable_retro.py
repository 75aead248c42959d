"""Stable-Retro: games of old consoles, of which the one whose ROM is free and in the wheel."""

from __future__ import annotations

from typing import Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted, GymnasiumFamily
from evopolicy_worker.environments.tasks import template

_BUTTONS = {
    "LEFT": "go to the left",
    "RIGHT": "go to the right",
    "B": "shoot; for the next shot let it go first",
}
_OBSERVATION = (
    "The screen: a picture with its rows from the top and its columns from the left, red, green and blue. Score and"
    " lives can be seen in it."
)


class StableRetroFamily(GymnasiumFamily):
    """Games of consoles."""

    distributions = ("stable-retro",)
    modules = ("gymnasium", "stable_retro")
    extra = "stable-retro"

    def load(self) -> None:
        """Imports the package, which registers nothing."""
        import stable_retro  # noqa: F401

    def make(self, entry: Entry, *, render: bool) -> Any:
        return _Console(str(entry.gymnasium_id))

    def words(self, entry: Entry, env: Any) -> dict[str, str]:
        rows = ((f"`{k}`", name, _BUTTONS.get(name, "none")) for k, name in enumerate(env.buttons))
        return {
            "": "A space ship at the lower edge of the screen. Shoot what comes from above, and do not be hit.",
            "Observation": _OBSERVATION,
            "Action": (
                "Which buttons are pressed for one frame, 1 for each that is. Left and right together have no"
                f" effect.\n\n{template.table(('component', 'button', 'effect'), rows)}"
            ),
            "Reward": "What the game's score has gained in the step. `info['lives']` tells the lives that are left.",
            "Start": "The beginning of the first level, the same in every episode: nothing in this game is at random.",
            "End": "An episode ends when the game is over.",
        }


class _Console(Adapted):
    """A game in the emulator, of which a process can have only one: the console that begins an episode takes it from
    another."""

    _holding: _Console | None = None

    def __init__(self, game: str) -> None:
        self._game = game
        self._env: Any = None
        env = self._taken()
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.buttons = tuple(str(name) for name in env.buttons)

    def reset(self, *, seed: int, options: Any = None) -> Any:
        return self._taken().reset(seed=seed)

    def step(self, action: Any) -> Any:
        return self._env.step(action)

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        if _Console._holding is self:
            _Console._holding = None
            self._env.close()
            self._env = None

    def _taken(self) -> Any:
        """The emulator with this console's game."""
        if _Console._holding is self:
            return self._env
        if _Console._holding is not None:
            _Console._holding.close()
        import stable_retro

        self._env = stable_retro.make(self._game, render_mode="rgb_array")
        _Console._holding = self
        return self._env


FAMILY = StableRetroFamily()
