"""Numbers of an environment's dynamics in Python code that has a loop: such code may simulate the environment.

Only three environments have a list. Code without a loop is not searched: controllers use the same numbers.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable

DYNAMICS: dict[str, tuple[tuple[float, ...], int]] = {
    "gym/acrobot": ((4 * math.pi, 9 * math.pi, 9.8, 0.2, 0.5), 4),
    "gym/continuouscar": ((0.0015, 0.0025, 0.07, 0.45, 1.2, 0.6), 4),
    "gymnasium/parking-v0": ((1 / 15, 0.2, 0.12, 0.3, 0.02, 2.5), 4),
}
"""An environment's numbers, and how many of them together are no coincidence."""
_TOLERANCE = 1e-3


def dynamics_constants(nodes: Iterable[ast.AST], env: str) -> dict[float, ast.expr]:
    """The numbers of `env`'s dynamics in a module with their first places; empty for too few of them."""
    numbers, enough = DYNAMICS.get(env, ((), 0))
    found: dict[float, ast.expr] = {}
    loops = 0
    for node in nodes if numbers else ():
        loops += isinstance(node, ast.For | ast.While | ast.comprehension)
        if isinstance(node, ast.expr) and (value := _value(node)) is not None:
            for number in numbers:
                if math.isclose(abs(value), number, rel_tol=_TOLERANCE):
                    found.setdefault(number, node)
    return found if loops and len(found) >= enough else {}


def _value(node: ast.expr) -> float | None:
    """The value of a number, of a product with pi such as `4 * np.pi`, or of a quotient of two numbers."""
    if not isinstance(node, ast.BinOp):
        return _number(node)
    left, right = _number(node.left), _number(node.right)
    if left is not None and isinstance(node.op, ast.Mult):
        name = getattr(node.right, "attr", getattr(node.right, "id", ""))
        return left * math.pi if name == "pi" else None
    return left / right if left is not None and right and isinstance(node.op, ast.Div) else None


def _number(node: ast.expr) -> float | None:
    # An agent may have written an integer that no float can hold.
    if isinstance(node, ast.Constant) and isinstance(node.value, float | int) and abs(node.value) < 1e6:
        return float(node.value)
    return None
