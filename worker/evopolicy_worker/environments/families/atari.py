"""The Arcade Learning Environment: Atari 2600 games, whose ROMs are in its wheel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily
from evopolicy_worker.environments.interface.info import plain_info
from evopolicy_worker.environments.tasks import template

_PARTS = {"UP": "up", "DOWN": "down", "LEFT": "left", "RIGHT": "right", "FIRE": "fire button"}


class AtariFamily(GymnasiumFamily):
    distributions = ("ale-py",)
    modules = ("gymnasium", "ale_py")
    extra = "atari"

    def load(self) -> None:
        super().load()
        import ale_py

        # Otherwise each game greets on stderr.
        ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)

    def info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        """Without the number of frames since the process began, which tells what was played before."""
        plain = plain_info(info)
        plain.pop("frame_number", None)
        return plain

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        console = env.unwrapped
        settings: dict[str, Any] = {} if console.spec is None else console.spec.kwargs
        choices = ((f"`{k}`", _choice(each)) for k, each in enumerate(console.get_action_meanings()))
        held = settings.get("frameskip", 1)
        if held == 1:
            duration = "It is held for one frame."
        else:
            frames = held if isinstance(held, int) else f"{held[0]} to {held[1] - 1}"
            at_random = "" if isinstance(held, int) else ", at random"
            duration = f"It is held for {frames} frames{at_random}; you see the last."
        if settings.get("repeat_action_probability"):
            duration += " Now and then, at random, the console goes on with the choice before."
        return {
            "": template.load("atari_games.toml")[settings["game"]],
            "Action": f"What is done with the joystick. {duration}\n\n"
            + template.table(("choice", "joystick"), choices),
        }


def _choice(meaning: str) -> str:
    """The joystick's position in words, from its name, such as UPRIGHTFIRE."""
    parts = []
    while meaning and meaning != "NOOP":
        part = next(each for each in _PARTS if meaning.startswith(each))
        parts.append(_PARTS[part])
        meaning = meaning.removeprefix(part)
    return " and ".join(parts) or "nothing"


FAMILY = AtariFamily()
