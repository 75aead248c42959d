"""An environment's facts for agents and policies in the published profiles, as the published software has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_IMAGE = {"layout": "height_width_channels", "value_range": [0, 255], "storage": "external"}
_CHANNELS = (1, 3, 4)


def described(
    obs_space: Mapping[str, object], action_space: Mapping[str, object], storage: str
) -> dict[str, Any]:
    """The fields of `env_meta` that differ from ours: spaces, storage of observations, and `reward_components`.

    Arrays of bytes with channels are images, which are stored beside the rows, and MiniGrid's sentences a space of
    their own. A step's only reward component is its return.
    """
    shown = _space(obs_space)
    external = storage != "inline" or _has_image(shown)
    told = {
        "obs_space": shown,
        "action_space": dict(action_space),
        "obs_storage": "external" if external else "inline",
        "reward_components": {"return": "the episode's return"},
    }
    return told | ({"artifacts": {"observations": "episodes/ep_XXX/observations.*"}} if external else {})


def _space(schema: Mapping[str, Any], name: str = "") -> dict[str, Any]:
    kind, shape = schema["type"], schema.get("shape", ())
    if kind == "Box" and schema["dtype"] == "uint8" and len(shape) == 3 and shape[2] in _CHANNELS:
        return {"type": "Image", "shape": list(shape), "dtype": "uint8", **_IMAGE}
    if kind == "Text" and name == "mission":
        return {"type": "MissionSpace", "repr": "MissionSpace"}
    if kind == "Dict":
        return {"type": kind, "spaces": {key: _space(part, key) for key, part in schema["spaces"].items()}}
    return dict(schema)


def _has_image(schema: Mapping[str, Any]) -> bool:
    return schema["type"] == "Image" or any(
        map(_has_image, schema["spaces"].values() if schema["type"] == "Dict" else ())
    )
