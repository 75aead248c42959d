"""Generates the task text of an environment without a written one, in the same form: its documentation, its spaces, and
what is known about its rewards and its end.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from evopolicy_common.catalogue import Entry, is_shipped
from evopolicy_common.messages.environment import SpaceSchema

if TYPE_CHECKING:
    import gymnasium

MAX_DOCUMENTATION = 12_000
"""Maximum characters of an environment's documentation that are shown."""
MAX_SECTION = 12_500
"""The same for one of its sections, for shipped environments."""
_WIDE = 6_000
"""In a longer section, tables lose the spaces that align their columns."""
_MAX_ROWS = 64
_HEADING = re.compile(r"^\s*(#+)\s+(.+?)\s*$")
_PLACES = {
    "Observation": ("observation",),
    "Action": ("action",),
    "Reward": ("reward",),
    "Start": ("starting state", "start"),
    "End": ("terminat", "episode end", "truncat"),
    "": ("description", "mission", "goal", "task", "map"),
}
"""Words in a documentation's headings that select a section, by the name of our section."""
_REWARD = "What each step gave is in the feedback of submits."
_SIGNS = re.compile(
    "|".join(
        (
            r"←|:=|[ΔΣ√∫≤≥]|\w′|\w''|[\w)]\s?(²|³|\^)|\*\*2|\|\||_\{",
            r"\b(cos|sin|tan|atan|exp|sqrt|log|norm)\b ?[(\w]|\\\w",
            r"\d\.\d+ ?[·*×]|\d\.\d+ (?![msN]\b)[a-zA-Zθωφ][ᵢⱼ\d]?\b|\w \* \w|\w = -?[\d.(\w]",
            r"\bkg\b|N m s|\bg = |inertia \d|damping \d|gravity \d|m/s²|weight.{0,40}\d",
            r"Runge|Euler(?! angles| frame)|\d\.\d+ s\)|\d+ × \d\.\d+ s|\d/\d+ s|frame_skip|\bdt\b|time ?step of|Hz",
            r"standard deviation|[Nn]ormal(ly)? with|uniform (in|over)",
            r"^To (see|play|run)\b.*:$|is defined as:$",
            r"gymnasium\.make|kwarg|arXiv|arxiv|http|[Ss]eed|reward threshold|initialized as|must be specified|argument|`options`|_reward=|naming convention|[Ii]f `",
        )
    )
)
"""Matches sentences with equations of motion, reward formulas or constants, about options, or before a program to run."""
_OF_AN_ANGLE = re.compile(r"(?:\b\w = )?\b(cos|sin)\((\w+)\)")
"""Matches what an element of an observation is, in a table: the sine or cosine of an angle."""
_IN_CODE = re.compile(r"[\w)\]] [+*/×÷−<>-] [\w(]|\w[*/+]\w|\|.+ − .+\||=")
_INCLUDE = re.compile(r"^<!-- include: ([\w.-]+) -->$", re.MULTILINE)
_UNSEEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]")


def text(
    entry: Entry,
    env: gymnasium.Env[Any, Any],
    obs_space: SpaceSchema,
    action_space: SpaceSchema,
    components: Mapping[str, str],
    limit: int,
    own: Mapping[str, str],
) -> str:
    """Markdown with the sections of every task text.

    For a shipped environment, the documentation is reduced to words, without formulas and constants of its dynamics.
    """
    if is_shipped(entry.id):
        return _in_sections(entry, env, obs_space, action_space, components, limit, own)
    documentation = _documentation(env)
    parts = [
        f"# {entry.label}",
        "Maximise the sum of rewards of an episode.",
        *([documentation] if documentation else []),
        "## Observation\n\n" + _space(obs_space),
        "## Action\n\n" + _space(action_space),
        "## Reward\n\n"
        + reward_table(
            components, vector=bool(entry.reward_vector) or hasattr(env.unwrapped, "reward_space")
        ),
        "## Start\n\nThe start of an episode is drawn from its seed.",
        f"## End\n\nAn episode ends when the environment ends it (`terminated`), and after {limit:,} steps at the latest"
        " (`truncated`)." + _success(entry),
    ]
    return "\n\n".join(parts) + "\n"


