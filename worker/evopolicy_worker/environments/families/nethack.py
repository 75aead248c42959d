"""NetHack: the whole game with several goals (NLE), and small levels made for one skill each (MiniHack).

`reset(seed=)` of the packages has no effect: a game's generators are seeded beside it. Of what else decides a game, the
date's moon follows from the seed too, the game's birthday is set, and the folder in which a game keeps its files is
emptied.
"""

from __future__ import annotations

import _ctypes
import ctypes
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.catalogue import Entry, installs
from evopolicy_worker.environments.interface import spaces
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted, GymnasiumFamily
from evopolicy_worker.environments.tasks import template

_BIRTHDAY = 1_600_000_000
"""Start of every game, seconds since 1970: it determines shopkeepers' names and some prices."""
_LISTS = ("record", "logfile", "xlogfile", "paniclog")
"""Files with earlier games' scores, of which the game tells at its end."""
_KEYS = {13: "Enter", 27: "Escape", 32: "Space"}
_PALETTE = np.array(
    [
        *((85, 85, 85), (205, 60, 60), (60, 170, 60), (190, 130, 50), (80, 110, 230), (190, 80, 190)),
        *((60, 180, 180), (200, 200, 200), (120, 120, 120), (255, 150, 60), (110, 240, 110), (250, 240, 90)),
        *((140, 170, 255), (250, 140, 250), (120, 240, 240), (255, 255, 255)),
    ]
)
"""Red, green and blue of the terminal's colours."""


class NetHackFamily(GymnasiumFamily):
    distributions = ("nle", "minihack")
    modules = ("gymnasium", "nle", "minihack")
    extra = "nethack"
    # Its process is a C program with a folder of files, that takes commands of any kind.
    remembers = True

    def make(self, entry: Entry, *, render: bool) -> Any:
        import gymnasium

        assert entry.gymnasium_id is not None
        options = {"disable_env_checker": True, "fix_moon_phase": True, **entry.kwargs}
        return _Game(gymnasium.make(entry.gymnasium_id, **options).unwrapped)

    def decisive(self, entry: Entry) -> tuple[str, ...]:
        return self.distributions if _is_minihack(entry) else self.distributions[:1]

    def needs(self) -> str:
        return f"{super().needs()} and then pip install --no-deps {' '.join(installs.apart((self.extra,)))}"

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        common = template.load("nethack_words.toml")
        seen = (
            (f"`{name}`", common["observation"][name], template.space_text(spaces.to_schema(space)))
            for name, space in env.observation_space.spaces.items()
        )
        choices = ((f"`{k}`", _choice(each, common)) for k, each in enumerate(env.actions))
        # The package whose task it is, and its name without the part that all have in common.
        kind, prefix = ("minihack", "MiniHack-") if _is_minihack(entry) else ("nethack", "NetHack")
        name = str(entry.gymnasium_id).removeprefix(prefix)
        rows = template.load("nethack_tasks.toml")[kind]
        row = rows[max((key for key in rows if name.startswith(key)), key=len)]
        reward = row.get("reward", common[kind]["reward"])
        return {
            "": row["task"],
            "Observation": template.table(("component", "what it is", "form"), seen),
            "Action": f"{common[kind]['action']}\n\n{template.table(('choice', 'what it does'), choices)}",
            "Reward": f"{reward} {common[kind]['penalty']}".strip(),
            "Start": common[kind]["start"],
            "End": row.get("end", common[kind]["end"]),
        }


class _Game(Adapted):
    def __init__(self, raw: Any) -> None:
        self.raw = raw
        self.observation_space, self.action_space = raw.observation_space, raw.action_space
        self.actions: tuple[Any, ...] = tuple(raw.actions)
        self._folder = Path(raw.nethack._vardir)
        self._files = set(os.listdir(self._folder))
        self._max_episode_steps: int = raw._max_episode_steps

    def reset(self, *, seed: int, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._forget()
        # Not 0, with which the moon would follow the clock.
        self.raw.seed(seed + 1, seed + 1, False)
        obs, info = self.raw.reset()
        _set_birthday(self.raw.nethack.dlpath)
        return obs, _info(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.raw.step(action)
        # At its step limit a game is abandoned and reports that it has ended.
        aborted = info["end_status"].name == "ABORTED"
        return obs, reward, terminated and not aborted, truncated or aborted, _info(info)

    def render(self) -> NDArray[np.uint8]:
        """The terminal as a picture, 264 × 480."""
        seen = dict(zip(self.raw._observation_keys, self.raw.last_observation, strict=True))
        drawn = _letters()[seen["tty_chars"]]
        drawn[tuple(seen["tty_cursor"])] ^= True
        cells = np.where(drawn[..., None], _PALETTE[seen["tty_colors"] & 15][:, :, None, None], 0)
        rows, columns, height, width = drawn.shape
        return cells.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, 3).astype(np.uint8)

    def _forget(self) -> None:
        """Removes what earlier games have left in the folder of files."""
        for path in self._folder.iterdir():
            if path.name not in self._files:
                path.unlink()
            elif path.name in _LISTS:
                path.write_bytes(b"")
        for path in (self._folder / "save").iterdir():
            path.unlink()


def _info(info: dict[str, Any]) -> dict[str, Any]:
    """How the game stands, in words: `running`, `death`, `task_successful`, or `aborted` at the step limit."""
    status = info["end_status"].name
    return {
        **info,
        "end_status": status.lower(),
        "is_success": status == "TASK_SUCCESSFUL" or bool(info.get("is_ascended")),
    }


def _set_birthday(library: str) -> None:
    """Sets the start time of the running game, which it took from the clock. `library`: the game's library."""
    already = os.RTLD_LAZY | os.RTLD_NOLOAD
    loaded = ctypes.CDLL(library, mode=already)
    try:
        ctypes.c_long.in_dll(loaded, "ubirthday").value = _BIRTHDAY
    finally:
        # Held any longer, the next game would begin with the memory of this one.
        _ctypes.dlclose(loaded._handle)


def _choice(action: Any, common: Mapping[str, Any]) -> str:
    kind, name = type(action).__name__, action.name
    if kind.startswith("Compass"):
        way = common["direction"][name]
        effect = f"go far {way}, until something is of interest" if kind.endswith("Longer") else f"go {way}"
    else:
        effect = common["action"].get(f"{kind}.{name}") or common["action"][name]
    return f"{effect} (key {_key(int(action))})"


def _key(code: int) -> str:
    """A key's name, from what the game receives for it."""
    if code in _KEYS:
        return _KEYS[code]
    if code >= 128:
        return f"Meta and `{chr(code - 128)}`"
    return f"Control and `{chr(code + 96)}`" if code < 32 else f"`{chr(code)}`"


@cache
def _letters() -> NDArray[np.bool_]:
    """The set pixels of each of the 256 characters, in cells of 11 × 6 pixels."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default_imagefont()
    letters = []
    for code in range(256):
        cell = Image.new("L", (6, 11))
        ImageDraw.Draw(cell).text((0, 0), chr(code), fill=255, font=font)
        letters.append(np.asarray(cell) > 127)
    return np.stack(letters)


def _is_minihack(entry: Entry) -> bool:
    return str(entry.gymnasium_id).startswith("MiniHack-")


FAMILY = NetHackFamily()
