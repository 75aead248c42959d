"""Pusher: bring the arm's open fork down behind the cylinder, then carry it before the fork to the goal.

The wrist carries two fingers and a bar between them: a fork that opens away from the forearm. The bar pushes
the cylinder forward, a finger pushes it sideways, and a cylinder between the fingers does not get away. Where
the wrist shall be follows from where the cylinder is, a little ahead of where it would just touch. Which
joint angles bring it there is looked up in a table of postures, of which the one nearest to the present
posture is taken. Springs and dampers draw the joints to it; they are soft, for torque is costly.
"""

import itertools
import math

import numpy as np

BASE = np.array([0.0, -0.6])
SHOULDER, UPPER_ARM, FOREARM = 0.1, 0.4, 0.321
"""Base's axis to shoulder, shoulder to elbow, elbow to wrist (m)."""
PUSH_HEIGHT, CLEAR_HEIGHT = -0.275, -0.19
"""z of the wrist while it pushes, and while it passes over the cylinder."""
BAR_TO_CYLINDER = 0.075
"""Distance of the wrist from the cylinder's middle when the bar touches it."""
FINGER_SLACK = 0.015
"""How far the cylinder's middle is beside the fork's when a finger touches it."""
LEAD = 0.1
"""How far ahead of touching the wrist is drawn while it pushes (m)."""
ARRIVED = 0.008
"""The cylinder is pushed no further when it is this near to the goal (m)."""
ABOVE = 0.08
"""Sideways distance from the place behind the cylinder from which the wrist comes down (m)."""
STIFFNESS = np.array([2.5, 2.5, 1.0, 2.0, 0.25, 0.25, 0.15])
DAMPING = np.array([1.4, 1.4, 0.42, 0.7, 0.07, 0.07, 0.07])
WRIST_FLEX_MIN = -1.094


def wrist_of(lift, roll, elbow):
    """The wrist with the pan at 0, seen from the base's axis: (x, y, z) in metres. Takes arrays."""
    along = UPPER_ARM + FOREARM * np.cos(elbow)
    bent = FOREARM * np.sin(elbow)
    aside, below = bent * np.sin(roll), -bent * np.cos(roll)
    x = SHOULDER + along * np.cos(lift) + below * np.sin(lift)
    z = -along * np.sin(lift) + below * np.cos(lift)
    return x, aside, z


def posture_table():
    """Postures with a low wrist: rows of (lift, roll, elbow), and of the wrists' (distance, direction, height)."""
    grid = itertools.product(np.linspace(0, 1.39, 48), np.linspace(-1.4, 1.4, 9), np.linspace(-2.3, 0, 48))
    postures = np.array(list(grid))
    x, y, z = wrist_of(*postures.T)
    low = (z > PUSH_HEIGHT - 0.012) & (z < CLEAR_HEIGHT + 0.012)
    return postures[low], np.stack([np.hypot(x, y), np.arctan2(y, x), z], axis=1)[low]


POSTURES, WRISTS = posture_table()


def posture_for(place, height, angles):
    """Pan, lift, roll and elbow, near to the present ones, that bring the wrist over a place on the table."""
    distance, direction = math.hypot(*(place - BASE)), math.atan2(*(place - BASE)[::-1])
    miss = ((WRISTS[:, 0] - distance) ** 2 + (WRISTS[:, 2] - height) ** 2) / 0.01**2
    pan = direction - WRISTS[:, 1]
    change = (pan - angles[0]) ** 2 + ((POSTURES - angles[1:4]) ** 2) @ np.array([1.0, 0.3, 0.5])
    best = int(np.argmin(miss + change))
    return np.array([min(1.7, max(-2.28, pan[best])), *POSTURES[best]])


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass

    def reset(self, episode_index):
        pass

    def act(self, obs):
        angles, speeds, wrist = obs[0:7], obs[7:14], obs[14:17]
        cylinder, goal = obs[17:19], obs[20:22]
        way = goal - cylinder
        left = float(np.hypot(*way))
        heading = self.fork_heading(angles)
        forward = np.array([math.cos(heading), math.sin(heading)])
        side = np.array([-forward[1], forward[0]])
        behind = cylinder - BAR_TO_CYLINDER * forward
        if left > ARRIVED:
            behind -= FINGER_SLACK * max(-1.0, min(1.0, 2 * (way @ side) / left)) * side
        off = float(np.hypot(*(wrist[:2] - behind)))
        down = off < ABOVE or (wrist[2] < PUSH_HEIGHT + 0.04 and off < 2 * ABOVE)
        place = behind
        if down and wrist[2] < PUSH_HEIGHT + 0.05 and left > ARRIVED:
            place = behind + way * min(1.0, LEAD / left)
        pan, lift, roll, elbow = posture_for(place, PUSH_HEIGHT if down else CLEAR_HEIGHT, angles)
        # The forearm's roll undoes the upper arm's, the wrist's bend its slope, as far as that goes.
        slope = lift + elbow * math.cos(roll)
        wanted = np.array([pan, lift, roll, elbow, -roll, max(WRIST_FLEX_MIN, min(0.0, -slope)), 0.0])
        return np.clip(STIFFNESS * (wanted - angles) - DAMPING * speeds, -2, 2)

    def fork_heading(self, angles):
        """Direction on the table in which the forearm points (rad)."""
        pan, lift, roll, elbow = angles[:4]
        x = math.cos(elbow) * math.cos(lift) - math.sin(elbow) * math.cos(roll) * math.sin(lift)
        return pan + math.atan2(math.sin(elbow) * math.sin(roll), x)
