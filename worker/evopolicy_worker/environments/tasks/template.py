"""Generates the task text of an environment without a written one, in the same form: its documentation, its spaces, and
what is known about its rewards and its end.
"""

from __future__ import annotations

import fnmatch
import inspect
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

from evopolicy_common.catalogue import Entry, is_shipped
from evopolicy_common.messages.environment import SpaceSchema

if TYPE_CHECKING:
    import gymnasium

MAX_DOCUMENTATION = 12_000
"""Maximum characters of an environment's documentation that are shown."""
_MAX_ROWS = 64
_HEADINGS = ("Observation", "Action", "Reward", "Start", "End")
_REWARD = "What each step gave is in the feedback of submits."
_HEADS = {2: "| Choice | Meaning |", 4: "| Dimension | Meaning | Unit | Range |"}
"""The head of a table of actions, by the cells of a row."""
_COMPONENTS = "| Component | Meaning | Unit | Range |"
_INCLUDE = re.compile(r"^<!-- include: ([\w.-]+) -->$", re.MULTILINE)
_UNSEEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]")


class About(NamedTuple):
    """What a task text is generated from."""

    entry: Entry
    env: gymnasium.Env[Any, Any]
    obs_space: SpaceSchema
    action_space: SpaceSchema
    components: Mapping[str, str]
    """Of the reward, with what each stands for."""
    limit: int
    """Steps."""
    own: Mapping[str, str]
    """Sections that the family writes for this environment, by heading."""


def text(about: About) -> str:
    """Markdown with the sections of every task text.

    For a shipped environment, the documentation is reduced to words, without formulas and constants of its dynamics.
    """
    entry, env, obs_space, action_space, components, limit, _ = about
    rewards = reward_table(
        components, vector=bool(entry.reward_vector) or hasattr(env.unwrapped, "reward_space")
    )
    if is_shipped(entry.id):
        return _in_sections(about, rewards if components else _REWARD)
    # The docstring of the environment's class, with headings two levels down; empty when the class has none of
    # its own.
    text = clean(inspect.getdoc(type(env.unwrapped)) or "") if "__doc__" in vars(type(env.unwrapped)) else ""
    if len(text) > MAX_DOCUMENTATION:
        text = text[:MAX_DOCUMENTATION].rpartition("\n")[0] + "\n\n(The documentation goes on.)"
    documentation = re.sub(r"^(#+) ", r"##\1 ", text.strip(), flags=re.MULTILINE)
    parts = [
        f"# {entry.label}",
        "Maximise the sum of rewards of an episode.",
        *([documentation] if documentation else []),
        "## Observation\n\n" + _space(obs_space),
        "## Action\n\n" + _space(action_space),
        "## Reward\n\n" + rewards,
        "## Start\n\nThe start of an episode is drawn from its seed.",
        f"## End\n\nAn episode ends when the environment ends it (`terminated`), and after {limit:,} steps at the"
        " latest (`truncated`)." + _success(entry),
    ]
    return "\n\n".join(parts) + "\n"


