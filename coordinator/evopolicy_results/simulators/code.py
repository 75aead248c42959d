"""The code of one bundle, indexed for the search for simulators: modules, functions by name, recorded data,
selections."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping

from evopolicy_common.records.code_metrics import parse

Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Scope = ast.Module | Function

MAX_NODES = 20_000
"""Modules with more AST nodes are not searched: they are data in disguise, or a library."""
_MAX_TEXTS = 20
_MAX_NAMESAKES = 4
"""Maximum number of functions of one name that a call may refer to."""
_SELECTING = frozenset(
    {"max", "min", "sorted", "sort", "argmax", "argmin", "argsort", "argpartition", "nlargest", "nsmallest", "amax", "amin"}
)  # fmt: skip
_LOADING = frozenset(
    {"load", "loads", "loadtxt", "genfromtxt", "open", "read_text", "read_bytes", "read_csv", "reader", "DictReader",
     "readlines", "splitlines", "fromfile"}
)  # fmt: skip
RECORDED_KEYS = frozenset(
    {"obs", "action", "reward", "observation", "observations", "actions", "rewards", "returns", "next_obs", "terminated"}
)  # fmt: skip
"""Keys of a trajectory's rows. Reading one of them from a loop's item reads recorded data."""


class Part:
    """One module of a bundle: a file, or code that a file contains as a string."""

    def __init__(self, path: str, tree: ast.Module, first_line: int = 1) -> None:
        self.path = path
        self.tree = tree
        self.first_line = first_line
        """Line of the file at which the text of `tree` begins."""
        self.scopes: list[Scope] = [tree, *(n for n in ast.walk(tree) if isinstance(n, Function))]
        self.imported: set[str] = set()
        """Names that imports bind."""
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    self.imported.add(alias.asname or alias.name.split(".")[0])
            elif isinstance(node, ast.ImportFrom):
                for alias in node.names:
                    self.imported.add(alias.asname or alias.name)


class Code:
    """All modules of a bundle, and the facts about them that are collected before any loop is examined."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self.steps = 0
        """Number of expressions followed so far."""
        self.parts = [part for path, source in files.items() for part in _parts(path, source)]
        self.functions: dict[str, list[Function]] = {}
        self.methods: dict[str, list[tuple[ast.ClassDef, ast.FunctionDef]]] = {}
        self.classes: dict[str, ast.ClassDef] = {}
        self.recorded: dict[Scope, set[str]] = {}
        """Names in each scope that hold recorded data."""
        self.selected: set[Function] = set()
        """Functions called for each of several candidates, of which one is selected."""
        self.imported: set[str] = set().union(*(part.imported for part in self.parts))
        for part in self.parts:
            self._collect(part.tree)
        self._find_recorded()
        self._find_selected()

    def _collect(self, tree: ast.Module) -> None:
        members: set[ast.AST] = set()

        def add(name: str, function: Function) -> None:
            known = self.functions.setdefault(name, [])
            if len(known) < _MAX_NAMESAKES:
                known.append(function)

        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                self.classes[node.name] = node
                for child in node.body:
                    if isinstance(child, ast.FunctionDef):
                        members.add(child)
                        namesakes = self.methods.setdefault(child.name, [])
                        if len(namesakes) < _MAX_NAMESAKES:
                            namesakes.append((node, child))
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node not in members:
                add(node.name, node)
            elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Lambda):
                for target in node.targets:
                    if isinstance(target, ast.Name):
                        add(target.id, node.value)

    def called(self, call: ast.Call) -> list[Function]:
        """Functions of the bundle that this call may refer to, by name."""
        if isinstance(call.func, ast.Name):
            return self.functions.get(call.func.id, [])
        if isinstance(call.func, ast.Attribute):
            return [method for _, method in self.methods.get(call.func.attr, [])]
        return []

    def _find_recorded(self) -> None:
        """Finds recorded data: data loaded from files, and data derived from it, through up to three passes over
        calls."""
        scopes = [scope for part in self.parts for scope in part.scopes]
        self.recorded = {scope: set() for scope in scopes}
        for _ in range(3):
            before = sum(map(len, self.recorded.values()))
            for scope in scopes:
                names = self.recorded[scope]
                for node in own_nodes(scope):
                    if isinstance(
                        node, ast.Assign | ast.AugAssign | ast.AnnAssign | ast.For | ast.comprehension
                    ):
                        source = node.iter if isinstance(node, ast.For | ast.comprehension) else node.value
                        if source is not None and self.is_recorded(source, names):
                            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                            names.update(name for target in targets for name in stored_names(target))
                    elif isinstance(node, ast.Call):
                        self._pass_on(node, names)
            if sum(map(len, self.recorded.values())) == before:
                return

    def _pass_on(self, call: ast.Call, names: set[str]) -> None:
        for function in self.called(call):
            parameters = parameters_of(function)
            if isinstance(call.func, ast.Attribute) and parameters[:1] == ["self"]:
                parameters = parameters[1:]
            for parameter, value in zip(parameters, call.args, strict=False):
                if self.is_recorded(value, names):
                    self.recorded[function].add(parameter)

    def is_recorded(self, node: ast.AST, names: set[str]) -> bool:
        """Whether an expression reads recorded data; `names` are those that hold some."""
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name) and inner.id in names:
                return True
            if isinstance(inner, ast.Call) and called_name(inner) in _LOADING:
                return True
            if (
                isinstance(inner, ast.Subscript)
                and key_of(inner) in RECORDED_KEYS
                and "desired_goal" not in ast.dump(inner.slice)
            ):
                return isinstance(inner.value, ast.Name) and inner.value.id not in ("obs", "observation")
        return False

    def _find_selected(self) -> None:
        for part in self.parts:
            for scope in part.scopes:
                if any(selects(node) for node in own_nodes(scope, lambdas=True)):
                    for call in _calls_for_each(scope):
                        self.selected.update(self.called(call))
        for _ in range(3):
            for function in list(self.selected):
                for node in ast.walk(function):
                    if isinstance(node, ast.Call):
                        self.selected.update(self.called(node))


