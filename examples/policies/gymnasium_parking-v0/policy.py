"""Parking: rehearse a few hundred simple manoeuvres in the known model of the car, and drive the best.

A manoeuvre first goes a little forward or backward with a fixed steering angle, to turn the car round, and
then steers onto the middle line of the space and along it: the further beside the line the car is, the more
its wanted heading turns towards it. Being parked does not ask for standing still, so the quickest way in
wins. The model is exact; the choice is made once, in the first `act`.

All is computed as if the space lay at positive y; for the other row, y and the steering are mirrored.
"""

import itertools
import math

import numpy as np

STEPS = 80
"""Steps that a rehearsal is long."""
DT = 1 / 15
SUBSTEPS = 3
ACCELERATION = 5.0
STEERING = math.pi / 4
HALF_LENGTH = 2.5
"""From the car's middle to its axles and ends (m)."""
SCALE = np.array([100.0, 100.0, 5.0, 5.0, 1.0, 1.0])
PARKED = 0.0144
"""Weighted distance under which the car is parked; aimed at with some reserve."""
RESERVE = 0.9
WALL_X, WALL_Y = 31.5, 17.5
"""The car's middle stays within these, clear of the walls (m)."""
CRASH = 200.0
STEER_GAIN = 2.5

MANOEUVRES = np.array(
    [
        (first, gear, steering, reach, turn, speed)
        for first, gear, steering in [
            (0, 1, 0),
            *itertools.product((2, 4, 6, 8, 10, 12), (-1, 1), (-1, 0, 1)),
        ]
        for reach, turn, speed in itertools.product((3.0, 5.0, 8.0, 12.0), (1.1, 1.57), (6.0, 11.0))
    ]
).T
"""One a column: steps of the first part, its gear and steering; then the distance from the line (m) at which
the wanted heading is turned fully, by how much (rad), and the speed (m/s).
"""


def control(manoeuvre, t, x, heading, speed):
    """Acceleration and steering at step `t`, each −1 to 1; x is how far the car is beside the line."""
    first, gear, steering, reach, turn, top_speed = manoeuvre
    wanted = math.pi / 2 + turn * np.clip(x / reach, -1, 1)
    error = (wanted - heading + math.pi) % (2 * math.pi) - math.pi
    onto_line = np.clip(STEER_GAIN * error, -1, 1) * np.where(speed < 0, -1.0, 1.0)
    at_first = t < first
    return (
        np.where(at_first, gear, np.clip(top_speed - speed, -1, 1)),
        np.where(at_first, steering, onto_line),
    )


def distance(x, y, heading):
    """The weighted distance that the reward is made of; (x, y) seen from the space's middle."""
    off = 0.01 * np.abs(x) + 0.003 * np.abs(y)
    return off + 0.02 * (np.abs(np.cos(heading)) + np.abs(np.sin(heading) - 1))


def rehearse(x, y, heading, speed, goal_x, goal_y):
    """The return of each manoeuvre from this start."""
    count = MANOEUVRES.shape[1]
    x, y, heading, speed = (np.full(count, value) for value in (x, y, heading, speed))
    total, driving = np.zeros(count), np.ones(count, dtype=bool)
    for t in range(STEPS):
        gas, steering = control(MANOEUVRES, t, x - goal_x, heading, speed)
        slip = np.arctan(0.5 * np.tan(STEERING * steering))
        for _ in range(SUBSTEPS):
            x = x + speed * np.cos(heading + slip) * DT
            y = y + speed * np.sin(heading + slip) * DT
            heading = heading + speed * np.sin(slip) / HALF_LENGTH * DT
            speed = speed + ACCELERATION * gas * DT
        off = distance(x - goal_x, y - goal_y, heading)
        crashed = (np.abs(x) > WALL_X) | (np.abs(y) > WALL_Y)
        total -= driving * (np.sqrt(off) + CRASH * crashed)
        driving &= (off > RESERVE * PARKED) & ~crashed
        if not driving.any():
            break
    return total - CRASH * driving


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.reset(0)

    def reset(self, episode_index):
        self.manoeuvre = None
        self.t = 0

    def act(self, obs):
        x, y, vx, vy, cosine, sine = obs["observation"] * SCALE
        goal_x, goal_y = obs["desired_goal"][:2] * SCALE[:2]
        side = 1.0 if goal_y > 0 else -1.0
        heading = math.atan2(side * sine, cosine)
        speed = vx * cosine + vy * sine
        if self.manoeuvre is None:
            returns = rehearse(x, side * y, heading, speed, goal_x, side * goal_y)
            self.manoeuvre = MANOEUVRES[:, int(np.argmax(returns))]
        gas, steering = control(self.manoeuvre, self.t, x - goal_x, heading, speed)
        self.t += 1
        return np.array([gas, side * steering])