def _in_sections(about: About, rewards: str) -> str:
    """The sections that are written for the family, its groups of environments, and by it. `rewards`: where none of
    them has a text of these."""
    entry, env, obs_space, action_space, _, limit, own = about
    grouped = _of_groups(entry, own)
    name = f"family_{entry.family}.md"
    of_family = read_text(name) if files(__package__).joinpath(name).is_file() else ""
    written = {**_sections(of_family), **own, **grouped}
    acted = written.get("Action", "")
    # A table that a family writes covers a space of one part.
    listed = "|" in acted and action_space["type"] in ("Box", "Discrete", "MultiBinary")
    actions = "" if grouped or listed else "\n\n" + _space(action_space)
    end = f"{written.get('End', '')} Truncated after {limit} steps.".strip()
    success = _success(entry)
    if not success and "uccess" not in end + written.get("Reward", ""):
        success = " Nothing but the return tells success."
    observed = written.get("Observation", _space(obs_space)) + _maze(env)
    parts = [
        f"# {entry.label}",
        "Maximise the sum of the rewards of an episode.",
        written.get("", ""),
        f"## Observation\n\n{_form(obs_space) if grouped else ''}{observed}",
        f"## Action\n\n{_form(action_space) if grouped or listed else ''}{acted}{actions}",
        "## Reward\n\n" + written.get("Reward", rewards),
        "## Start\n\n" + written.get("Start", "The start of an episode is drawn from its seed."),
        "## End\n\n" + end + success,
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _form(space: SpaceSchema) -> str:
    """The kind of a space, with shapes and dtypes."""
    kinds = {name: _kind(leaf) for name, leaf in _leaves(space, "")}
    if space["type"] in ("Dict", "Tuple"):
        return f"`{space['type']}` of {', '.join(f'`{name}` ({kind})' for name, kind in kinds.items())}.\n\n"
    return f"{kinds['']}.\n\n"


def _kind(leaf: SpaceSchema) -> str:
    if leaf["type"] in ("Box", "Image"):
        return f"`Box`, shape {tuple(leaf['shape'])}, {leaf.get('dtype', 'uint8')}"
    return f"`{leaf['type']}`" + (f", {leaf['n']} choices" if leaf["type"] == "Discrete" else "")


@cache
def groups(family: str) -> tuple[dict[str, Any], ...]:
    """The groups of a family's file, below those of the files that it extends."""
    name = f"family_{family}.toml"
    tables = load(name) if files(__package__).joinpath(name).is_file() else {}
    extended = [group for each in tables.get("extends", ()) for group in groups(each)]
    return (*extended, *tables.get("text", ()))


def _of_groups(entry: Entry, own: Mapping[str, str]) -> dict[str, str]:
    """The sections of all groups of the family's file to which the environment belongs, in order and below `own`. Rows
    of tables come together below what is written before the first of each, and get their head.

    A group has `ids` (patterns of Gymnasium's ids) and `except` (of those left out), `about`, and sections by their
    headings; `like` takes the sections of another text, `within` puts the rows' components into a part of the
    observation.
    """
    chosen = [
        each
        for each in groups(entry.family)
        if _fits(entry, each["ids"]) and not _fits(entry, each.get("except", ()))
    ]
    texts: dict[str, list[str]] = {name: [text] for name, text in own.items()} if chosen else {}
    for group in chosen:
        whole = _sections(read_text(f"{group['like']}.md")) if "like" in group else {}
        without = ("End", *group.get("without", ()))
        sections = {name: text for name, text in whole.items() if name not in without}
        for name, text in (*sections.items(), ("", group.get("about", "")), *group.items()):
            if isinstance(text, str) and text and name in ("", *_HEADINGS):
                texts.setdefault(name, []).append(_placed(text, group.get("within", "")))
    return {name: _joined(each, name) for name, each in texts.items()}


def _fits(entry: Entry, patterns: Iterable[str]) -> bool:
    return any(fnmatch.fnmatchcase(str(entry.gymnasium_id), pattern) for pattern in patterns)


def _placed(text: str, part: str) -> str:
    text = re.sub(r"^# .+\n|^`\w+`(, shape [^.]*|, \d+ choices)?\. ?", "", text.strip()).strip()
    return re.sub(r"^\| (\d[^|]*?) \|", rf"| {part}[\1] |", text, flags=re.MULTILINE) if part else text


def _joined(texts: list[str], section: str) -> str:
    """The texts as one, those of observation and action with one table."""
    if section not in ("Observation", "Action"):
        return "\n\n".join(each.strip() for each in texts)
    heads = (_COMPONENTS, *_HEADS.values())
    before, rows, after = [], [], []
    for text in texts:
        prose, bar, rest = f"\n{text.strip()}".partition("\n|")
        before.append(prose.strip())
        lines = f"|{rest}".splitlines() if bar else []
        rows += [each for each in lines if each[:1] == "|" and each[:4] != "|---" and each not in heads]
        after.append("\n".join(each for each in lines if not each.startswith("|")).strip())
    table = ""
    if rows:
        width = rows[0].count("|") - 1
        head = _COMPONENTS if section == "Observation" else _HEADS[width]
        table = "\n".join((head, "|---" * width + "|", *rows))
    return "\n\n".join(filter(None, (*before, table, *after)))


@cache
def load(name: str) -> dict[str, Any]:
    """The tables of a TOML file of this folder."""
    return tomllib.loads(read_text(name))


def read_text(name: str) -> str:
    """A file of this folder, with its includes expanded."""
    text = files(__package__).joinpath(name).read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda match: read_text(match[1]).rstrip("\n"), text)


def _maze(env: gymnasium.Env[Any, Any]) -> str:
    """The map of an environment that has one, one character per cell; otherwise empty."""
    rows = getattr(getattr(env.unwrapped, "maze", None), "maze_map", None)
    if not rows:
        return ""
    drawn = ["".join("#" if cell == 1 else str(cell or ".") for cell in row) for row in rows]
    legend = (
        "The maze, seen from above: `#` wall, `.` free, `r` a place to start, `g` a place for the goal, `c` for both;"
        " where it has no letters, any free cell is for both. x grows to the right, y upwards, and the middle is the"
        " origin."
    )
    return "\n\n" + legend + "\n\n```\n" + "\n".join(drawn) + "\n```"


