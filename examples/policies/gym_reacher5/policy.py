"""Reacher: inverse kinematics for where to go, and a rehearsed spring and damper for how fast.

Two elbow bends put the fingertip on the target. Each joint is then drawn to its angle like a mass on a damped
spring. Torque is costly and so is time: which stiffness and damping are cheapest depends on the way to go, so
the first `act` plays the motion in its head for a grid of both, for both bends, with joints that do not
disturb each other (nearly true: their own inertia of 1 kg m² outweighs the links), and keeps the cheapest.
"""

import math

import numpy as np

LINK_1, LINK_2 = 0.1, 0.11
TORQUE = 200.0
"""Newton metres, which is also rad/s² here, of an action of 1."""
DAMPING = 1.0
STEP_S = 0.02
STEPS = 50
ELBOW_LIMIT = 2.9
STIFFNESS = np.array([4.0, 7.0, 11.0, 16.0, 22.0, 30.0, 40.0, 55.0, 75.0, 100.0])
DAMPING_RATIO = np.array([0.6, 0.75, 0.9, 1.05, 1.2])


def elbow_bends(x, y):
    """Joint angles that put the fingertip on (x, y), or as near as it can get; two of them."""
    distance = math.hypot(x, y)
    cosine = (distance**2 - LINK_1**2 - LINK_2**2) / (2 * LINK_1 * LINK_2)
    bend = min(ELBOW_LIMIT, math.acos(max(-1.0, min(1.0, cosine))))
    angles = []
    for theta2 in (bend, -bend):
        swing = math.atan2(LINK_2 * math.sin(theta2), LINK_1 + LINK_2 * math.cos(theta2))
        angles.append((wrap(math.atan2(y, x) - swing), theta2))
    return angles


def wrap(angle):
    """The same direction within ±π."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def rehearse(angles, goal, target):
    """Returns of moving to `goal` with each stiffness (rows) and damping ratio (columns)."""
    spring = STIFFNESS[:, None]
    damper = 2 * np.sqrt(spring) * DAMPING_RATIO
    theta = [np.full(damper.shape, angle) for angle in angles]
    omega = [np.zeros(damper.shape), np.zeros(damper.shape)]
    total = np.zeros(damper.shape)
    for _ in range(STEPS):
        for joint in (0, 1):
            action = np.clip((spring * (goal[joint] - theta[joint]) - damper * omega[joint]) / TORQUE, -1, 1)
            total -= action**2
            omega[joint] = omega[joint] + STEP_S * (TORQUE * action - DAMPING * omega[joint])
            theta[joint] = theta[joint] + STEP_S * omega[joint]
        x = LINK_1 * np.cos(theta[0]) + LINK_2 * np.cos(theta[0] + theta[1])
        y = LINK_1 * np.sin(theta[0]) + LINK_2 * np.sin(theta[0] + theta[1])
        total -= np.hypot(x - target[0], y - target[1])
    return total


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.goal = None

    def reset(self, episode_index):
        self.goal = None

    def act(self, obs):
        theta = np.array([math.atan2(obs[2], obs[0]), math.atan2(obs[3], obs[1])])
        if self.goal is None:
            self.choose(theta, obs[4:6])
        error = self.goal - theta
        error[0] = wrap(error[0])
        return np.clip((self.spring * error - self.damper * obs[6:8]) / TORQUE, -1, 1)

    def choose(self, theta, target):
        """Set the goal's angles, the spring and the damper that do best in rehearsal."""
        best = -math.inf
        for goal in elbow_bends(*target):
            returns = rehearse(theta, goal, target)
            row, column = np.unravel_index(returns.argmax(), returns.shape)
            if returns[row, column] > best:
                best = returns[row, column]
                self.goal = np.array(goal)
                self.spring = STIFFNESS[row]
                self.damper = 2 * math.sqrt(self.spring) * DAMPING_RATIO[column]
