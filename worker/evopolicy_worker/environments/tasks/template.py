"""The task text of an environment for which nobody has written one: its documentation, its spaces, and what is known of its
rewards and its end, in the form of the written ones.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import SpaceSchema

if TYPE_CHECKING:
    import gymnasium

MAX_DOCUMENTATION = 12_000
"""Characters of an environment's documentation that are shown."""
_MAX_ROWS = 64
_UNSEEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]")


def text(
    entry: Entry,
    env: gymnasium.Env[Any, Any],
    obs_space: SpaceSchema,
    action_space: SpaceSchema,
    components: Mapping[str, str],
    limit: int,
) -> str:
    """Markdown with the sections of every task text."""
    documentation = _documentation(env)
    parts = [
        f"# {entry.label}",
        "Maximise the sum of rewards of an episode.",
        *([documentation] if documentation else []),
        "## Observation\n\n" + _space(obs_space),
        "## Action\n\n" + _space(action_space),
        "## Reward\n\n"
        + _reward(components, vector=bool(entry.reward_vector) or hasattr(env.unwrapped, "reward_space")),
        "## Start\n\nThe start of an episode is drawn from its seed.",
        f"## End\n\nAn episode ends when the environment ends it (`terminated`), and after {limit:,} steps at the latest"
        " (`truncated`)." + _success(entry),
    ]
    return "\n\n".join(parts) + "\n"


def clean(given: str) -> str:
    """A text of anyone's without control characters and invisible marks."""
    return _UNSEEN.sub("", given.replace("\r\n", "\n"))


def _documentation(env: gymnasium.Env[Any, Any]) -> str:
    """The docstring of the environment's class, headings one level down; empty where it has none of its own."""
    found = clean(inspect.getdoc(type(env.unwrapped)) or "") if "__doc__" in vars(type(env.unwrapped)) else ""
    if len(found) > MAX_DOCUMENTATION:
        found = found[:MAX_DOCUMENTATION].rpartition("\n")[0] + "\n\n(The documentation goes on.)"
    return re.sub(r"^(#+) ", r"##\1 ", found.strip(), flags=re.MULTILINE)


def _space(space: SpaceSchema) -> str:
    rows = _rows(space, "")
    shown = [f"| `{name}` | {what} |" for name, what in rows[:_MAX_ROWS]]
    if len(rows) > _MAX_ROWS:
        shown.append(f"| … | {len(rows) - _MAX_ROWS} more; see the space in `/info` |")
    return "\n".join(["| component | what it is |", "|---|---|", *shown])


def _rows(space: SpaceSchema, name: str) -> list[tuple[str, str]]:
    if space["type"] == "Dict":
        named = [(f"{name}.{key}" if name else str(key), part) for key, part in space["spaces"].items()]
        return [row for key, part in named for row in _rows(part, key)]
    if space["type"] == "Tuple":
        return [row for k, part in enumerate(space["spaces"]) for row in _rows(part, f"{name}[{k}]")]
    return [(name or "all", words(space))]


def words(space: SpaceSchema) -> str:
    """A space in words, in one line."""
    kind = space["type"]
    if kind == "Discrete":
        first = int(space.get("start", 0))
        return f"an integer from {first} to {first + int(space['n']) - 1}"
    if kind == "Image":
        height, width, channels = space["shape"]
        return f"a picture, {height} × {width} × {channels}, uint8 from 0 to 255"
    if kind == "Box":
        return f"{_shape(space['shape'])} of {space['dtype']}, {_range(space['low'], space['high'])}"
    if kind == "MultiDiscrete":
        return f"integers, each from its start to below start plus {space['nvec']}, start {space.get('start', 0)}"
    if kind == "MultiBinary":
        return f"{_shape(space['n'] if isinstance(space['n'], list) else [space['n']])} of 0 and 1"
    if kind == "Text":
        return f"a text of {space['min_length']} to {space['max_length']} characters"
    if kind == "Sequence":
        return f"any number of items, each {words(space['space'])}"
    if kind == "OneOf":
        return "a pair of an index and a value: " + "; ".join(
            f"{k}: {words(part)}" for k, part in enumerate(space["spaces"])
        )
    if kind == "Graph":
        edges = (
            "no values on edges" if space["edge_space"] is None else f"each edge {words(space['edge_space'])}"
        )
        return f"a graph as `nodes`, `edges`, `edge_links`: each node {words(space['node_space'])}; {edges}"
    inner = space["spaces"].values() if kind == "Dict" else space["spaces"]
    return "(" + ", ".join(map(words, inner)) + ")"


def _shape(shape: list[int]) -> str:
    return "a number" if not shape else f"an array of shape {tuple(shape)}"


def _range(low: Any, high: Any) -> str:
    lowest, highest = _edge(low, min), _edge(high, max)
    if math.isinf(lowest) and math.isinf(highest):
        return "without bounds"
    return f"from {lowest:g} to {highest:g}" + (
        "" if low == lowest and high == highest else " or narrower by element"
    )


def _edge(values: Any, pick: Any) -> float:
    return (
        float(pick(_edge(each, pick) for each in values))
        if isinstance(values, list) and values
        else float(values or 0)
    )


def _reward(components: Mapping[str, str], *, vector: bool) -> str:
    if not components:
        return "As the environment's documentation tells; see it in the feedback of submits."
    what = "A vector, of which the weighted sum counts" if vector else "A number; `info` tells parts of it"
    rows = [f"| `{name}` | {clean(told)} |" for name, told in components.items()]
    return "\n".join([f"{what}:", "", "| name | what it is |", "|---|---|", *rows])


def _success(entry: Entry) -> str:
    if not entry.success:
        return ""
    when = "at the last step" if entry.success_at == "end" else "at any step"
    return f" The task counts as solved when `info[{entry.success!r}]` is true {when}."
