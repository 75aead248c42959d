"""Declarations in a policy's source, read without executing it."""

from __future__ import annotations

import ast
from collections.abc import Mapping

from evopolicy_common.records.code_metrics import parse

_MAX_BYTES = 1 << 20


def declares_deterministic(files: Mapping[str, bytes]) -> bool:
    """Whether `policy.py` has `deterministic = True` in the body of its top-level `class Policy`.

    `files`: the bundle's files by path. A file that cannot be parsed, or is larger than 1 MiB, declares nothing.
    """
    source = files.get("policy.py", b"")
    if len(source) > _MAX_BYTES:
        return False
    module = parse(source)
    declared = False
    for node in () if module is None else module.body:
        if isinstance(node, ast.ClassDef) and node.name == "Policy":
            declared = any(_declares(inner) for inner in node.body)
    return declared


def _declares(node: ast.stmt) -> bool:
    if isinstance(node, ast.Assign):
        names = [target.id for target in node.targets if isinstance(target, ast.Name)]
    elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        names = [node.target.id]
    else:
        return False
    value = node.value
    return "deterministic" in names and isinstance(value, ast.Constant) and value.value is True
