"""Gymnasium's classic control: Acrobot, MountainCarContinuous and their kin; NumPy only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily, Quantity

if TYPE_CHECKING:
    import gymnasium

_PARAMETERS: dict[str, dict[str, tuple[str, ...]]] = {
    "AcrobotEnv": {
        "length of the links": ("LINK_LENGTH_1", "LINK_LENGTH_2", "LINK_COM_POS_1", "LINK_COM_POS_2"),
        "mass of the links": ("LINK_MASS_1", "LINK_MASS_2", "LINK_MOI"),
        "torque of the motor": ("AVAIL_TORQUE",),
    },
    "Continuous_MountainCarEnv": {"force of the motor": ("power",)},
}
"""Attributes by class and parameter. The libraries' other constants are no attributes."""


class ClassicFamily(GymnasiumFamily):
    def parameters(self, env: gymnasium.Env[Any, Any]) -> Mapping[str, Sequence[Quantity]]:
        bare = env.unwrapped
        # An acceleration's class is derived from the library's.
        known = [_PARAMETERS[each.__name__] for each in type(bare).__mro__ if each.__name__ in _PARAMETERS]
        attributes_of = known[0] if known else {}
        return {name: [(bare, each) for each in attributes] for name, attributes in attributes_of.items()}


FAMILY = ClassicFamily()
