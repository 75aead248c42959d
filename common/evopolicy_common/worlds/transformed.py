"""A policy for the unchanged environment, with code around it that undoes a world's rules."""

from __future__ import annotations

import ast

from evopolicy_common.records.policies.bundles import Bundle, BundleFile, pack
from evopolicy_common.worlds.rules import FACTORS, Draws, Rules

_INNER = "unchanged_policy.py"
_AROUND = '''"""The policy of {inner}, in a world whose rules it knows."""

import numpy as np
from unchanged_policy import Policy as Unchanged

inf = float("inf")
OBSERVATION = {observation}
ACTION = {action}


def undone(change, value):
    if change is None:
        return value
    if len(change) == 1:
        return change[0].index(int(value))
    order, scale, shift, low, high = map(np.array, change)
    values = np.asarray(value).reshape(len(order))
    found = np.empty_like(values)
    found[order] = (values - shift) / scale
    return np.asarray(np.clip(found, low, high), values.dtype)


class Policy(Unchanged):
    def act(self, obs):
        action = super().act(undone(OBSERVATION, obs))
        if ACTION is not None and len(ACTION) > 1:
            action = np.clip(np.array(action, float).reshape(-1), ACTION[3], ACTION[4])
        return undone(ACTION, action)
'''
"""Undoes `Rules.observe` and `Rules.act` in a policy's process, which has numpy alone."""


def transformed(bundle: Bundle, rules: Rules) -> Bundle:
    """The bundle that plays in a world as `bundle` does outside. As secret as the rules."""
    around = _AROUND.format(
        inner=_INNER, observation=_literal(rules.obs_change), action=_literal(rules.action_change)
    )
    files = [
        BundleFile(_INNER, each.executable, each.data) if each.path == "policy.py" else each
        for each in bundle.files
    ]
    return pack([*files, BundleFile("policy.py", False, around.encode())])


def varied(bundle: Bundle, n: int) -> Bundle:
    """Variant `n` of a policy: each constant at the top of policy.py has its floating-point numbers
    multiplied by one factor, drawn for this variant. Variant 0 is the policy itself."""
    draws = Draws(f"variant {n}")
    files = []
    for each in bundle.files if n else ():
        if each.path == "policy.py":
            tree = ast.parse(each.data)
            for node in tree.body:
                if isinstance(node, ast.Assign | ast.AnnAssign):
                    _Multiplied(FACTORS[draws.below(len(FACTORS))] ** 0.5).visit(node)
            each = BundleFile(each.path, each.executable, ast.unparse(tree).encode())
        files.append(each)
    return pack(files) if n else bundle


class _Multiplied(ast.NodeTransformer):
    def __init__(self, factor: float) -> None:
        self._factor = factor

    def visit_Constant(self, node: ast.Constant) -> ast.Constant:
        return ast.Constant(node.value * self._factor) if isinstance(node.value, float) else node


def _literal(change: object) -> str:
    if change is None or isinstance(change, list):
        return repr(change and [change])
    assert isinstance(change, tuple)
    return repr([each.tolist() for each in change])
