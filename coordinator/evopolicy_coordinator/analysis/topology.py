"""Numeric-constant-stripped AST topology of a policy source bundle, and its structural features.

The topology is a hash that stays the same exactly when an edit leaves the policy's structure alone (paper, mechanism
section: a *parametric* edit changes the bundle "while preserving that stripped topology"). Left out of it, because none
of them is structure: the value and sign of numeric constants, digits in f-string format specifications, comments,
formatting, docstrings, type hints, imports that are not used, the order of definitions and of top-level statements,
which local module a definition is in, and the names that the bundle itself chooses. Kept: node types, operators,
order of statements inside functions, string and boolean constants, and every name that comes from outside (`np.sin`
against `np.cos`, `obs["image"]`).

Names are made canonical in three steps. Every function, class and top-level statement is a *unit*, a list of tokens.
Names local to a function are numbered by first use in it. A reference to another definition is replaced by that
definition's own label, refined a few rounds (Weisfeiler and Leman's colour refinement), so that calling another helper
is a change and renaming one is not. Attributes and globals are then numbered by first use over the units in label order.
"""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Callable, Mapping

import msgspec

from evopolicy_coordinator.analysis.sources import Module, absolute_import

_ROUNDS = 3
_PROTOCOL_NAMES = frozenset({"Policy", "act", "reset"})
_DIGITS = re.compile(r"\d+")

Token = str | tuple[str, str]


class Features(msgspec.Struct, frozen=True, kw_only=True):
    """Deterministic AST features of a source bundle: the columns of the paper's Table "Realized computational structure"."""

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
    """AST nodes that the topology looks at: a size that formatting does not change."""
    lines: int = 0
    """Source lines, blank ones and comments included."""
    modules: int = 0


class _Unit:
    __slots__ = ("children", "globals", "is_function", "module", "name", "stored", "tokens")

    def __init__(self, module: _Scope, name: str, is_function: bool) -> None:
        self.module = module
        self.name = name
        self.is_function = is_function
        self.tokens: list[Token] = []
        self.children: list[_Unit] = []
        self.stored: set[str] = set()
        self.globals: set[str] = set()


class _Scope:
    """What one module's import statements bind."""

    def __init__(self) -> None:
        self.external: dict[str, str] = {}
        self.modules: set[str] = set()
        self.aliases: dict[str, str] = {}


def describe(modules: Mapping[str, Module]) -> tuple[str, Features]:
    """Topology (32 hex digits) and features of a bundle's reachable modules."""
    walker = _Walker(set(modules))
    opaque: list[str] = []
    for module in modules.values():
        if module.tree is not None:
            try:
                walker.module(module)
                continue
            except RecursionError:
                pass
        opaque.append(_hash([module.path, module.source.hex()]))
    features = Features(
        functions=walker.functions,
        branches=walker.branches,
        loops=walker.loops,
        depth=walker.depth,
        state=len(walker.state),
        nodes=walker.nodes,
        lines=sum(
            module.source.count(b"\n") + (not module.source.endswith(b"\n")) for module in modules.values()
        ),
        modules=len(modules),
    )
    return _hash([_canonical(walker), *sorted(opaque)]), features


