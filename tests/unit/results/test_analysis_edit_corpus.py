"""More labelled edits, of a policy with most of the language in it: nested functions, classes that inherit, patterns,
globals."""

from __future__ import annotations

import pytest

from evopolicy_results.code.sources import reachable_modules, source_digest
from evopolicy_results.code.topology import describe

BASE = """import numpy as xp
from dataclasses import dataclass, field


@dataclass
class Memory:
    cells: dict = field(default_factory=dict)
    size: int = 7


class Planner(Memory):
    WEIGHTS = (0.1, 0.2, 0.3)

    def __init__(self, depth=3, *, width=2):
        super().__init__()
        self.depth = depth
        self.width = width

    def plan(self, grid, goal):
        def cost(a, b=1.0):
            return abs(a - goal) * b

        best = min((cost(c, b=2.0) for c in grid), default=0)
        try:
            order = sorted(grid, key=lambda cell: cost(cell))
        except ValueError as error:
            print(error)
            order = []
        match len(order):
            case 0:
                return 0
            case n if n > 3:
                return n
        while (step := best - 1) > 0:
            best = step
        return best


LIMIT = [1, 2, 3]


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.planner = Planner(depth=4, width=1)
        self.old = xp.zeros(3, dtype=xp.float32)
        self.new = None

    def reset(self, episode_index):
        global COUNT
        COUNT = 0

    def act(self, obs):
        self.old, self.new = self.new, obs
        x = self.planner.plan(LIMIT, obs[0])
        return x if x else -1
"""
CUT = BASE.index("LIMIT = [")
HELPER = BASE[:CUT]


def policy_with(imported: str) -> str:
    """The rest of BASE, with the classes before it imported."""
    return f"import numpy as xp\n{imported}\n\n{BASE[CUT:]}"


def edit(*changes: tuple[str, str]) -> dict[str, str]:
    text = BASE
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return {"policy.py": text}


PARAMETRIC: dict[str, dict[str, str]] = {
    "a class renamed": edit(("Planner", "Searcher")),
    "a base class renamed": edit(("Memory", "Store")),
    "a method renamed": edit((".plan(", ".search("), ("def plan", "def search")),
    "an import's alias renamed": edit(("numpy as xp", "numpy as np"), ("xp.", "np.")),
    "an import without its alias": edit(("import numpy as xp", "import numpy"), ("xp.", "numpy.")),
    "a keyword parameter renamed with its calls": edit(("depth", "levels")),
    "a nested function renamed": edit(("cost", "price")),
    "a nested default": edit(("b=1.0", "b=1.5")),
    "a comprehension's variable renamed": edit(("cost(c, b=2.0) for c in", "cost(z, b=2.0) for z in")),
    "a lambda's parameter renamed": edit(("lambda cell: cost(cell)", "lambda q: cost(q)")),
    "an exception's name": edit(("error", "problem")),
    "a pattern's constant": edit(("case 0", "case 5")),
    "a pattern's capture renamed": edit(("case n if n > 3", "case k if k > 3"), ("return n\n", "return k\n")),
    "an assignment expression renamed": edit(("step", "after")),
    "a declared global renamed": edit(("COUNT", "CALLS")),
    "the values of a list": edit(("[1, 2, 3]", "[9, -8, 7.5]")),
    "the values of a class variable": edit(("(0.1, 0.2, 0.3)", "(1, 2, 3)")),
    "a field's default": edit(("size: int = 7", "size: int = 8")),
    "a number written otherwise": edit(("0.1", "1e-1")),
    "two attributes that trade names": edit(
        ("self.old", "self.tmp"), ("self.new", "self.old"), ("self.tmp", "self.new")
    ),
    "a returned constant's sign": edit(("else -1", "else 1")),
    "classes moved to a module": {"policy.py": policy_with("from brain import Planner"), "brain.py": HELPER},
    "classes moved to a package": {
        "policy.py": policy_with("from lib.brain import Planner"),
        "lib/__init__.py": "",
        "lib/brain.py": HELPER,
    },
    "two statements on a line": edit(("= depth\n        self.width", "= depth; self.width")),
    "needless parentheses": edit(("abs(a - goal) * b", "(abs((a) - goal)) * (b)")),
    "line ends": {"policy.py": BASE.replace("\n", "\r\n")},
    "tabs": {"policy.py": BASE.replace("    ", "\t")},
    "a field's hint": edit(("cells: dict =", 'cells: "dict[int, int]" =')),
    "a method's hints": edit(("def act(self, obs):", "def act(self, obs: xp.ndarray) -> int:")),
    "a needless pass": edit(("self.width = width", "self.width = width\n        pass")),
    "an import for hints": edit(("from dataclasses", "from typing import Any\nfrom dataclasses")),
}

SYNTHESIS: dict[str, dict[str, str]] = {
    "a library's constant": edit(("float32", "float64")),
    "a field removed": edit(("    size: int = 7\n", "")),
    "a comparison": edit(("> 0:", ">= 0:")),
    "an argument dropped": edit((", width=1", "")),
    "a base class dropped": edit(("Planner(Memory)", "Planner")),
    "another attribute in one place": edit(("if x else -1", "if self.old else -1")),
    "an index for a key": edit(("obs[0]", 'obs["a"]')),
    "a longer list": edit(("[1, 2, 3]", "[1, 2, 3, 4]")),
    "a flag for nothing": edit(("self.new = None", "self.new = True")),
    "an expression for a constant": edit(("depth=4", "depth=2 + 2")),
    "operands traded": edit(("abs(a - goal)", "abs(goal - a)")),
    "a condition negated": edit(("if x else", "if not x else")),
    "a pattern without its guard": edit(("case n if n > 3", "case n")),
    "a new handler": edit(("except ValueError as error", "except (ValueError, TypeError) as error")),
    "a nested function lifted to a call": edit(("cost(cell))", "abs(cell))")),
}


def known(files: dict[str, str]) -> tuple[str, str]:
    modules = reachable_modules({path: text.encode() for path, text in files.items()})
    return source_digest(modules), describe(modules)[0]


@pytest.mark.parametrize("what", sorted(PARAMETRIC))
def test_edit_without_new_structure_is_parametric(what: str) -> None:
    before, after = known({"policy.py": BASE}), known(PARAMETRIC[what])
    assert after[0] != before[0]
    assert after[1] == before[1]


@pytest.mark.parametrize("what", sorted(SYNTHESIS))
def test_edit_with_new_structure_is_synthesis(what: str) -> None:
    assert known(SYNTHESIS[what])[1] != known({"policy.py": BASE})[1]