def _in_sections(
    entry: Entry,
    env: gymnasium.Env[Any, Any],
    obs_space: SpaceSchema,
    action_space: SpaceSchema,
    components: Mapping[str, str],
    limit: int,
    own: Mapping[str, str],
) -> str:
    """The documentation sorted into our sections. A section that is written for the whole family, or by it, replaces
    it."""
    documented = _sections(clean(inspect.getdoc(type(env.unwrapped)) or ""))
    family = {**_sections(_family_text(entry.family)), **own}

    def section(ours: str, *facts: str) -> str:
        shown = [family[ours]] if ours in family else [in_words(documented.get(ours, "")), *facts]
        return "\n\n".join(part for part in shown if part)

    rewards = reward_table(
        components, vector=bool(entry.reward_vector) or hasattr(env.unwrapped, "reward_space")
    )
    end = (
        f"An episode ends when the environment ends it (`terminated`), and is truncated after {limit} steps."
        + _success(entry)
    )
    parts = [
        f"# {entry.label}",
        "Maximise the sum of the rewards of an episode.",
        own.get("") or in_words(documented.get("", "")),
        "## Observation\n\n" + section("Observation", _space(obs_space)) + _maze(env),
        "## Action\n\n" + section("Action") + "\n\n" + _space(action_space),
        "## Reward\n\n" + section("Reward", *([rewards] if components else [_REWARD])),
        "## Start\n\n" + section("Start", "The start of an episode is drawn from its seed."),
        "## End\n\n"
        + "\n\n".join(part for part in (own.get("End") or in_words(documented.get("End", "")), end) if part),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def documented(documentation: str) -> dict[str, str]:
    """A documentation's sections in words, by our headings."""
    found = {name: in_words(text) for name, text in _sections(clean(documentation)).items()}
    return {name: text for name, text in found.items() if text}


def _family_text(family: str) -> str:
    """The text written for all environments of a family; empty when there is none."""
    name = f"family_{family}.md"
    return read(name) if files(__package__).joinpath(name).is_file() else ""


def read(name: str) -> str:
    """A file of this folder, with its includes expanded."""
    text = files(__package__).joinpath(name).read_text(encoding="utf-8")
    return _INCLUDE.sub(lambda match: read(match[1]).rstrip("\n"), text)


def _maze(env: gymnasium.Env[Any, Any]) -> str:
    """The map of an environment that has one, one character per cell; otherwise empty."""
    rows = getattr(getattr(env.unwrapped, "maze", None), "maze_map", None)
    if not rows:
        return ""
    drawn = ["".join("#" if cell == 1 else str(cell or ".") for cell in row) for row in rows]
    legend = (
        "The maze, seen from above: `#` wall, `.` free, `r` a place to start, `g` a place for the goal, `c` for both;"
        " where it has no letters, any free cell is for both. x grows to the right, y upwards, and the middle is the origin."
    )
    return "\n\n" + legend + "\n\n```\n" + "\n".join(drawn) + "\n```"


def _sections(documentation: str) -> dict[str, str]:
    """A documentation's text by our section names, the description under "". Other sections, such as arguments and
    versions, are left out."""
    found: dict[str, list[str]] = {}
    ours: str | None = ""
    level = 9
    fenced = False
    for line in documentation.splitlines():
        fenced ^= line.lstrip().startswith("```")
        heading = None if fenced else _HEADING.match(line)
        if heading is None:
            if ours is not None:
                found.setdefault(ours, []).append(line)
        elif ours is not None or len(heading[1]) <= level:
            ours, level = _place(heading[2]), len(heading[1])
    return {name: "\n".join(lines).strip() for name, lines in found.items()}


def _place(heading: str) -> str | None:
    low = heading.lower()
    return next((ours for ours, names in _PLACES.items() if any(name in low for name in names)), None)


def in_words(documentation: str) -> str:
    """A documentation without code blocks and link targets. Leaves out sentences and table rows with formulas or
    constants. At most `MAX_SECTION` characters."""
    text = re.sub(r"^\s*```.*?^\s*```", "", documentation, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r" ?\([^()$]*default[^()]*\)", "", text)
    text = re.sub(r"\$\$?[^$]+\$\$?", "∫", text)
    text = re.sub(r"!?\[([^\]\n]+)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"</?[a-z][^>\n]*>", "", text)
    text = re.sub(r",? by default,?", "", text)
    blocks = [_block_in_words(block) for block in re.split(r"\n\s*\n", text)]
    found = "\n\n".join(block for block in blocks if block)
    if len(found) > _WIDE:
        found = re.sub(r"-{4,}", "---", re.sub(r" {2,}", " ", found))
    if len(found) > MAX_SECTION:
        found = found[:MAX_SECTION].rpartition("\n")[0]
    return found


def _block_in_words(block: str) -> str:
    lines = block.strip("\n").splitlines()
    if any(line.lstrip().startswith("|") for line in lines):
        rows = [line.strip() for line in lines if line.lstrip().startswith("|")]
        widths = {row.count("|") for row in rows}
        rows = [_OF_AN_ANGLE.sub(_in_a_word, row) for row in rows]
        return "\n".join(row for row in rows if not _is_formula(row)) if len(widths) == 1 else ""
    items = re.split(r"\n(?=\s*(?:[-*]|\d+\.) )", "\n".join(lines))
    kept = []
    for item in items:
        sentences = re.split(r"(?<=[.!?:;])\s+(?=[A-Z*`_\"(])", " ".join(item.split()))
        kept.append(" ".join(each for each in sentences if not _is_formula(each)))
    return "\n".join(
        item for item in kept if re.search(r"[A-Za-z]{2}", item) and not re.fullmatch(r"[-*] \*.+\*:", item)
    )


def _in_a_word(found: re.Match[str]) -> str:
    return f"{'cosine' if found[1] == 'cos' else 'sine'} of {found[2]}"


def _is_formula(text: str) -> bool:
    code = re.findall(r"`([^`\n]+)`", text)
    return (
        bool(_SIGNS.search(text)) or any(_IN_CODE.search(span) for span in code) or text.count("`") % 2 == 1
    )


def clean(given: str) -> str:
    """A third-party text without control characters and invisible marks."""
    return _UNSEEN.sub("", given.replace("\r\n", "\n"))


def _documentation(env: gymnasium.Env[Any, Any]) -> str:
    """The docstring of the environment's class, with headings two levels down; empty when the class has none of its
    own."""
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
    """A one-line description of a space."""
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


def reward_table(components: Mapping[str, str], *, vector: bool) -> str:
    """The elements of a vector reward, or the parts of a reward, with what each stands for."""
    if not components:
        return "As the environment's documentation tells; see it in the feedback of submits."
    what = "A vector, of which the weighted sum counts" if vector else "A number; `info` tells parts of it"
    rows = [f"| `{name}` | {clean(text)} |" for name, text in components.items()]
    return "\n".join([f"{what}:", "", "| name | what it is |", "|---|---|", *rows])


def _success(entry: Entry) -> str:
    if not entry.success:
        return ""
    when = "at the last step" if entry.success_at == "end" else "at any step"
    return f" The task counts as solved when `info[{entry.success!r}]` is true {when}."
