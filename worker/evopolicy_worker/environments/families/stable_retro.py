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


class StableRetroFamily(GymnasiumFamily):
    distributions = ("stable-retro",)
    modules = ("gymnasium", "stable_retro")
    extra = "stable-retro"

    def load(self) -> None:
        """Imports the package, which registers nothing."""
        import stable_retro  # noqa: F401

    def make(self, entry: Entry, *, render: bool) -> Any:
        return _Console(str(entry.gymnasium_id))

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        rows = ((f"`{k}`", name, _BUTTONS.get(name, "none")) for k, name in enumerate(env.buttons))
        return {
            "Action": "Which buttons are pressed for one frame, 1 for each that is. Left and right together have no"
            f" effect.\n\n{template.table(('component', 'button', 'effect'), rows)}"
        }


class _Console(Adapted):
    """A game in the emulator, of which a process can have only one: the console that begins an episode takes it from
    another."""

    _holding: _Console | None = None

    def __init__(self, game: str) -> None:
        self._game = game
        env = self._taken()
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.buttons = tuple(str(name) for name in env.buttons)

    def reset(self, *, seed: int, options: Any = None) -> Any:
        return self._taken().reset(seed=seed)

    def close(self) -> None:
        if _Console._holding is self:
            _Console._holding = None
            super().close()
            self.raw = None

    def _taken(self) -> Any:
        if _Console._holding is self:
            return self.raw
        if _Console._holding is not None:
            _Console._holding.close()
        import stable_retro

        self.raw = stable_retro.make(self._game, render_mode="rgb_array")
        _Console._holding = self
        return self.raw


FAMILY = StableRetroFamily()