class _Walker:
    def __init__(self, local_modules: set[str]) -> None:
        self.local_modules = local_modules
        self.submodules = {name.rsplit(".", 1)[1] for name in local_modules if "." in name}
        self.units: list[_Unit] = []
        self.top_defs: set[str] = set()
        self.method_defs: set[str] = set()
        self.global_names: set[str] = set()
        self.attribute_names: set[str] = set()
        self.parameters: set[str] = set()
        self.state: set[tuple[str, str]] = set()
        self.functions = self.branches = self.loops = self.depth = self.nodes = 0
        self._class = ""
        self._instance = ("", "")
        """Class and first parameter of the method that is being walked."""

    def module(self, module: Module) -> None:
        assert module.tree is not None
        scope = _Scope()
        for node in module.imports:
            self._bind_import(node, scope, module)
        for statement in module.tree.body:
            unit = self._statement_unit(statement, scope, self.top_defs)
            if unit is not None:
                self.units.append(unit)
                if not unit.is_function:
                    self.global_names |= unit.stored

    def _bind_import(self, node: ast.Import | ast.ImportFrom, scope: _Scope, module: Module) -> None:
        if isinstance(node, ast.Import):
            for alias in node.names:
                bound = alias.asname or alias.name.split(".")[0]
                if alias.name.split(".")[0] in self.local_modules:
                    scope.modules.add(bound)
                else:
                    scope.external[bound] = alias.name if alias.asname else bound
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

    def _statement_unit(self, node: ast.stmt, scope: _Scope, defs: set[str]) -> _Unit | None:
        """A unit for a statement of a module's or class's body; None for what is no structure."""
        if isinstance(node, _NO_STRUCTURE) or _is_docstring(node):
            return None
        if isinstance(node, _FUNCTIONS):
            defs.add(node.name)
            unit = _Unit(scope, node.name, is_function=True)
            self._function(node, unit, 0)
            return unit
        if isinstance(node, ast.ClassDef):
            defs.add(node.name)
            return self._class_unit(node, scope)
        unit = _Unit(scope, "", is_function=False)
        self._statement(node, unit, 0)
        return unit

    def _class_unit(self, node: ast.ClassDef, scope: _Scope) -> _Unit:
        unit = _Unit(scope, node.name, is_function=False)
        outer, self._class = self._class, f"{self._class}.{node.name}"
        self._add(unit, "ClassDef", _own_name(node.name))
        for part in (*node.decorator_list, *node.bases, *node.keywords):
            self._node(part, unit, 0)
        for statement in node.body:
            child = self._class_field(statement, scope) or self._statement_unit(
                statement, scope, self.method_defs
            )
            if child is not None:
                unit.children.append(child)
                if not child.is_function:
                    self.attribute_names |= child.stored
        self._class = outer
        return unit

    def _class_field(self, node: ast.stmt, scope: _Scope) -> _Unit | None:
        """An annotated class variable: a field to dataclasses, so not the same as a plain assignment."""
        if not isinstance(node, ast.AnnAssign):
            return None
        unit = _Unit(scope, "", is_function=False)
        self._add(unit, "Field")
        self._node(node.target, unit, 0)
        if node.value is not None:
            self._node(node.value, unit, 0)
        return unit

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef, unit: _Unit, depth: int) -> None:
        self.functions += 1
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

    def _arguments(self, args: ast.arguments, unit: _Unit, depth: int) -> None:
        self._add(unit, "(")
        for group in (args.posonlyargs, args.args, args.kwonlyargs):
            for argument in group:
                unit.stored.add(argument.arg)
                self.parameters.add(argument.arg)
                unit.tokens.append(("n", argument.arg))
            self._add(unit, "/")
        for extra in (args.vararg, args.kwarg):
            if extra is not None:
                unit.stored.add(extra.arg)
                unit.tokens.append(("n", extra.arg))
            self._add(unit, "/")
        for default in (*args.defaults, *args.kw_defaults):
            if default is None:
                self._add(unit, "~")
            else:
                self._node(default, unit, depth)
        self._add(unit, ")")

    def _body(self, body: list[ast.stmt], unit: _Unit, depth: int) -> None:
        self._add(unit, "{")
        for statement in body:
            self._statement(statement, unit, depth)
        self._add(unit, "}")

    def _statement(self, node: ast.stmt, unit: _Unit, depth: int) -> None:
        if isinstance(node, _NO_STRUCTURE) or _is_docstring(node):
            return
        if isinstance(node, ast.AnnAssign):
            if node.value is not None:
                self._add(unit, "Assign")
                self._node(node.target, unit, depth)
                self._node(node.value, unit, depth)
            return
        if isinstance(node, _FUNCTIONS):
            unit.stored.add(node.name)
            unit.tokens.append(("n", node.name))
            outer, self._class = self._class, ""
            self._function(node, unit, 0)
            self._class = outer
            return
        if isinstance(node, _DECLARATIONS):
            if isinstance(node, ast.Global):
                unit.globals.update(node.names)
                self.state.update(("", name) for name in node.names)
            return
        if isinstance(node, ast.Assign):
            self._add(unit, "Assign")
            for target in node.targets:
                self._node(target, unit, depth)
            self._node(node.value, unit, depth)
            return
        self._node(node, unit, depth)

    def _node(self, node: ast.AST, unit: _Unit, depth: int) -> None:
        handler = _HANDLERS.get(type(node))
        if handler is not None:
            handler(self, node, unit, depth)
            return
        kind = type(node)
        if kind in _NESTING:
            depth = self._nest(depth)
        if kind in _LOOPS:
            self.loops += 1
        elif kind in _CASES:
            self.branches += 1
        self._add(unit, kind.__name__)
        self._fields(node, unit, depth)

    def _if(self, node: ast.If, unit: _Unit, depth: int) -> None:
        self.branches += 1
        inner = self._nest(depth)
        self._add(unit, "If")
        self._node(node.test, unit, depth)
        self._body(node.body, unit, inner)
        is_elif = len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If)
        self._body(node.orelse, unit, depth if is_elif else inner)

    def _unary(self, node: ast.UnaryOp, unit: _Unit, depth: int) -> None:
        if isinstance(node.op, (ast.USub, ast.UAdd)) and _is_number(node.operand):
            self._add(unit, "#")
        else:
            self._add(unit, "UnaryOp")
            self._fields(node, unit, depth)

    def _fields(self, node: ast.AST, unit: _Unit, depth: int) -> None:
        for name in node._fields:
            value = getattr(node, name, None)
            if name in _SKIPPED_FIELDS:
                continue
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

    def _identifier(self, value: object, unit: _Unit) -> None:
        """A bare name in a node's field: what an `except … as`, or a pattern, binds."""
        if isinstance(value, str):
            unit.stored.add(value)
            unit.tokens.append(("n", value))
        else:
            self._add(unit, repr(value))

    def _name(self, node: ast.Name, unit: _Unit, depth: int) -> None:
        self.nodes += 1
        if not isinstance(node.ctx, ast.Load):
            unit.stored.add(node.id)
        unit.tokens.append(("n", node.id))

    def _attribute(self, node: ast.Attribute, unit: _Unit, depth: int) -> None:
        self.nodes += 1
        if not isinstance(node.ctx, ast.Load):
            self.attribute_names.add(node.attr)
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
                inside = list(reversed(path))
                while len(inside) > 1 and inside[0] in self.submodules:
                    inside.pop(0)
                unit.tokens.append(("m", inside[0]))
                unit.tokens.extend(("a", name) for name in inside[1:])
                return
        self._node(node.value, unit, depth)
        unit.tokens.append(("a", node.attr))

    def _constant(self, node: ast.Constant, unit: _Unit, depth: int) -> None:
        self._add(unit, "#" if _is_number(node) else repr(node.value))

    def _f_string(self, node: ast.JoinedStr, unit: _Unit, depth: int) -> None:
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

    def _add(self, unit: _Unit, *tokens: str) -> None:
        self.nodes += 1
        unit.tokens.extend(tokens)


