"""Gymnasium's MuJoCo environments, and what every family that draws with MuJoCo needs."""

from __future__ import annotations

from collections.abc import Mapping
from ctypes.util import find_library
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.processes import distribution
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily

if TYPE_CHECKING:
    import gymnasium


class MujocoFamily(GymnasiumFamily):
    """Articulated bodies."""

    distributions: tuple[str, ...] = ("gymnasium", "mujoco")
    modules: tuple[str, ...] = ("gymnasium", "mujoco")
    components: Mapping[str, Mapping[str, str]] = {
        "Reacher-v5": {
            "reward_dist": "cost of the distance between fingertip and target",
            "reward_ctrl": "cost of torque",
        },
        "HalfCheetah-v5": {"reward_forward": "forward speed", "reward_ctrl": "cost of torque"},
        "Ant-v5": {
            "reward_forward": "speed along positive x",
            "reward_ctrl": "cost of torque",
            "reward_contact": "cost of contact forces",
            "reward_survive": "bonus while healthy",
        },
        "Pusher-v5": {
            "reward_dist": "cost of the distance between cylinder and goal",
            "reward_ctrl": "cost of torque",
            "reward_near": "cost of the distance between wrist and cylinder",
        },
    }

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        """As in other families. Raises WorkerError when an image is requested and the host has no EGL to render it."""
        check_rendering(entry, render=render)
        return super().make(entry, render=render)


def check_rendering(entry: Entry, *, render: bool) -> None:
    """Raises WorkerError when an image is requested and the host has no EGL to render it."""
    if render and find_library("EGL") is None:
        raise WorkerError(
            f"{entry.id} renders with EGL, which is not installed: {distribution.install('egl')}"
        )


FAMILY = MujocoFamily()
