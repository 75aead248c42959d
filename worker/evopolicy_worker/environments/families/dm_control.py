"""The DeepMind Control suite: bodies and simple machines in MuJoCo.

A task is loaded once and draws each start from the case's seed. Its own OpenGL is left out: frames are drawn as those
of other MuJoCo environments are.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.families.mujoco import MujocoFamily, check_rendering
from evopolicy_worker.environments.interface import spaces
from evopolicy_worker.environments.interface.gymnasium_adapter import Adapted
from evopolicy_worker.environments.tasks import template

_HEIGHT, _WIDTH = 180, 240
_SYSTEM_SEED = 0
"""Draws what a task's model has at random (the springs of `lqr`): the same in every episode."""
_UNLIMITED = 1e10
"""The suite's value for an action without a limit."""
_UNITS = "Lengths are in metres, angles in radians, velocities by the second; x points forwards or to the right, z upwards."  # noqa: E501


class DmControlFamily(MujocoFamily):
    distributions = ("dm-control", "mujoco")
    also = ("scipy", "lxml")
    modules = ("gymnasium", "mujoco", "dm_control")
    extra = "dm-control"

    def load(self) -> None:
        import gymnasium  # noqa: F401
        import mujoco  # noqa: F401

        # On import it initialises the OpenGL that this names, which no process may keep across a fork.
        usual = os.environ.get("MUJOCO_GL")
        os.environ["MUJOCO_GL"] = "disabled"
        try:
            from dm_control import suite  # noqa: F401
        finally:
            del os.environ["MUJOCO_GL"]
            os.environ |= {} if usual is None else {"MUJOCO_GL": usual}

    def make(self, entry: Entry, *, render: bool) -> Any:
        check_rendering(entry, render=render)
        return _Task(*_names(entry))

    def task_sections(self, entry: Entry, env: Any) -> dict[str, str]:
        domain, task = _names(entry)
        texts = template.load("dm_control_tasks.toml")[domain]
        objective, reward = texts["tasks"][task]
        parts = texts["observation"] | texts.get("also", {})
        rows = (
            (
                f"`{name}`",
                parts[name].replace("{joints}", env.joints),
                template.space_text(spaces.to_schema(part)),
            )
            for name, part in env.observation_space.spaces.items()
        )
        bounds = zip(env.actuators, env.action_space.low, env.action_space.high, strict=True)
        motors = ((f"`{k}`", name, f"{low:g} to {high:g}") for k, (name, low, high) in enumerate(bounds))
        head = "number", "its name in the model", "range"
        return {
            "": f"{texts['about']} {objective}",
            "Observation": f"A dict. {_UNITS}\n\n{template.table(('component', 'what it is', 'values'), rows)}",
            "Action": f"{texts['action']}\n\n{template.table(head, motors)}",
            "Reward": f"What each step pays: {reward[0].lower()}{reward[1:]}",
            "Start": f"{texts['start']} The seed of the episode decides.",
            "End": texts.get("end", "Never terminates by itself."),
        }


def _names(entry: Entry) -> tuple[str, str]:
    """Domain and task, from an id such as `dm_control/cartpole-swingup-v0`."""
    domain, task, _ = str(entry.gymnasium_id).partition("/")[2].split("-")
    return domain, task


class _Task(Adapted):
    def __init__(self, domain: str, task: str) -> None:
        import mujoco
        from dm_control import suite
        from gymnasium import spaces

        self._task = suite.load(domain, task, task_kwargs={"random": _SYSTEM_SEED})
        self._physics: Any = self._task.physics
        # Nothing to draw with: some tasks would otherwise ask OpenGL for it in each reset.
        own = type(self._physics)
        self._physics.__class__ = type(own.__name__, (own,), {"contexts": None})
        self._renderer: Any = None
        spec = self._task.action_spec()
        low, high = (
            np.broadcast_to(np.where(np.abs(each) < _UNLIMITED, each, np.copysign(np.inf, each)), spec.shape)
            for each in (spec.minimum, spec.maximum)
        )
        self.action_space = spaces.Box(low.astype(np.float64), high.astype(np.float64), dtype=np.float64)
        parts = self._task.observation_spec().items()
        self.observation_space = spaces.Dict(
            [(name, spaces.Box(-np.inf, np.inf, part.shape, np.float64)) for name, part in parts]
        )
        model = self._physics.model
        self.actuators = [model.id2name(k, "actuator") for k in range(model.nu)]
        hinges = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE))
        self.joints = ", ".join(
            f"{k} {model.id2name(joint, 'joint')} ({low:.2g} to {high:.2g})"
            for k, (joint, (low, high)) in enumerate(zip(hinges, model.jnt_range[hinges], strict=True))
        )
        """The model's hinges with their ranges, in the order in which observations have them."""

    def reset(self, *, seed: int, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._free()
        self._task.task._random = np.random.RandomState(seed)
        return self._task.reset().observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        step = self._task.step(action)
        ended, truncated = step.last(), bool(step.discount)
        return step.observation, step.reward, ended and not truncated, ended and truncated, {}

    def render(self) -> Any:
        if self._renderer is None:
            from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

            model = self._physics.model.ptr
            # Without a graphics card, shadows take most of a frame's time.
            model.vis.quality.shadowsize = 0
            camera, data = 0 if model.ncam else None, self._physics.data.ptr
            self._renderer = MujocoRenderer(model, data, width=_WIDTH, height=_HEIGHT, camera_id=camera)
        return self._renderer.render("rgb_array")

    def close(self) -> None:
        self._free()
        self._physics.free()

    def _free(self) -> None:
        """A renderer keeps the terrain of the episode in which it was made."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


FAMILY = DmControlFamily()