_SKIPPED_FIELDS = frozenset({"ctx", "type_comment", "type_params", "annotation", "returns", "simple", "kind"})


_HANDLERS: dict[type[ast.AST], Callable[..., None]] = {
    ast.Name: _Walker._name,
    ast.Constant: _Walker._constant,
    ast.Attribute: _Walker._attribute,
    ast.UnaryOp: _Walker._unary,
    ast.JoinedStr: _Walker._f_string,
    ast.If: _Walker._if,
}
_NO_STRUCTURE = (ast.Import, ast.ImportFrom, ast.Pass)
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_DECLARATIONS = (ast.Global, ast.Nonlocal)
_LOOPS = frozenset({ast.For, ast.AsyncFor, ast.While})
_CASES = frozenset({ast.IfExp, ast.match_case})
_NESTING = _LOOPS | {ast.With, ast.AsyncWith, ast.Try, ast.TryStar, ast.Match}


def _own_name(name: str) -> str:
    return name if name in _PROTOCOL_NAMES or (name.startswith("__") and name.endswith("__")) else "·"


def _is_docstring(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _is_number(node: ast.expr) -> bool:
    return (
        isinstance(node, ast.Constant)
        and isinstance(node.value, (int, float, complex))
        and not isinstance(node.value, bool)
    )


def _hash(parts: list[str]) -> str:
    return hashlib.blake2b("\x1f".join(parts).encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()


def _canonical(walker: _Walker) -> str:
    every: list[_Unit] = []
    queue = list(reversed(walker.units))
    while queue:
        unit = queue.pop()
        every.append(unit)
        queue.extend(reversed(unit.children))
    resolved = [_resolve(unit, walker) for unit in every]
    place = {id(unit): i for i, unit in enumerate(every)}
    texts = [_numbered(tokens, {}, {}) for tokens in resolved]
    references = [
        [(at, token[1]) for at, token in enumerate(tokens) if isinstance(token, tuple) and token[0] == "d"]
        for tokens in resolved
    ]
    labels: dict[str, str] = {}
    own = [""] * len(every)
    for turn in range(_ROUNDS):
        for i in range(
            len(every) - 1, -1, -1
        ):  # a class comes before its children, and its label holds theirs
            if turn and not references[i] and not every[i].children:
                continue
            for at, name in references[i]:
                texts[i][at] = "d" + labels.get(name, "")
            own[i] = _hash([*texts[i], *sorted(own[place[id(child)]] for child in every[i].children)])
        by_name: dict[str, list[str]] = {}
        for unit, label in zip(every, own, strict=True):
            if unit.name:
                by_name.setdefault(unit.name, []).append(label)
        labels = {name: _hash(sorted(found)) for name, found in by_name.items()}
    order = sorted(range(len(every)), key=lambda i: own[i])
    shared: dict[tuple[str, str], str] = {}
    final = {id(every[i]): _hash(_numbered(resolved[i], labels, shared)) for i in order}

    def fold(unit: _Unit) -> str:
        return _hash([final[id(unit)], *sorted(fold(child) for child in unit.children)])

    return _hash(sorted(fold(unit) for unit in walker.units))


def _resolve(unit: _Unit, walker: _Walker) -> list[Token]:
    """Tokens whose names are marked local (`l`), definition (`d`), global (`g`), attribute (`a`), or plain text."""
    local = unit.stored - unit.globals if unit.is_function else frozenset()
    scope = unit.module
    out: list[Token] = []
    for token in unit.tokens:
        if isinstance(token, str):
            out.append(token)
            continue
        kind, name = token
        if kind == "a":
            if name in walker.method_defs and name not in _PROTOCOL_NAMES and not name.startswith("__"):
                out.append(("d", name))
            else:
                out.append(("a", name) if name in walker.attribute_names else name)
            continue
        if kind == "k":
            out.append(("k", name) if name in walker.parameters else name)
            continue
        if kind == "n" and name in local:
            out.append(("l", name))
            continue
        target = scope.aliases.get(name, name)
        if kind == "n" and name in scope.external:
            out.append(scope.external[name])
        elif target in walker.top_defs:
            out.append(("d", target))
        elif target in walker.global_names:
            out.append(("g", target))
        elif target in walker.attribute_names and not unit.is_function:
            out.append(("a", target))
        else:
            out.append(target)
    return out


def _numbered(tokens: list[Token], labels: dict[str, str], shared: dict[tuple[str, str], str]) -> list[str]:
    local: dict[tuple[str, str], str] = {}
    out: list[str] = []
    for token in tokens:
        if isinstance(token, str):
            out.append(token)
        elif token[0] == "d":
            out.append("d" + labels.get(token[1], ""))
        else:
            numbers = local if token[0] in "lk" else shared
            out.append(numbers.setdefault(token, f"{token[0]}{len(numbers)}"))
    return out
