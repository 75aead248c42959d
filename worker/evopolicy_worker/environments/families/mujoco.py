"""Gymnasium's MuJoCo environments, and what every family that draws with MuJoCo needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes.util import find_library
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.processes import distribution
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily, Quantity

if TYPE_CHECKING:
    import gymnasium


class MujocoFamily(GymnasiumFamily):
    distributions: tuple[str, ...] = ("gymnasium", "mujoco")
    modules: tuple[str, ...] = ("gymnasium", "mujoco")

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        """As in other families. Raises WorkerError when an image is requested and the host has no EGL to render it."""
        check_rendering(entry, render=render)
        return super().make(entry, render=render)

    def parameters(self, env: gymnasium.Env[Any, Any]) -> Mapping[str, Sequence[Quantity]]:
        bare: Any = env.unwrapped
        if not any(each.__module__.startswith("gymnasium.envs.mujoco.") for each in type(bare).__mro__):
            return {}  # Other libraries have models of other kinds.
        model = bare.model
        touches = bool((model.geom_contype * model.geom_conaffinity).any())
        known: dict[str, list[Quantity]] = {
            "gravity": [(model.opt, "gravity")],
            "mass of the bodies": [(model, "body_mass"), (model, "body_inertia")],
            "damping of the joints": [(model, "dof_damping")],
            "strength of the motors": [(model, "actuator_gear")],
            "friction of the surfaces": [(model, "geom_friction")] if touches else [],
        }
        return {name: owned for name, owned in known.items() if any(getattr(*each).any() for each in owned)}

    def altered(self, env: gymnasium.Env[Any, Any]) -> None:
        import mujoco

        bare: Any = env.unwrapped
        mujoco.mj_setConst(bare.model, bare.data)


def check_rendering(
    entry: Entry, *, render: bool, fault: str = "renders with EGL, which is not installed"
) -> None:
    """Raises WorkerError when an image is requested and the host has no EGL to render it."""
    if render and find_library("EGL") is None:
        raise WorkerError(f"{entry.id} {fault}: {distribution.install('egl')}")


FAMILY = MujocoFamily()
