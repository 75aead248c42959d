"""MuJoCo environments of Gymnasium: the simulator's state read through arrays that were looked up once.

Replaces `step` and `_get_obs` of HalfCheetah, Reacher and Pusher. The library asks the simulator's bindings anew for
each array, and for each body by its name, on every step, which takes longer than the physics of Reacher. All
of them are views of memory that a simulation keeps for its whole life (a reset overwrites it), so here they are made
once. The library also has the simulator work out contact forces after each step (`mj_rnePostConstraint`), which the
observations and rewards of these three do not contain and the next step does not read; here it does not. The remaining
operations are the library's, with the same types and in the same order: single precision for the cost of an action,
doubles for all else.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.mujoco.pusher_v5 import PusherEnv
from gymnasium.envs.mujoco.reacher_v5 import ReacherEnv
from mujoco import mj_step

from evopolicy_worker.environments.accelerations.specialise import specialise


class _Direct(MujocoEnv):
    """The code that the three share."""

    fresh = True
    """Observations are new arrays of the space's dtype, which nobody has to copy."""

    def look_up(self) -> None:
        """Keep views of the arrays that every step reads."""
        self._ctrl, self._qpos, self._qvel = self.data.ctrl, self.data.qpos, self.data.qvel
        self._seconds = self.dt

    def gather(self, *parts: Any) -> None:
        """Keep room for an observation of these parts."""
        self._room = np.concatenate(parts)
        ends = np.cumsum([len(part) for part in parts])[:-1]
        self._parts = tuple(zip(np.split(self._room, ends), parts, strict=True))

    def gathered(self) -> Any:
        """Their numbers now, as `np.concatenate` joins them."""
        for room, part in self._parts:
            room[...] = part
        return self._room.copy()

    def do_simulation(self, ctrl: Any, n_frames: int) -> None:
        if ctrl.shape != self._ctrl.shape:
            raise ValueError(f"Action dimension mismatch. Expected {self._ctrl.shape}, found {ctrl.shape}")
        self._ctrl[...] = ctrl
        mj_step(self.model, self.data, n_frames)

    def position(self, body: str) -> Any:
        return self.data.xpos[self.model.body(body).id]


class DirectCheetah(_Direct, HalfCheetahEnv):
    def look_up(self) -> None:
        super().look_up()
        skipped = 1 if self._exclude_current_positions_from_observation else 0
        self.gather(self._qpos[skipped:], self._qvel)

    def step(self, action: Any) -> Any:
        qpos = self._qpos
        before = qpos.item(0)
        self.do_simulation(action, self.frame_skip)
        after = qpos.item(0)
        velocity = (after - before) / self._seconds
        forward = self._forward_reward_weight * velocity
        cost = float(self._ctrl_cost_weight * np.add.reduce(np.square(action)))
        info = {"x_position": after, "x_velocity": velocity, "reward_forward": forward, "reward_ctrl": -cost}
        return self._get_obs(), forward - cost, False, False, info

    def _get_obs(self) -> Any:
        return self.gathered()


class DirectReacher(_Direct, ReacherEnv):
    def look_up(self) -> None:
        super().look_up()
        self._fingertip, self._target = self.position("fingertip"), self.position("target")
        self._theta, self._aim, self._speeds = self._qpos[:2], self._qpos[2:], self._qvel[:2]
        self._room = np.empty(10)
        self._pairs = np.split(self._room, 5)

    def step(self, action: Any) -> Any:
        self.do_simulation(action, self.frame_skip)
        apart = self._fingertip - self._target
        dist = -math.sqrt(apart.dot(apart)) * self._reward_dist_weight
        ctrl = float(-np.add.reduce(np.square(action)) * self._reward_control_weight)
        info = {"reward_dist": dist, "reward_ctrl": ctrl}
        return self._observation(apart), dist + ctrl, False, False, info

    def _get_obs(self) -> Any:
        return self._observation(self._fingertip - self._target)

    def _observation(self, apart: Any) -> Any:
        cosines, sines, aim, speeds, gap = self._pairs
        np.cos(self._theta, cosines)
        np.sin(self._theta, sines)
        aim[...], speeds[...], gap[...] = self._aim, self._speeds, apart[:2]
        return self._room.copy()


class DirectPusher(_Direct, PusherEnv):
    def look_up(self) -> None:
        super().look_up()
        self._tips, self._object, self._goal = map(self.position, ("tips_arm", "object", "goal"))
        self.gather(self._qpos[:7], self._qvel[:7], self._tips, self._object, self._goal)

    def step(self, action: Any) -> Any:
        self.do_simulation(action, self.frame_skip)
        to_tips, to_goal = self._object - self._tips, self._object - self._goal
        near = -math.sqrt(to_tips.dot(to_tips)) * self._reward_near_weight
        dist = -math.sqrt(to_goal.dot(to_goal)) * self._reward_dist_weight
        ctrl = float(-np.add.reduce(np.square(action)) * self._reward_control_weight)
        info = {"reward_dist": dist, "reward_ctrl": ctrl, "reward_near": near}
        return self._get_obs(), dist + ctrl + near, False, False, info

    def _get_obs(self) -> Any:
        return self.gathered()


_CLASSES = {HalfCheetahEnv: DirectCheetah, ReacherEnv: DirectReacher, PusherEnv: DirectPusher}


def accelerate(env: Any) -> None:
    specialise(env, _CLASSES[type(env)])
    env.look_up()
