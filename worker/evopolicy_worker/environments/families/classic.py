"""Gymnasium's classic control: Acrobot, MountainCarContinuous and their kin; NumPy only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily

if TYPE_CHECKING:
    import gymnasium

_WORDS = {
    # Its documentation calls the action an array of shape (1,).
    "CartPole": {"Action": "0 pushes the cart to the left, 1 pushes it to the right."},
    # Its documentation has no more than a formula.
    "Pendulum": {
        "Reward": "Each step costs the squares of three things: of the angle from upright, which counts most, of the angular "
        "velocity, and of the torque, which counts least. The greatest reward is 0: upright, at rest, without torque. "
        "What each step gave is in the feedback of submits."
    },
}
"""Sections in place of the documentation's, by the beginning of Gymnasium's id."""


class ClassicFamily(GymnasiumFamily):
    """Small worlds of a few numbers."""

    def words(self, entry: Entry, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
        return _WORDS.get(str(entry.gymnasium_id).partition("-")[0], {})


FAMILY = ClassicFamily()
