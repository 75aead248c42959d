"""The topology on a corpus of labelled edits, and the features on sources counted by hand."""

from __future__ import annotations

from functools import partial

import pytest

from evopolicy_results.code.sources import reachable_modules, source_digest
from evopolicy_results.code.topology import Features, describe

BASE = '''
import math
import numpy as np

GAIN = 0.5


def wrap(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def follow(target, here):
    delta = target - here
    if delta > 1.0:
        return np.sin(delta)
    return wrap(delta)


class Policy:
    """Follows the target."""

    def __init__(self, obs_space, action_space, env_meta):
        self.kp = 1.5
        self.last = 0.0

    def reset(self, episode_index):
        self.last = 0.0

    def act(self, obs):
        error = follow(obs["target"], obs["here"])
        self.last = 0.9 * self.last + 0.1 * error
        print(f"error {error:.2f}")
        return [GAIN * self.kp * self.last, -1.0]
'''

RICH = """import numpy as xp
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
"""Most of the language: nested functions, classes that inherit, patterns, globals."""


def swap(*texts: str, source: str = BASE) -> dict[str, bytes]:
    """`source` with every second text in place of the one before it."""
    for old, new in zip(texts[::2], texts[1::2], strict=True):
        assert old in source, old
        source = source.replace(old, new)
    return {"policy.py": source.encode()}


rich = partial(swap, source=RICH)


def describe_files(files: dict[str, bytes]) -> tuple[str, str, Features]:
    modules = reachable_modules(files)
    topology, features = describe(modules)
    return source_digest(modules), topology, features


BYTES_ONLY = {
    "a constant": swap("1.5", "2.75"),
    "a constant's sign": swap("-1.0", "1.0"),
    "an int for a float": swap("1.5", "2"),
    "a comment": swap("self.kp = 1.5", "self.kp = 1.5  # found by hand"),
    "blank lines and quotes": swap('obs["target"], obs["here"]', "\n    obs['target'],\n    obs['here'],\n"),
    "a docstring": swap("Follows the target.", "Follows the target with a filter."),
    "a docstring removed": swap('    """Follows the target."""\n', ""),
    "type hints": swap("def wrap(angle):", "def wrap(angle: float) -> float:"),
    "a hint on a variable": swap("        error = ", "        error: float = "),
    "an unused import": swap("import math\n", "import math\nimport random\n"),
}

PARAMETRIC = {
    "a nested default": rich("b=1.0", "b=1.5"),
    "a pattern's constant": rich("case 0", "case 5"),
    "the values of a list": rich("[1, 2, 3]", "[9, -8, 7.5]"),
    "the values of a class variable": rich("(0.1, 0.2, 0.3)", "(1, 2, 3)"),
    "a field's default": rich("size: int = 7", "size: int = 8"),
    "a number written otherwise": rich("0.1", "1e-1"),
    "a returned constant's sign": rich("else -1", "else 1"),
    "two statements on a line": rich("= depth\n        self.width", "= depth; self.width"),
    "needless parentheses": rich("abs(a - goal) * b", "(abs((a) - goal)) * (b)"),
    "line ends": rich("\n", "\r\n"),
    "tabs": rich("    ", "\t"),
    "a field's hint": rich("cells: dict =", 'cells: "dict[int, int]" ='),
    "a method's hints": rich("def act(self, obs):", "def act(self, obs: xp.ndarray) -> int:"),
    "a needless pass": rich("self.width = width", "self.width = width\n        pass"),
    "an import for hints": rich("from dataclasses", "from typing import Any\nfrom dataclasses"),
}

STRUCTURE = {
    "a function renamed": swap("wrap", "principal_angle"),
    "a new branch": swap("        print(f", "        if error > 2:\n            error = 2\n        print(f"),
    "a loop": swap(
        "        print(f", "        for _ in range(3):\n            error *= 0.5\n        print(f"
    ),
    "new state": swap(
        "self.last = 0.0\n\n    def reset", "self.last = 0.0\n        self.n = 0\n\n    def reset"
    ),
    "another library function": swap("np.sin", "np.tanh"),
    "another operator": swap("target - here", "target + here"),
    "another comparison": swap("delta > 1.0", "delta >= 1.0"),
    "another helper called": swap("return wrap(delta)", "return follow(delta, delta)"),
    "another observation": swap('obs["here"]', 'obs["there"]'),
    "a flag flipped": swap("self.last = 0.0\n\n    def act", "self.last = False\n\n    def act"),
    "statements swapped inside a function": swap(
        "        self.kp = 1.5\n        self.last = 0.0\n", "        self.last = 0.0\n        self.kp = 1.5\n"
    ),
    "another attribute read": swap("GAIN * self.kp * self.last", "GAIN * self.last * self.kp"),
    "an f-string for a print of parts": swap('print(f"error {error:.2f}")', 'print("error", error)'),
    "a new helper module in use": {
        "policy.py": swap("return wrap(delta)", "return limit(wrap(delta))")["policy.py"].replace(
            b"import math\n", b"import math\nfrom limits import limit\n", 1
        ),
        "limits.py": b"def limit(x):\n    return max(-1.0, min(1.0, x))\n",
    },
    "a longer table": swap("self.kp * self.last, -1.0]", "self.kp * self.last, -1.0, 0.0]"),
    "a decorator": swap("def wrap", "@staticmethod\ndef wrap"),
    "a keyword of a library": swap("np.sin(delta)", "np.sin(delta, where=True)"),
}


SYNTHESIS = {
    "a library's constant": rich("float32", "float64"),
    "a field removed": rich("    size: int = 7\n", ""),
    "a comparison": rich("> 0:", ">= 0:"),
    "an argument dropped": rich(", width=1", ""),
    "a base class dropped": rich("Planner(Memory)", "Planner"),
    "another attribute in one place": rich("if x else -1", "if self.old else -1"),
    "an index for a key": rich("obs[0]", 'obs["a"]'),
    "a longer list": rich("[1, 2, 3]", "[1, 2, 3, 4]"),
    "a flag for nothing": rich("self.new = None", "self.new = True"),
    "an expression for a constant": rich("depth=4", "depth=2 + 2"),
    "operands traded": rich("abs(a - goal)", "abs(goal - a)"),
    "a condition negated": rich("if x else", "if not x else"),
    "a pattern without its guard": rich("case n if n > 3", "case n"),
    "a new handler": rich("except ValueError as error", "except (ValueError, TypeError) as error"),
    "a nested function lifted to a call": rich("cost(cell))", "abs(cell))"),
}


@pytest.mark.parametrize("edit", [*BYTES_ONLY, *PARAMETRIC])
def test_edit_that_is_no_structure_keeps_the_topology(edit: str) -> None:
    before = BASE if edit in BYTES_ONLY else RICH
    digest, topology, _ = describe_files({"policy.py": before.encode()})
    new_digest, new_topology, _ = describe_files((BYTES_ONLY | PARAMETRIC)[edit])
    assert new_digest != digest
    assert new_topology == topology


@pytest.mark.parametrize("edit", [*STRUCTURE, *SYNTHESIS])
def test_edit_of_structure_changes_the_topology(edit: str) -> None:
    before = BASE if edit in STRUCTURE else RICH
    _, topology, _ = describe_files({"policy.py": before.encode()})
    _, new_topology, _ = describe_files((STRUCTURE | SYNTHESIS)[edit])
    assert new_topology != topology


def test_dead_module_is_not_part_of_the_bundle() -> None:
    alone = describe_files({"policy.py": BASE.encode()})
    beside = describe_files(
        {"policy.py": BASE.encode(), "scratch.py": b"x = [1, 2]\n", "notes/a.py": b"y = 1\n"}
    )
    assert alone == beside


def test_imports_are_followed_into_packages_and_functions() -> None:
    modules = reachable_modules(
        {
            "policy.py": b"from control import pid\n\ndef late():\n    import maps.grid as g\n    return g\n",
            "control/__init__.py": b"",
            "control/pid.py": b"from . import base\nfrom ..outside import nothing\n",
            "control/base.py": b"import importlib\nimportlib.import_module('plugin')\n",
            "maps/grid.py": b"import policy\n",
            "plugin.py": b"",
            "unused.py": b"",
        }
    )
    assert list(modules) == ["control", "control.base", "control.pid", "maps.grid", "plugin", "policy"]


def test_source_that_does_not_parse_is_opaque_and_no_crash() -> None:
    broken = describe_files({"policy.py": b"def act(:\n"})
    other = describe_files({"policy.py": b"def act(:\n  1\n"})
    assert broken[1] != other[1]
    assert broken[2].functions == 0
    assert describe_files({"policy.py": b"x = 1\0"})[2].nodes == 0
    assert describe_files({"policy.py": ("x = " + "(" * 400 + "1" + ")" * 400).encode()})[1]


def test_no_policy_gives_an_empty_bundle() -> None:
    assert reachable_modules({"other.py": b""}) == {}


def test_features_are_counted_as_documented() -> None:
    source = b"""
TABLE = [1 if x else 2 for x in (0, 1)]


def plan(grid):
    global CALLS
    CALLS = 1
    for row in grid:
        while row:
            if row > 3:
                pass
            elif row > 2:
                with open("x") as f:
                    f.read()
            else:
                row -= 1
    return lambda x: x


class Policy:
    def __init__(self, a, b, c):
        self.x, self.y = 0, 1
        self.cells = {}

    def reset(self, i):
        self.x = 0

    async def act(self, obs):
        match obs:
            case 0:
                self.cells[0] = 1
            case _:
                pass
        return 0


class Map:
    def __init__(this):
        this.x = 1
"""
    _, _, features = describe_files({"policy.py": source})
    assert features.functions == 5
    assert features.branches == 5  # one conditional expression, if, elif, two cases
    assert features.loops == 2
    assert features.depth == 4  # for, while, elif, with
    assert features.state == 5  # Policy: x, y, cells; Map: x; global CALLS
    assert features.lines == source.count(b"\n")
