"""Topology of a policy source bundle (its AST without numeric constants), and its structural features.

The topology is a hash that stays the same exactly when an edit preserves the policy's structure (paper, mechanism
section: a *parametric* edit changes the bundle "while preserving that stripped topology"). It ignores everything that
is not structure: the value and sign of numeric constants, digits in f-string format specifications, comments,
formatting, docstrings, type hints, unused imports, the order of definitions and of top-level statements, the local
module of a definition, and the bundle's own names. It keeps node types, operators, the order of statements inside
functions, string and boolean constants, and every external name (`np.sin` against `np.cos`, `obs["image"]`).

Every function, class and top-level statement becomes a unit, a list of tokens; `canonical` hashes all units into one
digest.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress

import msgspec

from evopolicy_results.code.canonical import PROTOCOL_NAMES, Names, Scope, Unit, canonical, stable_hash
from evopolicy_results.code.sources import Module, absolute_import

_DIGITS = re.compile(r"\d+")


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


def describe(modules: Mapping[str, Module]) -> tuple[str, Features]:
    """Topology (32 hex digits) and features of a bundle's reachable modules."""
    walker = _Walker(set(modules))
    opaque: list[str] = []
    lines = 0
    for module in modules.values():
        lines += module.source.count(b"\n") + (not module.source.endswith(b"\n"))
        with suppress(RecursionError):
            if module.nodes:
                walker.module(module)
                continue
        opaque.append(stable_hash([module.path, module.source.hex()]))
    topology = stable_hash([canonical(walker.units, walker.names), *sorted(opaque)])
    return topology, Features(**walker.counts, depth=walker.depth, state=len(walker.state), lines=lines)