def _parts(path: str, source: bytes) -> list[Part]:
    tree = parse(source)
    if tree is None or sum(1 for _ in ast.walk(tree)) > MAX_NODES:
        return []
    found = [Part(path, tree)]
    texts = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.count("\n") > 2
    ]
    documentation = {id(body[0].value) for body in _bodies(tree) if body and isinstance(body[0], ast.Expr)}
    for node in texts[:_MAX_TEXTS]:
        text = str(node.value)
        inner = parse(text.encode("utf-8", "replace")) if id(node) not in documentation else None
        if inner is not None and any(
            isinstance(n, ast.For | ast.While | ast.FunctionDef) for n in inner.body
        ):
            found.append(Part(path, inner, node.lineno))
    return found


def _bodies(tree: ast.Module) -> Iterator[list[ast.stmt]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.body


def own_nodes(scope: Scope, *, lambdas: bool = False) -> list[ast.AST]:
    """Nodes of a scope without those of nested functions; optionally with those of its lambdas."""
    kept = "_own_with_lambdas" if lambdas else "_own"
    known: list[ast.AST] | None = getattr(scope, kept, None)
    if known is None:
        inner = (ast.FunctionDef, ast.AsyncFunctionDef, *(() if lambdas else (ast.Lambda,)))
        known = []
        body: list[ast.AST] = [scope.body] if isinstance(scope, ast.Lambda) else list(scope.body)
        while body:
            node = body.pop()
            if not isinstance(node, inner):
                known.append(node)
                body.extend(ast.iter_child_nodes(node))
        setattr(scope, kept, known)
    return known


def _calls_for_each(scope: Scope) -> Iterator[ast.Call]:
    """Calls inside loops, comprehensions and lambdas of a scope, and functions passed as a key or to `map`."""
    for node in own_nodes(scope, lambdas=True):
        if isinstance(
            node,
            ast.For | ast.While | ast.ListComp | ast.GeneratorExp | ast.DictComp | ast.SetComp | ast.Lambda,
        ):
            yield from (inner for inner in ast.walk(node) if isinstance(inner, ast.Call))
        elif isinstance(node, ast.Call):
            named = [k.value for k in node.keywords if k.arg == "key"]
            if called_name(node) == "map":
                named += node.args[:1]
            for function in named:
                if isinstance(function, ast.Name | ast.Attribute):
                    yield ast.Call(func=function, args=[], keywords=[])


def selects(node: ast.AST) -> bool:
    """Whether the node selects among candidates: a maximum, a sort, a comparison with the best so far."""
    if isinstance(node, ast.Call) and called_name(node) in _SELECTING:
        # `min(a, b)` bounds a number; candidates come as one sequence, or with a key.
        return len(node.args) <= 1 or any(k.arg == "key" for k in node.keywords)
    if isinstance(node, ast.If):
        tests = [n for n in ast.walk(node.test) if isinstance(n, ast.Compare)]
        compared = {name.id for test in tests for name in ast.walk(test) if isinstance(name, ast.Name)}
        stored = {
            name
            for s in node.body
            if isinstance(s, ast.Assign)
            for t in s.targets
            for name in stored_names(t)
        }
        return bool(compared & stored) and any(
            isinstance(op, ast.Gt | ast.Lt | ast.GtE | ast.LtE) for t in tests for op in t.ops
        )
    return False


def called_name(call: ast.Call) -> str:
    """The last part of the called name; empty for other expressions."""
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def key_of(node: ast.Subscript) -> str | None:
    """The literal text of the subscript; None for any other."""
    value = node.slice.value if isinstance(node.slice, ast.Constant) else None
    return value if isinstance(value, str) else None


def stored_names(target: ast.AST) -> list[str]:
    """Plain names that an assignment to `target` stores or changes."""
    if isinstance(target, ast.Subscript | ast.Attribute | ast.Starred):
        return stored_names(target.value)
    return (
        [target.id]
        if isinstance(target, ast.Name)
        else [n for c in getattr(target, "elts", ()) for n in stored_names(c)]
    )


def parameters_of(function: Function) -> list[str]:
    return [a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
