"""The rows of a robot hand's joints: their names and ranges are those of the simulator's model."""

from __future__ import annotations

from typing import Any

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


def task_sections(gymnasium_id: str, env: Any) -> dict[str, str]:
    """The joints in the observation and the actions of a Shadow Hand or an Adroit hand; nothing for other robots."""
    if not gymnasium_id.startswith(("Hand", "Adroit")):
        return {}
    model = env.model
    joints = [model.jnt(k) for k in range(model.njnt)]
    # The door's observation leaves out the first coordinate.
    seen = [each for each in joints if _name(each) in _JOINTS][gymnasium_id.startswith("AdroitHandDoor") :]
    part = "observation[{}]" if gymnasium_id.startswith("Hand") else "{}"
    unit = {True: "m", False: "rad"}
    observed = [
        f"| {part.format(k)} | {_JOINTS[_name(each)]} | {unit['ART' in each.name]} | {each.range[0]:.2g} to"
        f" {each.range[1]:.2g} |"
        for k, each in enumerate(seen)
    ]
    driven = [model.jnt(model.actuator(k).trnid[0]) for k in range(model.nu)]
    acted = [
        f"| {k} | {_JOINTS[_name(each)]} | 1 is the joint's highest, −1 its lowest | −1 to 1 |"
        for k, each in enumerate(driven)
    ]
    return {"Observation": "\n".join(observed).replace("-", "−"), "Action": "\n".join(acted)}


def _name(joint: Any) -> str:
    return str(joint.name).removeprefix("robot0:")
