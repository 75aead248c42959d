"""Acrobot: pump energy through the elbow, with a gain that was rehearsed for this very start.

The motor does work on the pendulum when its torque has the sign of the elbow's angular velocity ω2: that
bang-bang rule alone swings the tip up. Looking at ω2 − k ω1 instead switches a little earlier, in time with
the shoulder's swing, and which k is soonest at the top depends on the start. The equations of motion are
known and exact, so the first `act` plays the whole swing-up in its head once for each k and keeps the
quickest.
"""

import math

GAINS = [0.1 * k for k in range(16)]
"""Values of k that are rehearsed."""
STEP_S = 0.2
HORIZON = 150
"""A rehearsal that is not up after this many steps is given up."""
MAX_SPEED_1 = 4 * math.pi
MAX_SPEED_2 = 9 * math.pi
NEGATIVE, POSITIVE = 0, 2
"""The choices that mean torque −1 and +1 N m."""


def choose(omega1, omega2, gain):
    """The torque's choice for these angular velocities (rad/s)."""
    return POSITIVE if omega2 > gain * omega1 else NEGATIVE


def derivative(theta1, theta2, omega1, omega2, torque):
    """Angular velocities and accelerations; links of 1 m and 1 kg, g = 9.8 m/s², no friction."""
    cos2, sin2 = math.cos(theta2), math.sin(theta2)
    d1 = 0.25 + (1.25 + cos2) + 2.0
    d2 = 0.25 + 0.5 * cos2 + 1.0
    phi2 = 4.9 * math.sin(theta1 + theta2)
    phi1 = -0.5 * omega2 * omega2 * sin2 - omega2 * omega1 * sin2 + 14.7 * math.sin(theta1) + phi2
    alpha2 = (torque + d2 / d1 * phi1 - 0.5 * omega1 * omega1 * sin2 - phi2) / (1.25 - d2 * d2 / d1)
    alpha1 = -(d2 * alpha2 + phi1) / d1
    return omega1, omega2, alpha1, alpha2


def step(state, torque):
    """One step of 0.2 s: a single fourth-order Runge-Kutta step, as the environment does it."""

    def slope(previous, share):
        return derivative(*(s + share * STEP_S * p for s, p in zip(state, previous)), torque)

    k1 = derivative(*state, torque)
    k2 = slope(k1, 0.5)
    k3 = slope(k2, 0.5)
    k4 = slope(k3, 1.0)
    theta1, theta2, omega1, omega2 = (
        s + STEP_S / 6.0 * (a + 2 * b + 2 * c + d) for s, a, b, c, d in zip(state, k1, k2, k3, k4)
    )
    return (
        theta1,
        theta2,
        min(MAX_SPEED_1, max(-MAX_SPEED_1, omega1)),
        min(MAX_SPEED_2, max(-MAX_SPEED_2, omega2)),
    )


def steps_to_top(state, gain):
    """Steps until the tip is above the line when pumping with this gain; `HORIZON` when it takes longer."""
    for t in range(HORIZON):
        theta1, theta2, omega1, omega2 = state
        if -math.cos(theta1) - math.cos(theta1 + theta2) > 1.0:
            return t
        state = step(state, choose(omega1, omega2, gain) - 1.0)
    return HORIZON


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.gain = None

    def reset(self, episode_index):
        self.gain = None

    def act(self, obs):
        cos1, sin1, cos2, sin2, omega1, omega2 = map(float, obs)
        if self.gain is None:
            start = (math.atan2(sin1, cos1), math.atan2(sin2, cos2), omega1, omega2)
            self.gain = min(GAINS, key=lambda gain: steps_to_top(start, gain))
        return choose(omega1, omega2, self.gain)
