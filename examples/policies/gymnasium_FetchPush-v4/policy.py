"""Fetch push: get behind the block, seen from the target, and push it along the line to the target.

Phases: while the gripper is not behind the block, go to the place behind it, low where the way is free, else
over the block; then push, steering so that gripper, block and target stay in line. A pushed block slides on
when the gripper stops, so what counts is where it will come to rest: once that is the target, the gripper
stands back.
"""

import numpy as np

STEP_S = 0.04
GAIN = 20.0
"""Action per metre of way still to go: 1 (the most) from 0.05 m on."""
PUSH_HEIGHT = 0.425
"""z of the gripper when it pushes: the block's middle."""
CLEAR_HEIGHT = 0.515
"""z from which on the gripper passes over the block without touching it."""
BEHIND = 0.075
"""Distance behind the block's centre at which the push starts (m): half of block and fingers, and some air."""
IN_LINE = 0.02
"""How far beside the line of the push the gripper may be when it starts (m)."""
TOUCH = 0.07
"""Nearer to the block's centre than this the gripper may touch it (m)."""
FRICTION_DECELERATION = 7.5
"""m/s² by which the sliding block slows down."""
METRES_PER_ACTION = 0.031
"""How far the gripper moves in a step for an action of 1."""
CAUTION = 0.7
"""Share of the speed from which the block would just slide to the target: it bounces ahead of the fingers."""
CLOSE_ENOUGH = 0.02
"""The block is pushed no further when it comes to rest this near to the target (m); 0.05 counts."""
TOO_FAR = 0.04
"""A block that has been let go is pushed again when it rests further from the target than this (m)."""


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.pushing = False
        self.done = False

    def reset(self, episode_index):
        self.pushing = False
        self.done = False

    def act(self, obs):
        state = obs["observation"]
        gripper, block, target = state[0:3], obs["achieved_goal"], obs["desired_goal"]
        velocity = (state[14:16] + state[20:22]) / STEP_S
        rest = block[:2] + velocity * np.hypot(*velocity) / (2 * FRICTION_DECELERATION)
        way = target[:2] - rest
        distance = float(np.hypot(*way))
        self.done = distance < (TOO_FAR if self.done else CLOSE_ENOUGH)
        if self.done:
            self.pushing = False
            return np.zeros(4)
        forward = way / distance
        to_block = block[:2] - gripper[:2]
        behind = to_block @ forward
        beside = to_block - behind * forward
        if self.pushing:
            self.pushing = behind > 0.02 and np.hypot(*beside) < 2 * IN_LINE
        else:
            self.pushing = behind > 0.04 and np.hypot(*beside) < IN_LINE and gripper[2] < PUSH_HEIGHT + 0.025
        if self.pushing:
            move = self.push(gripper, forward, distance, beside)
        else:
            move = self.approach(gripper, block, block[:2] - BEHIND * forward)
        return np.append(np.clip(move, -1, 1), 0.0)

    def push(self, gripper, forward, distance, beside):
        """The action that goes on along the line, and back onto it, no faster than the block may slide."""
        speed = CAUTION * STEP_S * np.sqrt(2 * FRICTION_DECELERATION * distance)
        plane = forward * speed / METRES_PER_ACTION + 2.0 * GAIN * beside
        return np.append(plane, GAIN * (PUSH_HEIGHT - gripper[2]))

    def approach(self, gripper, block, place):
        """The action that leads to `place` on the table without touching the block."""
        offset = place - gripper[:2]
        near = passing_distance(gripper[:2], place, block[:2]) < TOUCH - 0.01
        height = CLEAR_HEIGHT if near else PUSH_HEIGHT
        if near and np.hypot(*(block[:2] - gripper[:2])) < TOUCH + 0.01 and gripper[2] < CLEAR_HEIGHT - 0.015:
            offset = np.zeros(2)
        return GAIN * np.append(offset, height - gripper[2])


def passing_distance(start, end, point):
    """Least distance between a point and the straight way from start to end."""
    way = end - start
    share = np.clip((point - start) @ way / max(way @ way, 1e-9), 0.0, 1.0)
    return float(np.hypot(*(start + share * way - point)))
