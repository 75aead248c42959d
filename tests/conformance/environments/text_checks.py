"""What a task text must and must not have. Also a program, for families that another interpreter makes: `python
text_checks.py ID…` prints one JSON object, id to faults.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from typing import Any

from task_tables import components, leaves, selected, table

from evopolicy_common.catalogue import entry, suites
from evopolicy_common.messages.environment import SpaceSchema
from evopolicy_worker.environments import make
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumEnvironment

SECTIONS = ["Observation", "Action", "Reward", "Start", "End"]
FORMED = {
    "classic_control",
    "toy_text",
    "box2d",
    "mujoco",
    "minigrid",
    "babyai",
    "highway",
    "robotics",
    "mo_gymnasium",
}
"""Families whose tables have the form of Core16's: a row for each component, with meaning, unit and range."""
EQUATIONS = {
    "an assignment": r"←|:=",
    "a difference, sum or root": r"[ΔΣ√∫]|\w′|\w''",
    "a power": r"[\w)]\s?(²|³|\^)",
    "a function of a variable": r"\b(cos|sin|tan|atan|exp|sqrt)\b ?[(\w]",
    "a weight before a variable": r"\d\.\d+ ?[·*×]|\d\.\d+ (?![msN]\b)[a-zA-Zθωφ][ᵢⱼ\d]?\b",
}
"""Signs that a text gives equations of motion or a reward's formula."""
IN_CODE = {"arithmetic": r"[\w)\]] [+*/×÷−<>] [\w(]|\w[*/+]\w", "a norm": r"\|.+ − .+\|"}
"""The same within backticks."""
CONSTANTS = {
    "mass, inertia, damping or gravity": r"\bkg\b|N m s|\bg = |inertia \d|damping \d|gravity \d|m/s²",
    "an integrator or its time step": r"Runge|Euler(?! angles)|\d\.\d+ s\)|\d+ × \d\.\d+ s|\d/\d+ s",
    "a distribution of the start": r"standard deviation|[Nn]ormal(ly)? with|uniform (in|over)",
}
_CORE16 = {entry(each).gymnasium_id for each in suites()["core16"].environments}
MARKUP = {
    "a role": r":(class|attr|meth|func|ref|mod|math):`",
    "literal marks": r"(?<!`)``(?!`)",
    "a reference": r"\bSee [`\w]|arXiv|https?://|\]\(|\bet al\b",
    "a program": r"gymnasium\.make|env\.step|>>>|^\s*import ",
}
"""Signs of documentation that is written for programmers of the library."""


def flags(text: str) -> list[str]:
    """Which signs of equations and constants stand in a text, tables of observations aside: they give units and
    scales."""
    head, _, rest = text.partition("## Observation")
    observation, _, rest = rest.partition("## Action")
    prose = "\n".join(line for line in observation.splitlines() if not line.startswith("|"))
    parts = (head, prose, rest)
    code = [span for part in parts for span in re.findall(r"`([^`\n]+)`", part)]
    searches = [(EQUATIONS | CONSTANTS, parts), (IN_CODE, code)]
    return [
        f"{kind}: {found[0]!r}"
        for signs, texts in searches
        for kind, sign in signs.items()
        for text in texts
        if (found := re.search(sign, text))
    ]


def marks(text: str) -> list[str]:
    """Which signs of a library's documentation stand in a text."""
    searched = {kind: re.search(sign, text, re.MULTILINE) for kind, sign in MARKUP.items()}
    return [f"{kind}: {found[0]!r}" for kind, found in searched.items() if found]


def uncovered(text: str, heading: str, space: SpaceSchema) -> list[str]:
    """What the table of a section has wrong: components without a row or with several, empty cells."""
    try:
        rows = table(text, heading)
        named = [component for row in rows for component in selected(row[0])]
    except AssertionError as error:
        return [str(error)]
    wanted, width = components(space), 4
    if heading == "Action" and space["type"] == "Discrete":
        start = space.get("start", 0)
        wanted, width = {("", (start + k,)) for k in range(space["n"])}, 2
    found = [f"{heading} without {sorted(lacking)[:3]}"] if (lacking := wanted - set(named)) else []
    found += [f"{heading} beyond its space: {sorted(more)[:3]}"] if (more := set(named) - wanted) else []
    found += [f"{heading} with several rows for a component"] if len(named) != len(set(named)) else []
    found += [
        f"{heading} with an empty cell or another width: {row}"
        for row in rows
        if len(row) != width or not all(row)
    ]
    return found


def borrowed(text: str, env: Any) -> list[str]:
    """Names of a constructor's options, and docstrings of the classes that an environment's class is made of."""
    found = []
    for each in type(env).__mro__[:-1]:
        made = vars(each).get("__init__")
        options = inspect.signature(made).parameters if made is not None else ()
        names = [name for name in options if "_" in name.strip("_")]
        found += [f"the option {name}" for name in names if re.search(rf"\b{name}\b", text)]
        first = (inspect.cleandoc(vars(each).get("__doc__") or "").splitlines() or [""])[0]
        if len(first) > 20 and first in text:
            found.append(f"the docstring of {each.__name__}")
    return found


def faults(env_id: str) -> list[str]:
    """All that is wrong with the text of an environment, which is made for this."""
    environment = make(env_id)
    assert isinstance(environment, GymnasiumEnvironment)
    description, text = environment.description, environment.description.task_text
    found = [*flags(text), *marks(text), *borrowed(text, environment.bare.unwrapped)]
    if not re.match(r"# .+\n\n[A-Z].{30,}", text):
        found.append("no title with a purpose below it")
    if (sections := re.findall(r"^## (.+)$", text, re.MULTILINE)) != SECTIONS:
        found.append(f"sections {sections}")
    if not re.search(rf"runcated after\s+{description.max_episode_steps} steps", text):
        found.append("no step limit")
    told = "uccess" in text or "solved" in text or description.definition["gymnasium_id"] in _CORE16
    found += [] if told else ["nothing of success"]
    if description.family in FORMED:
        found += uncovered(text, "Observation", description.obs_space)
        found += uncovered(text, "Action", description.action_space)
    else:
        found += [
            f"nothing of {path}" for path, _ in leaves(description.obs_space) if path and path not in text
        ]
    environment.close()
    return found


def main(env_ids: list[str]) -> None:
    print(json.dumps({env_id: found for env_id in env_ids if (found := faults(env_id))}))


if __name__ == "__main__":
    main(sys.argv[1:])
