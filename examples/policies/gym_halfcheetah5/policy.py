"""Half cheetah: a gait of six sine waves, one a joint, with a spring and a damper to follow them.

Every joint swings around a centre of its own with the same rhythm; what makes it run is the amplitudes and
phases, which were tuned together by evolution (CMA-ES) on the return. A little of the body's pitch is fed
back to the thighs. Now and then the start tips it over on its back, where it stays: a faster gait is a
riskier one.
"""

import numpy as np

STEP_S = 0.05
FREQUENCY = 4.137
"""Strides per second."""
#                      back thigh, shin, foot; front thigh, shin, foot
CENTRE = np.array([-0.236, -0.145, 0.004, -0.768, -0.236, -0.464])
AMPLITUDE = np.array([1.517, 2.762, 1.085, 1.181, 1.742, 0.24])
"""Radians."""
PHASE = np.array([0.337, 2.333, -0.747, 2.363, -2.75, 2.853])
STIFFNESS = 0.807
"""Share of the largest torque for a radian off the wanted angle."""
DAMPING = 0.0257
PITCH_FEEDBACK = np.array([0.984, 0.0, 0.0, -0.052, 0.0, 0.0])
"""Share of the largest torque for a radian of pitch."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.t = 0

    def reset(self, episode_index):
        self.t = 0

    def act(self, obs):
        angles, speeds, pitch = obs[2:8], obs[11:17], obs[1]
        wanted = CENTRE + AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * STEP_S * self.t + PHASE)
        self.t += 1
        torque = STIFFNESS * (wanted - angles) - DAMPING * speeds + PITCH_FEEDBACK * pitch
        return np.clip(torque, -1.0, 1.0)
