"""Gymnasium-Robotics: Fetch, Shadow Hand, Adroit, mazes, the kitchen."""

from __future__ import annotations

import tempfile
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_worker.environments.families.mujoco import MujocoFamily

_FINGERS = {"FF": "forefinger", "MF": "middle finger", "RF": "ring finger", "LF": "little finger"}
_BENDS = (
    "last joint, bent",
    "middle joint, bent",
    "knuckle, bent",
    "knuckle, sideways",
    "its bone in the palm",
)
_JOINTS = {
    **{f"ART{axis}": f"arm, moved along {axis}" for axis in "xyz"},
    **{f"ARR{axis}": f"arm, turned about {axis}" for axis in "xyz"},
    "WRJ1": "wrist, sideways",
    "WRJ0": "wrist, bent",
    "THJ4": "thumb: base, turned",
    "THJ3": "thumb: base, towards the palm",
    "THJ2": "thumb: middle joint, first axis",
    "THJ1": "thumb: middle joint, second axis",
    "THJ0": "thumb: last joint; negative bends",
} | {f"{short}J{k}": f"{name}: {bend}" for short, name in _FINGERS.items() for k, bend in enumerate(_BENDS)}


def _hand_sections(gymnasium_id: str, env: Any) -> dict[str, str]:
    """The joints in the observation and the actions of a Shadow Hand or an Adroit hand; nothing for other robots."""
    if not gymnasium_id.startswith(("Hand", "Adroit")):
        return {}
    model = env.model
    joints = [model.jnt(k) for k in range(model.njnt)]
    # The door's observation leaves out the first coordinate.
    seen = [each for each in joints if _joint_name(each) in _JOINTS][
        gymnasium_id.startswith("AdroitHandDoor") :
    ]
    part = "observation[{}]" if gymnasium_id.startswith("Hand") else "{}"
    unit = {True: "m", False: "rad"}
    observed = [
        f"| {part.format(k)} | {_JOINTS[_joint_name(each)]} | {unit['ART' in each.name]} | {each.range[0]:.2g} to"
        f" {each.range[1]:.2g} |"
        for k, each in enumerate(seen)
    ]
    driven = [model.jnt(model.actuator(k).trnid[0]) for k in range(model.nu)]
    acted = [
        f"| {k} | {_JOINTS[_joint_name(each)]} | 1 is the joint's highest, −1 its lowest | −1 to 1 |"
        for k, each in enumerate(driven)
    ]
    return {"Observation": "\n".join(observed).replace("-", "−"), "Action": "\n".join(acted)}


def _joint_name(joint: Any) -> str:
    return str(joint.name).removeprefix("robot0:")


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
        return _hand_sections(str(entry.gymnasium_id), env.unwrapped)

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
