"""Ant: a gait of eight sine waves, one a joint, with a spring and a damper to follow them.

Standing still earns a point a step, and hard work on the joints costs more than that: the gait must go far on
little torque. Every joint swings around a centre of its own with the same rhythm; centres, amplitudes and
phases were tuned together by evolution (CMA-ES) on the return, from a trot. The hips also steer: what the
heading is off the positive x axis is added, weighted, to the angles that they are to have.
"""

import math

import numpy as np

STEP_S = 0.05
FREQUENCY = 1.800
"""Strides per second."""
# Hip and ankle of leg 1, then of legs 2, 3 and 4, as in the observation.
CENTRE = np.array([0.064, 0.781, -0.213, -0.539, 0.825, 0.434, -0.21, 1.064])
AMPLITUDE = np.array([1.333, 0.683, 1.342, 0.429, 1.241, 0.814, 0.478, 1.401])
"""Radians."""
PHASE = np.array([-2.201, -1.871, 0.149, -2.299, -1.96, 0.937, -2.397, -1.766])
STEERING = np.array([0.168, 0.0, 0.247, 0.0, 1.14, 0.0, -0.129, 0.0])
"""Radians for a radian of heading."""
STIFFNESS = 0.314
"""Share of the largest torque for a radian off the wanted angle."""
DAMPING = 0.0246
MOTORS = [6, 7, 0, 1, 2, 3, 4, 5]
"""The motors' order: leg 4 comes first."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.t = 0

    def reset(self, episode_index):
        self.t = 0

    def act(self, obs):
        angles, speeds = obs[5:13], obs[19:27]
        heading = math.remainder(2 * math.atan2(obs[4], obs[1]), 2 * math.pi)
        wanted = CENTRE + AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * STEP_S * self.t + PHASE)
        wanted += STEERING * heading
        self.t += 1
        torque = STIFFNESS * (wanted - angles) - DAMPING * speeds
        return np.clip(torque[MOTORS], -1.0, 1.0)
