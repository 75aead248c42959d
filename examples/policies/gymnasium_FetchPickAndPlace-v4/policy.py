"""Fetch pick and place: over the block, down, close the fingers, carry it to the target.

The phase is read off the observation every step, not counted: a block that slips is simply picked up again.
Approaching from above starts early: the lower the gripper is, the nearer to the block's axis it has to be.
"""

import numpy as np

GAIN = 20.0
"""Action per metre of way still to go: 1 (the most) from 0.05 m on."""
OPEN, CLOSE = 1.0, -1.0
CLEAR = 0.06
"""Height of the gripper over the block's centre from which the open fingers miss it (m)."""
ALIGNED = 0.012
"""Sideways distance to the block's axis from which the gripper may go all the way down (m)."""
GRASP_DEPTH = 0.012
"""Height difference at which the fingers may close (m)."""
BLOCK_WIDTH = 0.05
GRIPPED = 0.004
"""Fingers no wider than the block by more than this hold it (m)."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        state = obs["observation"]
        gripper, block, target = state[0:3], obs["achieved_goal"], obs["desired_goal"]
        to_block = block - gripper
        sideways = float(np.hypot(to_block[0], to_block[1]))
        opening = state[9] + state[10]
        if sideways < 2 * ALIGNED and abs(to_block[2]) < 2 * GRASP_DEPTH and opening < BLOCK_WIDTH + GRIPPED:
            move, fingers = target - block, CLOSE
        elif sideways < ALIGNED and abs(to_block[2]) < GRASP_DEPTH:
            move, fingers = to_block, CLOSE
        else:
            move, fingers = to_block, OPEN
            if sideways > ALIGNED and -to_block[2] < CLEAR + sideways:
                move = to_block + [0.0, 0.0, CLEAR]
        return np.append(np.clip(GAIN * move, -1, 1), fingers)