def _sections(text: str) -> dict[str, str]:
    """A text's sections by heading, those above the first heading under ""."""
    parts = re.split(r"^## (.+)\n", f"\n{text}", flags=re.MULTILINE)
    return {name: part.strip() for name, part in zip(("", *parts[1::2]), parts[::2], strict=True)}


def clean(given: str) -> str:
    """A third-party text without control characters and invisible marks."""
    return _UNSEEN.sub("", given.replace("\r\n", "\n"))


def _space(space: SpaceSchema) -> str:
    leaves = _leaves(space, "")
    rows = [(f"`{path or 'all'}`", space_text(leaf)) for path, leaf in leaves[:_MAX_ROWS]]
    if len(leaves) > _MAX_ROWS:
        rows.append(("…", f"{len(leaves) - _MAX_ROWS} more; see the space in `/info`"))
    return table(("component", "what it is"), rows)


def _leaves(space: SpaceSchema, name: str) -> list[tuple[str, SpaceSchema]]:
    if space["type"] == "Dict":
        parts = {f"{name}.{key}" if name else str(key): part for key, part in space["spaces"].items()}
    elif space["type"] == "Tuple":
        parts = {f"{name}[{k}]": part for k, part in enumerate(space["spaces"])}
    else:
        return [(name, space)]
    return [leaf for key, part in parts.items() for leaf in _leaves(part, key)]


def space_text(space: SpaceSchema) -> str:
    """A one-line description of a space."""
    kind = space["type"]
    if kind == "Discrete":
        first = int(space.get("start", 0))
        return f"an integer from {first} to {first + int(space['n']) - 1}"
    if kind == "Image":
        return f"a picture, {' × '.join(map(str, space['shape']))}, uint8 from 0 to 255"
    if kind == "Box":
        return f"{_shape(space['shape'])} of {space['dtype']}, {_range(space['low'], space['high'])}"
    if kind == "MultiDiscrete":
        return f"integers, each from its start to below start plus {space['nvec']}, start {space.get('start', 0)}"
    if kind == "MultiBinary":
        return f"{_shape(space['n'] if isinstance(space['n'], list) else [space['n']])} of 0 and 1"
    if kind == "Text":
        return f"a text of {space['min_length']} to {space['max_length']} characters"
    if kind == "Sequence":
        return f"any number of items, each {space_text(space['space'])}"
    if kind == "Graph":
        edge = space["edge_space"]
        edges = "no values on edges" if edge is None else f"each edge {space_text(edge)}"
        return (
            f"a graph as `nodes`, `edges`, `edge_links`: each node {space_text(space['node_space'])}; {edges}"
        )
    parts = list(map(space_text, space["spaces"].values() if kind == "Dict" else space["spaces"]))
    if kind == "OneOf":
        return "a pair of an index and a value: " + "; ".join(f"{k}: {part}" for k, part in enumerate(parts))
    return f"({', '.join(parts)})"


def _shape(shape: list[int]) -> str:
    return "a number" if not shape else f"an array of shape {tuple(shape)}"


def _range(low: Any, high: Any) -> str:
    lowest, highest = _edge(low, min), _edge(high, max)
    if math.isinf(lowest) and math.isinf(highest):
        return "without bounds"
    shared = low == lowest and high == highest
    return f"from {lowest:g} to {highest:g}{'' if shared else ' or narrower by element'}"


def _edge(values: Any, pick: Any) -> float:
    if isinstance(values, list) and values:
        return float(pick(_edge(each, pick) for each in values))
    return float(values or 0)


def reward_table(components: Mapping[str, str], *, vector: bool) -> str:
    """The elements of a vector reward, or the parts of a reward, with what each stands for."""
    if not components:
        return "As the environment's documentation tells; see it in the feedback of submits."
    what = "A vector, of which the weighted sum counts" if vector else "A number; `info` tells parts of it"
    rows = ((f"`{name}`", clean(text)) for name, text in components.items())
    return f"{what}:\n\n{table(('name', 'what it is'), rows)}"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [f"| {' | '.join(map(str, row))} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def _success(entry: Entry) -> str:
    if not entry.success:
        return ""
    when = "at the last step" if entry.success_at == "end" else "at any step"
    return f" The task counts as solved when `info[{entry.success!r}]` is true {when}."
