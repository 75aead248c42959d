"""MiniWorld: rooms and mazes in 3D, seen by a camera; drawn by OpenGL without a display."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.families.mujoco import check_rendering
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily
from evopolicy_worker.environments.tasks import template

_PICTURE = (
    "what a camera on the agent sees: a picture with its rows from the top and its columns from the left, red, green"
    " and blue"
)
_PICTURE_FOR_PEOPLE = (400, 300)
_ACTIONS = (
    "turn to the left",
    "turn to the right",
    "go forward",
    "go back",
    "pick up what is in front, within reach",
    "put down what is carried",
    "nothing: no object here can be toggled",
    "nothing: no task here needs to be declared done",
)


class MiniWorldFamily(GymnasiumFamily):
    distributions = ("miniworld",)
    also = ("pyglet",)
    modules = ("gymnasium", "miniworld")
    extra = "miniworld"
    measures = True

    def make(self, entry: Entry, *, render: bool) -> Any:
        """As others; observations are drawn, so WorkerError where the host has no EGL."""
        fault = "draws its observations with EGL, which is not installed"
        check_rendering(entry, render=True, fault=fault)
        import gymnasium

        assert entry.gymnasium_id is not None
        _root().switch_to()
        # The window for people takes sixty megabytes even when it is not shown.
        width, height = _PICTURE_FOR_PEOPLE if render else (1, 1)
        size: dict[str, Any] = {"window_width": width, "window_height": height}
        mode = "rgb_array" if render else None
        env = gymnasium.make(entry.gymnasium_id, disable_env_checker=True, render_mode=mode, **size)
        _in_its_context(env.unwrapped)
        return env

    def packages(self, entry: Entry) -> dict[str, str]:
        """With the OpenGL that draws: other versions draw other pixels."""
        from pyglet.gl import gl_info

        version = f"{gl_info.get_version()} {gl_info.get_renderer()}"[:120]
        return super().packages(entry) | {"opengl": version}

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        name, texts = str(entry.gymnasium_id).split("-")[1], template.load("miniworld_rooms.toml")
        meanings = (*_ACTIONS[:3], "end the episode") if name == "Sign" else _ACTIONS[: env.action_space.n]
        choices = ((f"`{k}`", meaning) for k, meaning in enumerate(meanings))
        observation = f"The observation is {_PICTURE}."
        if name == "Sign":
            observation = f"`obs` is {_PICTURE}. `goal` is 0 for a box and 1 for a key."
        return {
            "": texts[name],
            "Observation": observation,
            "Action": f"A small movement each.\n\n{template.table(('choice', 'what it does'), choices)}",
            "Reward": texts["reward"].get(name, texts["reward"]["goal"]),
            "Start": texts["start"],
            "End": texts["end"].get(name, texts["end"]["goal"]),
        }


@cache
def _root() -> Any:
    """A window that lives as long as the process. Contexts made while it is current share its textures, which MiniWorld
    keeps for all environments."""
    import pyglet

    return pyglet.window.Window(width=1, height=1, visible=False)


def _in_its_context(room: Any) -> None:
    """Makes an environment draw in the context in which it was made, and free that when it is closed.

    MiniWorld draws in whichever context is current, and leaves its own to the garbage collector. Once that frees one,
    none is current, and another environment in the middle of an episode cannot draw.
    """
    window = room.shadow_window

    def within(method: Callable[..., Any]) -> Callable[..., Any]:
        def called(*args: Any, **kwargs: Any) -> Any:
            window.switch_to()
            return method(*args, **kwargs)

        return called

    for name in ("reset", "step", "render"):
        setattr(room, name, within(getattr(room, name)))

    def close() -> None:
        if window.context is not None:
            window.close()
            _root().switch_to()

    room.close = close


FAMILY = MiniWorldFamily()