class _Walker:
    def __init__(self, local_modules: set[str]) -> None:
        self.local_modules = local_modules
        self.submodules = {name.rsplit(".", 1)[1] for name in local_modules if "." in name}
        self.units: list[Unit] = []
        self.names = Names()
        self.state: set[tuple[str, str]] = set()
        self.counts: Counter[str] = Counter()
        """Of functions, branches, loops and nodes."""
        self.depth = 0
        self._class = ""
        self._instance = ("", "")
        """Class and first parameter of the visited method."""

    def module(self, module: Module) -> None:
        tree = module.nodes[0]
        assert isinstance(tree, ast.Module)
        scope = Scope()
        for node in module.imports:
            self._bind_import(node, scope, module)
        self.units += self._units_of(tree.body, scope, self.names.top_defs, self.names.global_names)

    def _units_of(
        self, body: Iterable[ast.stmt], scope: Scope, defs: set[str], stored: set[str]
    ) -> list[Unit]:
        """The units of a body. Their definitions go to `defs`, other names to `stored`."""
        structural = (one for one in body if not isinstance(one, _NO_STRUCTURE) and not _is_docstring(one))
        units = [self._unit(one, scope, defs) for one in structural]
        stored.update(*(unit.stored for unit in units if not unit.is_function))
        return units

    def _bind_import(self, node: ast.Import | ast.ImportFrom, scope: Scope, module: Module) -> None:
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.split(".")[0]
                if top in self.local_modules:
                    scope.modules.add(alias.asname or top)
                else:
                    scope.external[alias.asname or top] = alias.name if alias.asname else top
            return
        base = absolute_import(node, module.name, module.path.endswith("__init__.py"))
        local = node.level > 0 or base.split(".")[0] in self.local_modules
        for alias in node.names:
            bound = alias.asname or alias.name
            if not local:
                scope.external[bound] = f"{base}.{alias.name}"
            elif (f"{base}.{alias.name}" if base else alias.name) in self.local_modules:
                scope.modules.add(bound)
            else:
                scope.aliases[bound] = alias.name

    def _unit(self, node: ast.stmt, scope: Scope, defs: set[str]) -> Unit:
        """The unit of a statement of a module's or class's body."""
        unit = Unit(scope, getattr(node, "name", ""), is_function=isinstance(node, _FUNCTIONS))
        if isinstance(node, _FUNCTIONS):
            defs.add(node.name)
            self._function(node, unit, 0)
        elif isinstance(node, ast.ClassDef):
            defs.add(node.name)
            outer, self._class = self._class, f"{self._class}.{node.name}"
            self._add(unit, "ClassDef", _own_name(node.name))
            for part in (*node.decorator_list, *node.bases, *node.keywords):
                self._node(part, unit, 0)
            names = self.names
            unit.children = self._units_of(node.body, scope, names.method_defs, names.attribute_names)
            self._class = outer
        elif isinstance(node, ast.AnnAssign) and defs is self.names.method_defs:
            # A field to dataclasses, which differs from a plain assignment.
            self._add(unit, "Field")
            for value in filter(None, (node.target, node.value)):
                self._node(value, unit, 0)
        else:
            self._statement(node, unit, 0)
        return unit

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef, unit: Unit, depth: int) -> None:
        self.counts["functions"] += 1
        self._add(unit, type(node).__name__, _own_name(node.name))
        for decorator in node.decorator_list:
            self._node(decorator, unit, depth)
        self._arguments(node.args, unit, depth)
        outer = self._instance
        if self._class:
            positional = [*node.args.posonlyargs, *node.args.args]
            self._instance = (self._class, positional[0].arg) if positional else ("", "")
        self._body(node.body, unit, depth)
        self._instance = outer

    def _arguments(self, args: ast.arguments, unit: Unit, depth: int) -> None:
        self._add(unit, "(")
        named = (args.posonlyargs, args.args, args.kwonlyargs)
        self.names.parameters.update(argument.arg for group in named for argument in group)
        for group in (*named, [args.vararg], [args.kwarg]):
            for argument in filter(None, group):
                unit.stored.add(argument.arg)
                unit.tokens.append(("n", argument.arg))
            self._add(unit, "/")
        for default in (*args.defaults, *args.kw_defaults):
            if default is None:
                self._add(unit, "~")
            else:
                self._node(default, unit, depth)
        self._add(unit, ")")

    def _body(self, body: list[ast.stmt], unit: Unit, depth: int) -> None:
        self._add(unit, "{")
        for statement in body:
            self._statement(statement, unit, depth)
        self._add(unit, "}")

    def _statement(self, node: ast.stmt, unit: Unit, depth: int) -> None:
        if isinstance(node, _NO_STRUCTURE) or _is_docstring(node):
            return
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if node.value is not None:
                self._add(unit, "Assign")
                for part in (*targets, node.value):
                    self._node(part, unit, depth)
        elif isinstance(node, _FUNCTIONS):
            unit.stored.add(node.name)
            unit.tokens.append(("n", node.name))
            outer, self._class = self._class, ""
            self._function(node, unit, 0)
            self._class = outer
        elif isinstance(node, ast.Global):
            unit.globals.update(node.names)
            self.names.global_names.update(node.names)
            self.state.update(("", name) for name in node.names)
        elif not isinstance(node, ast.Nonlocal):
            self._node(node, unit, depth)

    def _node(self, node: ast.AST, unit: Unit, depth: int) -> None:
        match node:
            case ast.Name():
                self.counts["nodes"] += 1
                if not isinstance(node.ctx, ast.Load):
                    unit.stored.add(node.id)
                unit.tokens.append(("n", node.id))
            case ast.Constant() | ast.UnaryOp(op=ast.USub() | ast.UAdd()) if _is_number(node):
                self._add(unit, "#")
            case ast.Constant():
                self._add(unit, repr(node.value))
            case ast.Attribute():
                self._attribute(node, unit, depth)
            case ast.JoinedStr():
                self._f_string(node, unit, depth)
            case ast.If():
                self._if(node, unit, depth)
            case _:
                kind = type(node)
                if kind in _NESTING:
                    depth = self._nest(depth)
                if kind in _LOOPS | _CASES:
                    self.counts["loops" if kind in _LOOPS else "branches"] += 1
                self._add(unit, kind.__name__)
                self._fields(node, unit, depth)

    def _if(self, node: ast.If, unit: Unit, depth: int) -> None:
        self.counts["branches"] += 1
        inner = self._nest(depth)
        self._add(unit, "If")
        self._node(node.test, unit, depth)
        self._body(node.body, unit, inner)
        is_elif = len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If)
        self._body(node.orelse, unit, depth if is_elif else inner)

    def _fields(self, node: ast.AST, unit: Unit, depth: int) -> None:
        for name in node._fields:
            if name in _SKIPPED_FIELDS:
                continue
            value = getattr(node, name, None)
            if isinstance(value, list):
                self._add(unit, "[")
                for item in value:
                    if isinstance(item, ast.stmt):
                        self._statement(item, unit, depth)
                    elif isinstance(item, ast.AST):
                        self._node(item, unit, depth)
                    else:
                        self._identifier(item, unit)
                self._add(unit, "]")
            elif isinstance(value, ast.arguments):
                self._arguments(value, unit, depth)
            elif isinstance(value, ast.AST):
                self._node(value, unit, depth)
            elif name == "arg" and isinstance(value, str):
                unit.tokens.append(("k", value))
            else:
                self._identifier(value, unit)

    def _identifier(self, value: object, unit: Unit) -> None:
        """A bare name in a node's field, bound by an `except … as` or a pattern."""
        if isinstance(value, str):
            unit.stored.add(value)
            unit.tokens.append(("n", value))
        else:
            self._add(unit, repr(value))

    def _attribute(self, node: ast.Attribute, unit: Unit, depth: int) -> None:
        self.counts["nodes"] += 1
        if not isinstance(node.ctx, ast.Load):
            self.names.attribute_names.add(node.attr)
            if isinstance(node.ctx, ast.Store) and getattr(node.value, "id", None) == self._instance[1]:
                self.state.add((self._instance[0], node.attr))
        root: ast.expr = node
        path: list[str] = []
        while isinstance(root, ast.Attribute):
            path.append(root.attr)
            root = root.value
        if isinstance(root, ast.Name) and root.id not in unit.stored:
            if root.id in unit.module.external:
                unit.tokens.append(".".join([unit.module.external[root.id], *reversed(path)]))
                return
            if root.id in unit.module.modules:
                while len(path) > 1 and path[-1] in self.submodules:
                    path.pop()
                unit.tokens.append(("m", path.pop()))
                unit.tokens.extend(("a", name) for name in reversed(path))
                return
        self._node(node.value, unit, depth)
        unit.tokens.append(("a", node.attr))

    def _f_string(self, node: ast.JoinedStr, unit: Unit, depth: int) -> None:
        self._add(unit, "JoinedStr")
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                self._add(unit, "FormattedValue", str(part.conversion))
                self._node(part.value, unit, depth)
                for piece in part.format_spec.values if isinstance(part.format_spec, ast.JoinedStr) else ():
                    if isinstance(piece, ast.Constant):
                        self._add(unit, _DIGITS.sub("#", str(piece.value)))
                    elif isinstance(piece, ast.FormattedValue):
                        self._node(piece.value, unit, depth)
            else:
                self._node(part, unit, depth)
        self._add(unit, "end")

    def _nest(self, depth: int) -> int:
        self.depth = max(self.depth, depth + 1)
        return depth + 1

    def _add(self, unit: Unit, *tokens: str) -> None:
        self.counts["nodes"] += 1
        unit.tokens.extend(tokens)


_SKIPPED_FIELDS = frozenset({"ctx", "type_comment", "type_params", "annotation", "returns", "simple", "kind"})
_NO_STRUCTURE = (ast.Import, ast.ImportFrom, ast.Pass)
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_LOOPS = frozenset({ast.For, ast.AsyncFor, ast.While})
_CASES = frozenset({ast.IfExp, ast.match_case})
_NESTING = _LOOPS | {ast.With, ast.AsyncWith, ast.Try, ast.TryStar, ast.Match}


def _own_name(name: str) -> str:
    return name if name in PROTOCOL_NAMES or (name.startswith("__") and name.endswith("__")) else "·"


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def _is_number(node: ast.expr) -> bool:
    """Whether the node is a numeric constant, with a sign or without."""
    if isinstance(node, ast.UnaryOp):
        node = node.operand
    value = node.value if isinstance(node, ast.Constant) else None
    return isinstance(value, (int, float, complex)) and not isinstance(value, bool)
