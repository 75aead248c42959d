"""Gymnasium's MuJoCo environments."""

from __future__ import annotations

from evopolicy_worker.environments.gymnasium_adapter import GymnasiumFamily


class MujocoFamily(GymnasiumFamily):
    distributions = ("gymnasium", "mujoco")
    modules = ("gymnasium", "mujoco")
    components = {
        "Reacher-v5": ("reward_dist", "reward_ctrl"),
        "HalfCheetah-v5": ("reward_forward", "reward_ctrl"),
        "Ant-v5": ("reward_forward", "reward_ctrl", "reward_contact", "reward_survive"),
        "Pusher-v5": ("reward_dist", "reward_ctrl", "reward_near"),
    }


FAMILY = MujocoFamily()
