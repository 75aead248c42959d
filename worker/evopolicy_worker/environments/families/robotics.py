"""Gymnasium-Robotics: Fetch, Shadow Hand, Adroit, mazes, the kitchen."""

from __future__ import annotations

import tempfile
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.families.mujoco import MujocoFamily
from evopolicy_worker.environments.tasks import hands

if TYPE_CHECKING:
    import gymnasium


class RoboticsFamily(MujocoFamily):
    distributions = ("gymnasium-robotics", "mujoco")
    modules = ("gymnasium", "mujoco", "gymnasium_robotics")
    solved_by = {"FetchPush-v4": "is_success", "FetchPickAndPlace-v4": "is_success"}

    def make(self, entry: Entry, *, render: bool) -> gymnasium.Env[Any, Any]:
        """As others. A maze's model is written to a file of a fixed name beside Python's temporary folders, and read
        again: with a folder of its own no other process comes between."""
        usual = tempfile.tempdir
        with tempfile.TemporaryDirectory() as own:
            tempfile.tempdir = own
            try:
                return super().make(entry, render=render)
            finally:
                tempfile.tempdir = usual

    def rebuilds(self, entry: Entry) -> bool:
        # Fetch and the Shadow Hand have been seen to repeat.
        return not str(entry.gymnasium_id).startswith(("Fetch", "Hand"))

    def task_sections(self, entry: Entry, env: gymnasium.Env[Any, Any]) -> dict[str, str]:
        return hands.task_sections(str(entry.gymnasium_id), env.unwrapped)

    def render(self, env: gymnasium.Env[Any, Any]) -> Any:
        """A picture; the callback that moves the target's marker also runs the forward dynamics, so both are put back.

        Without that a rendered FetchPickAndPlace goes another way than an unrendered one.
        """
        import mujoco

        simulator: Any = env.unwrapped
        model, data = simulator.model, simulator.data
        saved = mujoco.MjData(model)
        mujoco.mj_copyData(saved, model, data)
        sites = model.site_pos.copy()
        try:
            return env.render()
        finally:
            mujoco.mj_copyData(data, model, saved)
            model.site_pos[:] = sites


FAMILY = RoboticsFamily()
