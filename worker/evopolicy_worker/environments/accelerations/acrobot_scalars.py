"""Acrobot: the equations of motion on plain numbers.

Replaces `AcrobotEnv.step`, which integrates one step with arrays of five numbers and computes with numpy's scalars.
Sums, products, quotients and `**` are those of C doubles in both, and here they are in the library's order, so the
results are the same. The sines and cosines stay numpy's, which are not those of the C library; those of several angles
are computed in one call, and `holds` checks that this gives the same bits as one call for each. With noise on the
torque, or with the equations of the paper, the library's method is used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.envs.classic_control.acrobot import AcrobotEnv

from evopolicy_worker.environments.accelerations.specialise import specialise

_PI = float(np.pi)
_TWO_PI = _PI - -_PI
_GRAVITY = 9.8
_N_CHECKED = 512


Slope = Callable[[float, float, float, float, float], tuple[float, float]]
"""From two angles, their speeds and the torque to the angular accelerations."""


class ScalarAcrobot(AcrobotEnv):
    """An environment that computes its step with plain numbers."""

    fresh = True
    """As of MuJoCo's (`mujoco_state`)."""

    state: Any
    _angles: Any
    _slope: Slope

    def step(self, a: Any) -> Any:
        if self.torque_noise_max > 0 or self.book_or_nips == "nips":
            return super().step(a)  # type: ignore[no-untyped-call]
        # Single precision after a reset, as the library's, and made double before anything is computed.
        y1, y2, y3, y4 = map(float, self.state)
        torque = float(self.AVAIL_TORQUE[a])
        slope = self._slope
        dt = self.dt
        half = dt / 2.0
        k1, l1 = slope(y1, y2, y3, y4, torque)
        p3, p4 = y3 + half * k1, y4 + half * l1
        k2, l2 = slope(y1 + half * y3, y2 + half * y4, p3, p4, torque)
        q3, q4 = y3 + half * k2, y4 + half * l2
        k3, l3 = slope(y1 + half * p3, y2 + half * p4, q3, q4, torque)
        r3, r4 = y3 + dt * k3, y4 + dt * l3
        k4, l4 = slope(y1 + dt * q3, y2 + dt * q4, r3, r4, torque)
        sixth = dt / 6.0
        angle = _wrap(y1 + sixth * (y3 + 2 * p3 + 2 * q3 + r3))
        bend = _wrap(y2 + sixth * (y4 + 2 * p4 + 2 * q4 + r4))
        speed = _bound(y3 + sixth * (k1 + 2 * k2 + 2 * k3 + k4), self.MAX_VEL_1)
        turn = _bound(y4 + sixth * (l1 + 2 * l2 + 2 * l3 + l4), self.MAX_VEL_2)
        self.state = angle, bend, speed, turn
        angles = self._angles
        angles[0] = angle
        angles[1] = bend
        angles[2] = bend + angle
        cosines = np.cos(angles).tolist()
        sines = np.sin(angles).tolist()
        terminated = -cosines[0] - cosines[2] > 1.0
        obs = np.array([cosines[0], sines[0], cosines[1], sines[1], speed, turn], dtype=np.float32)
        return obs, 0.0 if terminated else -1.0, terminated, False, {}


def _wrap(angle: float) -> float:
    """The library's `wrap` to ±π."""
    while angle > _PI:
        angle -= _TWO_PI
    while angle < -_PI:
        angle += _TWO_PI
    return angle


def _bound(speed: float, most: float) -> float:
    """The library's `bound` to ±`most`."""
    return -most if speed < -most else most if speed > most else speed


def _slope_of(env: AcrobotEnv, angles: Any) -> Slope:
    """`env._dsdt` as a function of the angles, their speeds and the torque: the two angular accelerations.

    `angles`: room for three numbers. Products of constants with which an expression of the library begins are computed
    here, once.
    """
    cos, sin = np.cos, np.sin
    m1, m2, l1 = env.LINK_MASS_1, env.LINK_MASS_2, env.LINK_LENGTH_1
    lc1, lc2, inertia = env.LINK_COM_POS_1, env.LINK_COM_POS_2, env.LINK_MOI
    own, squares, mixed = m1 * lc1**2, l1**2 + lc2**2, 2 * l1 * lc2
    square, crossed = lc2**2, l1 * lc2
    pull, pull_first = m2 * lc2 * _GRAVITY, (m1 * lc1 + m2 * l1) * _GRAVITY
    turning, coupled, swinging = -m2 * l1 * lc2, 2 * m2 * l1 * lc2, m2 * l1 * lc2
    resting = m2 * lc2**2 + inertia
    quarter = _PI / 2.0

    def slope(
        theta1: float, theta2: float, dtheta1: float, dtheta2: float, torque: float
    ) -> tuple[float, float]:
        angles[0], angles[1], angles[2] = theta2, theta1 + theta2 - quarter, theta1 - quarter
        bend, both, first = cos(angles).tolist()
        sine = float(sin(theta2))
        d1 = own + m2 * (squares + mixed * bend) + inertia + inertia
        d2 = m2 * (square + crossed * bend) + inertia
        phi2 = pull * both
        phi1 = turning * dtheta2**2 * sine - coupled * dtheta2 * dtheta1 * sine + pull_first * first + phi2
        of_second = (torque + d2 / d1 * phi1 - swinging * dtheta1**2 * sine - phi2) / (resting - d2**2 / d1)
        return -(d2 * of_second + phi1) / d1, of_second

    return slope


def holds() -> bool:
    """Whether the sines and cosines of three angles in one call are those of three calls, on this machine."""
    angles = np.random.default_rng(0).uniform(-8 * _PI, 8 * _PI, size=(_N_CHECKED, 3))
    return all(
        np.array_equal([function(row) for row in angles], [[function(x) for x in row] for row in angles])
        for function in (np.cos, np.sin)
    )


def accelerate(env: Any) -> None:
    specialise(env, ScalarAcrobot)
    env._angles = np.empty(3)
    env._slope = _slope_of(env, env._angles)
