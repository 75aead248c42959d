"""ViZDoom: the scenarios of its wheel, and the levels of Freedoom, seen by the player.

The game is a process of its own, which plays one step when it is told to. It shares memory with this process and writes
into the folder in which it was started; here that is a temporary one, which goes with the environment. It waits for its
next step for ever, so the kernel ends it with this process, which may be killed. The names of the shared memory are
removed once both have it, so that nothing of it outlasts them.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import tempfile
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.processes.parent_death import ending_with_parent
from evopolicy_worker.environments.interface import spaces
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted, GymnasiumFamily
from evopolicy_worker.environments.tasks import template

MOST_DELTA = 50.0
"""Most that a step may turn or look, degrees, or move to the side, units of the map. The package has the largest
float."""
_SHARED = "/dev/shm"


class VizdoomFamily(GymnasiumFamily):
    distributions = ("vizdoom",)
    modules = ("gymnasium", "vizdoom")
    extra = "vizdoom"
    # Its process is a game with a folder of files, which goes on from episode to episode.
    remembers = True

    def load(self) -> None:
        import gymnasium
        from vizdoom import gymnasium_wrapper

        gymnasium.register_envs(gymnasium_wrapper)

    def make(self, entry: Entry, *, render: bool) -> Any:
        return _Game(super().make(entry, render=False).unwrapped)

    def rebuilds(self, entry: Entry) -> bool:
        # A level goes on with the random numbers of the game before. Scenarios repeat.
        return _scenario(entry) == "Freedoom"

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        scenarios = template.load("vizdoom_scenarios.toml")
        texts, common = scenarios[_scenario(entry)], scenarios["common"]
        numbers = [f"`[{k}]` {common['variable'][each]}" for k, each in enumerate(env.variables)]
        parts = {**common["observation"], **texts.get("observation", {}), "gamevariables": "; ".join(numbers)}
        # The package's bounds of numbers are those of the type.
        seen = (
            (
                f"`{name}`",
                parts[name],
                f"an array of shape {space.shape} of float32"
                if name == "gamevariables"
                else template.space_text(spaces.to_schema(space)),
            )
            for name, space in env.observation_space.spaces.items()
        )
        return {
            "": texts["about"] + _level(entry),
            "Observation": "A dict. The observation after the last step is all zeros.\n\n"
            + template.table(("component", "what it is", "form"), seen),
            "Action": _actions(env, common["button"]),
            "Reward": texts["reward"],
            "Start": texts.get("start", common["start"]),
            "End": texts["end"],
        }


class _Game(Adapted):
    def __init__(self, raw: Any) -> None:
        """`raw`: the package's environment, whose game has not begun."""
        from gymnasium import spaces

        self.raw = raw
        self._folder = tempfile.TemporaryDirectory(prefix="doom-")
        self.observation_space, self.action_space = raw.observation_space, raw.action_space
        self.variables = tuple(each.name for each in raw.game.get_available_game_variables())
        buttons = tuple(each.name for each in raw.game.get_available_buttons())
        self.deltas, self.buttons = buttons[: raw.num_delta_buttons], buttons[raw.num_delta_buttons :]
        self.choices = (
            tuple(tuple(map(int, row)) for row in raw.button_map) if raw.max_buttons_pressed else None
        )
        """Which buttons each choice presses; None where each button is chosen by itself."""
        if self.deltas:
            bounded = spaces.Box(-MOST_DELTA, MOST_DELTA, (len(self.deltas),), np.float32)
            self.action_space = spaces.Dict([("binary", raw.action_space["binary"]), ("continuous", bounded)])

    def reset(self, *, seed: int, options: Any = None) -> Any:
        if self.raw.game.is_running():
            return self.raw.reset(seed=seed)
        _check_shared_memory()
        self.raw.game.set_vizdoom_path(_program(Path(self._folder.name)))
        before = os.getcwd()
        os.chdir(self._folder.name)
        try:
            return self.raw.reset(seed=seed)
        finally:
            os.chdir(before)
            _remove_names()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, ended, truncated, info = self.raw.step(action)
        # A game that its own time limit ends counts as both.
        return obs, reward, ended and not truncated, truncated, info

    def render(self) -> Any:
        state = self.raw.state
        shape = self.observation_space["screen"].shape
        return np.zeros(shape, np.uint8) if state is None else state.screen_buffer

    def close(self) -> None:
        super().close()
        self._folder.cleanup()


def _program(folder: Path) -> str:
    """The game's program, which ends with this process: a script in the folder, since the package starts it itself."""
    import vizdoom

    game = str(Path(vizdoom.__file__).with_name("vizdoom"))
    script = folder / "vizdoom.sh"
    command = shlex.join(ending_with_parent([game], signal.SIGKILL))
    script.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
    script.chmod(0o700)
    # A folder may be on a file system from which nothing is executed.
    return str(script) if os.access(script, os.X_OK) else game


def _check_shared_memory() -> None:
    """WorkerError in a jail without shared memory: the package would wait for its game for ever."""
    try:
        tempfile.TemporaryFile(dir=_SHARED).close()
    except OSError as error:
        raise WorkerError(
            f"ViZDoom shares memory with its game in {_SHARED}, which sandbox tier landlock hides ({error.strerror}):"
            " it is played in tier bwrap; `evopolicy-worker doctor` tells how to get it"
        ) from error


def _remove_names() -> None:
    """Removes the names of the shared memory of this process's games. They opened it when they began, and need them no
    more."""
    with open("/proc/self/maps", encoding="utf-8", errors="surrogateescape") as maps:
        shared = {line.split(maxsplit=5)[-1].rstrip("\n") for line in maps if f" {_SHARED}/ViZDoom" in line}
    for path in shared:
        # Of a game that began before, only the deleted name is listed.
        with contextlib.suppress(OSError):
            os.unlink(path)


def _scenario(entry: Entry) -> str:
    """Key of the texts, from an id such as `VizdoomBasic-MultiBinary-v1` or `VizdoomFreedoom2MAP01-S3-v0`."""
    name = str(entry.gymnasium_id).removeprefix("Vizdoom").partition("-")[0]
    return "Freedoom" if name.startswith("Freedoom") else name


def _level(entry: Entry) -> str:
    """Which level of Freedoom it is, in a sentence; empty for a scenario."""
    if _scenario(entry) != "Freedoom":
        return ""
    name, skill, _ = str(entry.gymnasium_id).removeprefix("VizdoomFreedoom").split("-")
    return f" This is level {name[1:]} of part {name[0]}, at skill {skill[1]} of 5, where 5 is the hardest."


def _actions(game: _Game, effects: dict[str, str]) -> str:
    """The buttons, as the action space has them."""
    binary = [effects[name] for name in game.buttons]
    if game.choices is None:
        about, head = "For each button, 1 presses it and 0 leaves it.", ("component", "effect of the button")
    else:
        about, head = "One choice a step.", ("choice", "effect")
        binary = [", and ".join(compress(binary, row)) or "none" for row in game.choices]
    text = f"{about}\n\n{_numbered(head, binary)}"
    if not game.deltas:
        return text
    rest = _numbered(("component", "effect"), [effects[name] for name in game.deltas])
    return f"`binary` is for the buttons. {text}\n\n`continuous` is for the rest:\n\n{rest}"


def _numbered(head: tuple[str, str], effects: list[str]) -> str:
    return template.table(head, ((f"`{k}`", each) for k, each in enumerate(effects)))


FAMILY = VizdoomFamily()
