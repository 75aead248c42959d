"""Topology of a policy source bundle, and its structural features.

The topology is a hash of the bundle's abstract syntax trees without numeric constants (paper, mechanism section: a
*parametric* edit changes the bundle "while preserving that stripped topology"). It also leaves out what the policy
does not compute with: signs of constants, docstrings, type hints, import statements and `pass`; comments and formatting
are not in the tree. Any other edit changes the topology, a renamed function too.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator, Mapping
from contextlib import suppress

import msgspec

from evopolicy_results.code.sources import Module


class Features(msgspec.Struct, frozen=True, kw_only=True):
    """AST features of a source bundle: the columns of the paper's Table "Realized computational structure"."""

    functions: int = 0
    """`def` and `async def`, methods included; lambdas are not."""
    branches: int = 0
    """`if` and `elif`, conditional expressions, and `match` cases."""
    loops: int = 0
    """`for` and `while` statements; comprehensions are not."""
    depth: int = 0
    """Deepest nesting of `if`, loop, `with`, `try` and `match` blocks inside one function; `elif` does not nest."""
    state: int = 0
    """Persistent state: distinct attributes that methods assign on their instance, counted per class, and `global`s."""
    nodes: int = 0
    """AST nodes that the topology includes: a size independent of formatting."""
    lines: int = 0
    """Source lines, including blank lines and comments."""


_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_LOOPS = (ast.For, ast.AsyncFor, ast.While)
_BRANCHES = (ast.If, ast.IfExp, ast.match_case)
_NESTING = (*_LOOPS, ast.With, ast.AsyncWith, ast.Try, ast.TryStar, ast.Match)
_NO_STRUCTURE = (ast.Import, ast.ImportFrom, ast.Pass)
_SKIPPED_FIELDS = frozenset({"ctx", "type_comment", "type_params", "annotation", "returns", "simple", "kind"})


def describe(modules: Mapping[str, Module]) -> tuple[str, Features]:
    """Topology (32 hex digits) and features of a bundle's reachable modules, as `reachable_modules` orders them."""
    texts: list[str] = []
    found: list[Features] = []
    for module in modules.values():
        lines = module.source.count(b"\n") + (not module.source.endswith(b"\n"))
        text, features = module.source.hex(), Features(lines=lines)  # of one that cannot be parsed
        with suppress(RecursionError):
            if module.nodes:
                parts = list(_stripped(module.nodes[0]))
                features = _features(module.nodes, parts.count("("), lines)
                text = " ".join(parts)
        texts.append(text)
        found.append(features)
    joined = "\x1f".join(texts).encode("utf-8", "surrogatepass")
    total = {name: sum(getattr(each, name) for each in found) for name in Features.__struct_fields__}
    total["depth"] = max((each.depth for each in found), default=0)
    return hashlib.blake2b(joined, digest_size=16).hexdigest(), Features(**total)


def _stripped(node: ast.AST) -> Iterator[str]:
    """The tree as tokens, without numbers and what has no structure; `(` begins each node."""
    yield "("
    if _is_number(node):
        yield "#)"
        return
    yield type(node).__name__.removeprefix("Ann")  # a hint does not change an assignment
    for name, value in ast.iter_fields(node):
        if name in _SKIPPED_FIELDS:
            continue
        for item in value if isinstance(value, list) else (value,):
            if not isinstance(item, ast.AST):
                yield repr(item)
            elif not isinstance(item, _NO_STRUCTURE) and not _is_docstring(item):
                yield from _stripped(item)
        yield ","
    yield ")"


def _features(nodes: tuple[ast.AST, ...], n_nodes: int, lines: int) -> Features:
    attributes: set[tuple[int, str]] = set()
    for owner in (each for each in nodes if isinstance(each, ast.ClassDef)):
        for method in (each for each in owner.body if isinstance(each, _FUNCTIONS)):
            instance = next((each.arg for each in (*method.args.posonlyargs, *method.args.args)), None)
            for each in ast.walk(method):
                if not (isinstance(each, ast.Attribute) and isinstance(each.ctx, ast.Store)):
                    continue
                if getattr(each.value, "id", None) == instance:
                    attributes.add((id(owner), each.attr))
    declared = {name for each in nodes if isinstance(each, ast.Global) for name in each.names}
    return Features(
        functions=sum(isinstance(each, _FUNCTIONS) for each in nodes),
        branches=sum(isinstance(each, _BRANCHES) for each in nodes),
        loops=sum(isinstance(each, _LOOPS) for each in nodes),
        depth=_depth(nodes[0], 0),
        state=len(attributes) + len(declared),
        nodes=n_nodes,
        lines=lines,
    )


def _depth(node: ast.AST, depth: int) -> int:
    """The deepest nesting within a node that is itself nested `depth` deep."""
    if isinstance(node, _FUNCTIONS):
        depth = 0
    elif isinstance(node, (ast.If, *_NESTING)):
        depth += 1
    elses = node.orelse if isinstance(node, ast.If) else []
    is_elif = len(elses) == 1 and isinstance(elses[0], ast.If)
    below = (_depth(each, depth - (is_elif and each is elses[0])) for each in ast.iter_child_nodes(node))
    return max(depth, *below, 0)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def _is_number(node: ast.AST) -> bool:
    """Whether the node is a numeric constant, with a sign or without."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        node = node.operand
    value = node.value if isinstance(node, ast.Constant) else None
    return isinstance(value, (int, float, complex)) and not isinstance(value, bool)
