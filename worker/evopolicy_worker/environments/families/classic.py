"""Gymnasium's classic control: Acrobot, MountainCarContinuous and their kin; NumPy only."""

from __future__ import annotations

from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily


class ClassicFamily(GymnasiumFamily):
    """Small worlds of a few numbers."""


FAMILY = ClassicFamily()
