"""The tables of observation and action, with their scales, from HighwayEnv's configuration. The other texts are in
family_highway.toml.
"""

from __future__ import annotations

from typing import Any

_SCALED = "−1 to 1"
_FEATURES = {
    "presence": ("1 where the row holds a car, else 0", "flag", "0, 1"),
    "x": ("x", "m", _SCALED),
    "y": ("y", "m", _SCALED),
    "vx": ("velocity along x", "m/s", _SCALED),
    "vy": ("velocity along y", "m/s", _SCALED),
    "cos_h": ("cosine of the heading, measured from the x axis towards the y axis", "–", _SCALED),
    "sin_h": ("sine of the heading", "–", _SCALED),
    "long_off": ("distance of the car from its lane's beginning, along the lane", "m", "0 to 500"),
    "lat_off": (
        "distance of the car from its lane's middle, sideways; positive to the right",
        "m",
        "about ±10",
    ),
    "ang_off": ("heading relative to the lane", "rad", "−π to π"),
}
"""What a feature of a row means, its unit, and its range where it is not scaled."""
_CHOICES = {
    "LANE_LEFT": "change to the lane on the left, if there is one within reach",
    "IDLE": "keep lane and chosen speed",
    "LANE_RIGHT": "change to the lane on the right, if there is one within reach",
    "FASTER": "faster: choose the speed above the one nearest to the actual speed",
    "SLOWER": "slower: choose the speed below the one nearest to the actual speed",
}


def task_sections(env: Any) -> dict[str, str]:
    """Sections of the task text of an environment of HighwayEnv."""
    sections = {"Observation": _observed(env), "Action": _acted(env)}
    if env.config.get("neighbour_vehicles_connected_lanes"):
        sections["Start"] = "The other drivers also watch the cars on lanes that join theirs."
    return sections


def _observed(env: Any) -> str:
    """The rows and columns of an observation, or the layers of a grid, with their scales."""
    kind = env.observation_type
    parts = getattr(kind, "agents_observation_types", None)
    of, cars = (parts[0], f"0–{len(parts) - 1}, ") if parts else (kind, "")
    if hasattr(of, "vehicles_count") and not hasattr(of, "scales"):
        last = of.vehicles_count - 1
        first = "The first index is the car that you drive. " if parts else ""
        frame = "in the same fixed frame" if of.absolute else "relative to your car"
        text = (
            f"{first}One row for each car: row 0 is your own, in a fixed frame; rows 1 to {last} are other cars,"
            f" {frame}, the nearest along your lane first. Cars more than 10 m behind are left out, and missing rows"
            " are all 0. x is along the road where it is straight, y points to the right."
            + (" Values beyond the range are clipped." if of.clip else "")
        )
        rows = [
            _feature(of, name, f"{cars}{row}, {k}", owner)
            for row, owner in (("0", "your car: "), (f"1–{last}", "other car: "))
            for k, name in enumerate(of.features)
        ]
        return "\n".join((text, "", *rows))
    if hasattr(of, "horizon"):
        steps = f"0–2, 0–{of.horizon * env.config['policy_frequency'] - 1}"
        text = (
            "Predicted collisions, if all cars keep their speeds. First index: your speed, 0 the choice below the"
            " present one, 1 the present choice, 2 the one above (at the lowest and highest the same again). Second:"
            " the lane, 0 the one on the left, 1 your own, 2 the one on the right; a lane that does not exist is all 1."
            " Third: after how many seconds."
        )
        rows = [
            f"| {k}, {steps} | collision at {speed} speed | share | 0 none, 0.5 close, 1 certain |"
            for k, speed in enumerate(("a lower", "the present", "a higher"))
        ]
        return "\n".join((text, "", *rows))
    if not hasattr(of, "grid_step"):
        return ""
    (ahead, across), (low, _) = of.grid.shape[1:], of.grid_size[0]
    cells = f"0–{ahead - 1}, 0–{across - 1}"
    text = (
        f"A grid of cells of {of.grid_step[0]:g} × {of.grid_step[1]:g} m around your car, which turns with it. Second"
        f" index: along your heading, from {-low:g} m behind to as far ahead. Third: sideways, from {-low:g} m to the"
        f" left to as far to the right. Your car is in the cell {ahead // 2}, {across // 2}."
    )
    return "\n".join(
        (
            *(text, ""),
            f"| 0, {cells} | a car, your own too, has its middle in the cell | flag | 0, 1 |",
            f"| 1, {cells} | the middle of a lane passes through the cell | flag | 0, 1 |",
        )
    )


def _feature(kind: Any, name: str, place: str, owner: str) -> str:
    meaning, unit, reach = _FEATURES[name]
    if kind.normalize and name in kind.features_range:
        high = kind.features_range[name][1]
        meaning, unit = f"{meaning} ÷ {high:g}", f"{high:g} {unit}"
        reach = _SCALED if kind.clip else "about −1 to 1, not clipped"
    return f"| {place} | {owner}{meaning} | {unit} | {reach} |"


def _acted(env: Any) -> str:
    """The choices, or the numbers, of an action."""
    kind, config = env.action_type, env.config
    parts = getattr(kind, "agents_action_types", None)
    of = parts[0] if parts else kind
    each = f"Steps per second: {config['policy_frequency']}."
    if hasattr(of, "target_speeds"):
        speeds = ", ".join(f"{speed:g}" for speed in of.target_speeds)
        about = (
            f"A built-in driver steers along your lane and route, and approaches the speed that you choose: {speeds}"
            f" m/s. {each}"
        )
        if not parts:
            return "\n".join((about, "", *(f"| {k} | {_CHOICES[name]} |" for k, name in of.actions.items())))
        choices = "; ".join(f"{k} {_CHOICES[name]}" for k, name in of.actions.items())
        row = f"| 0–{len(parts) - 1} | the choice for that car: {choices} | choice | 0 to {len(of.actions) - 1} |"
        return f"{about}\n\n{row}"
    meanings = ["acceleration; negative brakes, then reverses"] * of.longitudinal
    meanings += ["steering angle; positive turns the heading from x towards y, to the right"] * of.lateral
    rows = (f"| {k} | {meaning} | share of the largest | −1 to 1 |" for k, meaning in enumerate(meanings))
    return "\n".join((each, "", *rows))
