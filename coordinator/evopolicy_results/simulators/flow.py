"""Follows values through one pass of a loop's body, to find the names at its start that each new value depends on.

The analysis enters functions of the bundle, up to four calls deep. No code is run. The result overestimates
dependencies: branches are joined, and the elements of a list are one value.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from typing import NamedTuple

from evopolicy_results.simulators.code import (
    RECORDED_KEYS,
    Code,
    Function,
    called_name,
    key_of,
    own_nodes,
    parameters_of,
    stored_names,
)

MAX_STEPS, MAX_ALL_STEPS = 8_000, 60_000
"""Maximum number of expressions followed for one loop, and for all of a bundle."""
_DEPTH = 4
_NOTHING: frozenset[str] = frozenset()

_CURVED = frozenset(
    {"sin", "cos", "tan", "exp", "sqrt", "tanh", "arctan2", "atan2", "arctan", "dot", "matmul", "einsum", "hypot", "square",
     "power", "pow", "multiply", "norm", "fmod", "cumsum", "inner", "outer", "log", "sinh", "cosh", "rot90"}
)  # fmt: skip
_DRAWING = frozenset(
    {"random", "uniform", "gauss", "normal", "choice", "choices", "randrange", "randint", "integers", "standard_normal", "rand",
     "randn", "sample"}
)  # fmt: skip
_CHOOSING = frozenset({"argmax", "argmin", "sign", "copysign"})
_ADDING = frozenset(
    {"append", "appendleft", "add", "extend", "insert", "push", "put", "update", "heappush", "setdefault"}
)
_ASKING = frozenset(
    {"urlopen", "post", "submit", "request", "getresponse", "sendall", "recv", "check_output", "Popen"}
)
_BENDING = (ast.Mult, ast.Div, ast.Pow, ast.MatMult, ast.FloorDiv)


class Flow(NamedTuple):
    """The dependencies of one value."""

    deps: frozenset[str] = _NOTHING
    """Names, with their values at the start of the pass."""
    bent: frozenset[str] = _NOTHING
    """Those multiplied, divided or passed through a function on the way."""
    looked: frozenset[str] = _NOTHING
    """Those used as an index into a table."""
    chosen: bool = False
    """Depends on a decision: a policy's answer, a branch, a random draw, an item of a plan."""
    fresh: bool = False
    """Depends on recorded data that this pass read."""
    asked: bool = False
    """Depends on another process's answer."""
    time: bool = False
    """Is, or is derived from, the number of the pass."""


def join(flows: Iterable[Flow]) -> Flow:
    deps, bent, looked = set[str](), set[str](), set[str]()
    chosen = fresh = asked = time = False
    for flow in flows:
        deps |= flow.deps
        bent |= flow.bent
        looked |= flow.looked
        chosen, fresh = chosen or flow.chosen, fresh or flow.fresh
        asked, time = asked or flow.asked, time or flow.time
    return Flow(frozenset(deps), frozenset(bent), frozenset(looked), chosen, fresh, asked, time)


class _Frame:
    """The frame of one entered function. The bottom frame is the loop's own scope."""

    def __init__(self, function: Function | None) -> None:
        self.function = function
        self.values: dict[str, Flow] = {}
        self.stands_for: dict[str, str] = {}
        """By parameter, the bottom frame's name of the passed object."""
        self.returned: list[Flow] = []
        self.own: set[str] = set()
        if function is not None:
            outer = {
                n
                for node in own_nodes(function)
                if isinstance(node, ast.Nonlocal | ast.Global)
                for n in node.names
            }
            stored = {
                node.id
                for node in own_nodes(function)
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
            }
            self.own = (stored - outer) | set(parameters_of(function))


class TooMuchError(Exception):
    """The loop is too large to be followed."""


class Pass:
    """One pass of a body. Afterwards `values` has the new values of the names that it changed."""

    def __init__(self, code: Code, recorded: set[str]) -> None:
        self.code = code
        self.imported = code.imported
        self.recorded = recorded
        self.values: dict[str, Flow] = {}
        self.sums: dict[str, list[Flow]] = {}
        """Names that something was added to, with the added values."""
        self.stored_otherwise: set[str] = set()
        self.exchanged: list[Flow] = []
        """Values that a generator's body yields in exchange for a value."""
        self.returned: list[Flow] = []
        """Values that the scope returns from inside the loop."""
        self.tested: list[Flow] = []
        """Conditions that end or leave the loop."""
        self.asks = False
        """Whether the body queries another process, as a submit does."""
        self.queued = False
        """Whether values go through a priority queue."""
        self._frames = [_Frame(None)]
        self._steps = 0

    # -- names

    def _place(self, name: str) -> str | None:
        """The bottom frame's name for it; None for a local name of the inner frame."""
        frame = self._frames[-1]
        if frame.function is None:
            return name
        if name in frame.stands_for:
            return frame.stands_for[name]
        return None if name in frame.own else name

    def _read(self, name: str) -> Flow:
        place = self._place(name)
        if place is None:
            return self._frames[-1].values.get(name, Flow())
        if place in self.values:
            return self.values[place]
        parts = [flow for key, flow in self.values.items() if key.startswith(f"{place}.")]
        return join([Flow(frozenset({place})), *parts])

    def _write(self, name: str, flow: Flow, *, weak: bool = False) -> None:
        place = self._place(name)
        values = self._frames[-1].values if place is None else self.values
        key = name if place is None else place
        if place is not None and not weak and name in self._frames[-1].stands_for:
            del self._frames[-1].stands_for[name]
            self._frames[-1].values[name] = flow
            return
        values[key] = join([self._read(name), flow]) if weak else flow
        if place is not None:
            self.stored_otherwise.add(key)

    def _dotted(self, node: ast.Attribute) -> str | None:
        if not isinstance(node.value, ast.Name):
            return None
        place = self._place(node.value.id)
        return None if place is None else f"{place}.{node.attr}"

    # -- statements

    def run(self, body: Iterable[ast.stmt]) -> None:
        for statement in body:
            self._statement(statement)

    def _statement(self, node: ast.stmt) -> None:
        self._count()
        if isinstance(node, ast.Assign):
            if len(node.targets) == 1 and self._added(node.targets[0], node.value):
                return
            for target in node.targets:
                self._store(target, node.value, None)
        elif isinstance(node, ast.AnnAssign):
            if node.value is not None:
                self._store(node.target, node.value, None)
        elif isinstance(node, ast.AugAssign):
            self._augment(node)
        elif isinstance(node, ast.If):
            self._branch(node)
        elif isinstance(node, ast.For | ast.AsyncFor):
            self._bind(node.target, node.iter, inner=True)
            for _ in range(2):
                self.run(node.body)
            self.run(node.orelse)
        elif isinstance(node, ast.While):
            self.value(node.test)
            for _ in range(2):
                self.run(node.body)
        elif isinstance(node, ast.Return):
            flow = self.value(node.value) if node.value is not None else Flow()
            frame = self._frames[-1]
            (self.returned if frame.function is None else frame.returned).append(flow)
        elif isinstance(node, ast.With | ast.AsyncWith):
            for item in node.items:
                if item.optional_vars is not None:
                    self._store(item.optional_vars, item.context_expr, None)
            self.run(node.body)
        elif isinstance(node, ast.Try):
            for part in (node.body, *(h.body for h in node.handlers), node.orelse, node.finalbody):
                self.run(part)
        elif isinstance(node, ast.Match):
            self.value(node.subject)
            for case in node.cases:
                self.run(case.body)
        elif isinstance(node, ast.Expr):
            self.value(node.value)

    def _branch(self, node: ast.If) -> None:
        test = self.value(node.test)
        if any(
            isinstance(n, ast.Break | ast.Return) for s in (*node.body, *node.orelse) for n in ast.walk(s)
        ):
            self.tested.append(test)
        before = dict(self.values), dict(self._frames[-1].values)
        self.run(node.body)
        first = dict(self.values), dict(self._frames[-1].values)
        self.values, self._frames[-1].values = dict(before[0]), dict(before[1])
        self.run(node.orelse)
        decided = Flow(chosen=bool(test.deps), fresh=False)
        for now, then, old in zip((self.values, self._frames[-1].values), first, before, strict=True):
            for key in {*now, *then}:
                same = now.get(key) == then.get(key)
                sides = [side.get(key, old.get(key, Flow(frozenset({key})))) for side in (now, then)]
                now[key] = sides[0] if same else join([*sides, decided])

    def _augment(self, node: ast.AugAssign) -> None:
        flow = self.value(node.value)
        old = self.value(_loaded(node.target))
        name = self._sum_name(node.target)
        if isinstance(node.op, ast.Add | ast.Sub):
            new = join([old, flow])
            if name is not None:
                self.sums.setdefault(name, []).append(flow)
                self._set(node.target, new)
                return
        else:
            new = _bent(join([old, flow])) if isinstance(node.op, _BENDING) else join([old, flow])
        self._assign(node.target, new)

    def _added(self, target: ast.expr, value: ast.expr) -> bool:
        """Treats `total = total + x` as `total += x`."""
        if not isinstance(value, ast.BinOp) or not isinstance(value.op, ast.Add | ast.Sub):
            return False
        if not isinstance(target, ast.Name | ast.Attribute):
            return False
        same = ast.dump(_loaded(target)) == ast.dump(value.left)
        if not same or self._sum_name(target) is None:
            return False
        self._augment(ast.AugAssign(target=target, op=value.op, value=value.right))
        return True

    def _sum_name(self, target: ast.expr) -> str | None:
        if isinstance(target, ast.Name):
            return self._place(target.id)
        return self._dotted(target) if isinstance(target, ast.Attribute) else None

    def _set(self, target: ast.expr, flow: Flow) -> None:
        """Stores a sum without recording it as another kind of store."""
        name = self._sum_name(target)
        was = name in self.stored_otherwise
        self._assign(target, flow)
        if name is not None and not was:
            self.stored_otherwise.discard(name)

    def _store(self, target: ast.expr, value: ast.expr, flow: Flow | None) -> None:
        pair = isinstance(target, ast.Tuple | ast.List) and isinstance(value, ast.Tuple | ast.List)
        if pair and len(target.elts) == len(value.elts):  # type: ignore[attr-defined]
            flows = [self.value(part) for part in value.elts]  # type: ignore[attr-defined]
            for part, each in zip(target.elts, flows, strict=True):  # type: ignore[attr-defined]
                self._assign(part, each)
            return
        self._assign(target, self.value(value) if flow is None else flow)

    def _assign(self, target: ast.expr, flow: Flow) -> None:
        if isinstance(target, ast.Name):
            self._write(target.id, flow)
        elif isinstance(target, ast.Tuple | ast.List):
            for part in target.elts:
                self._assign(part, flow)
        elif isinstance(target, ast.Starred):
            self._assign(target.value, flow)
        elif isinstance(target, ast.Attribute):
            dotted = self._dotted(target)
            if dotted is not None:
                self.values[dotted] = flow
                self.stored_otherwise.add(dotted)
            else:
                self._weaken(target.value, flow)
        elif isinstance(target, ast.Subscript):
            self._weaken(target.value, join([flow, self.value(target.slice)]))

    def _weaken(self, target: ast.expr, flow: Flow) -> None:
        """Joins `flow` into a target of which only a part has changed."""
        if isinstance(target, ast.Name):
            self._write(target.id, flow, weak=True)
        elif isinstance(target, ast.Attribute):
            dotted = self._dotted(target)
            if dotted is None:
                self._weaken(target.value, flow)
            else:
                self.values[dotted] = join([self.value(_loaded(target)), flow])
                self.stored_otherwise.add(dotted)
        elif isinstance(target, ast.Subscript | ast.Starred):
            self._weaken(target.value, flow)

    def bind_loop(self, target: ast.expr, source: ast.expr) -> None:
        """Binds the items of the loop's own iterable."""
        self._bind(target, source, inner=False)

    def _bind(self, target: ast.expr, source: ast.expr, *, inner: bool) -> None:
        if isinstance(source, ast.Call) and called_name(source) in ("range", "count"):
            self._assign(target, Flow(time=not inner))
            return
        items = self.value(source)
        if inner:
            self._assign(target, items._replace(chosen=True))
            return
        recorded = self._frames[-1].function is None and self.code.is_recorded(source, self.recorded)
        item = Flow(deps=frozenset({"@item"}), chosen=True, fresh=recorded)
        if (
            isinstance(source, ast.Call)
            and called_name(source) == "enumerate"
            and isinstance(target, ast.Tuple)
        ):
            self._assign(target.elts[0], Flow(time=True))
            target = target.elts[-1]
        self._assign(target, item)

    # -- expressions

    def _count(self) -> None:
        self._steps += 1
        self.code.steps += 1
        if self._steps > MAX_STEPS or self.code.steps > MAX_ALL_STEPS:
            raise TooMuchError

    def value(self, node: ast.expr | None) -> Flow:
        """Returns the expression's dependencies; applies its side effects."""
        if node is None or isinstance(node, ast.Constant):
            return Flow()
        self._count()
        if isinstance(node, ast.Name):
            return Flow() if node.id in self.imported else self._read(node.id)
        if isinstance(node, ast.BinOp):
            both = join([self.value(node.left), self.value(node.right)])
            # The index of a neighbour, computed by adding a table's entry, is no state from a table.
            return (_bent(both) if isinstance(node.op, _BENDING) else both)._replace(looked=_NOTHING)
        if isinstance(node, ast.Compare):
            both = join([self.value(node.left), *(self.value(c) for c in node.comparators)])
            return both._replace(bent=_NOTHING, looked=_NOTHING, chosen=both.chosen or bool(both.deps))
        if isinstance(node, ast.IfExp):
            test = self.value(node.test)
            sides = join([self.value(node.body), self.value(node.orelse)])
            return sides._replace(
                deps=sides.deps | test.deps,
                chosen=sides.chosen or bool(test.deps),
                fresh=sides.fresh or test.fresh,
            )
        if isinstance(node, ast.Attribute):
            return self._attribute(node)
        if isinstance(node, ast.Subscript):
            return self._subscript(node)
        if isinstance(node, ast.Call):
            return self._call(node)
        if isinstance(node, ast.Lambda):
            return self._follow(node, [], {}, None)
        if isinstance(node, ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp):
            return self._comprehension(node)
        if isinstance(node, ast.NamedExpr):
            flow = self.value(node.value)
            self._assign(node.target, flow)
            return flow
        if isinstance(node, ast.Yield | ast.YieldFrom):
            frame = self._frames[-1]
            handed = self.value(node.value)
            (self.exchanged if frame.function is None else frame.returned).append(handed)
            return Flow(deps=frozenset({"@item"}), chosen=True)
        return join(self.value(child) for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr))

    def _attribute(self, node: ast.Attribute) -> Flow:
        dotted = self._dotted(node)
        if dotted is None or not isinstance(node.value, ast.Name):
            return self.value(node.value)
        if node.value.id in self.imported:
            return Flow()
        if dotted in self.values:
            return self.values[dotted]
        root = dotted.rsplit(".", 1)[0]
        if root in self.values:
            return self.values[root]
        return Flow(frozenset({dotted}))

    def _subscript(self, node: ast.Subscript) -> Flow:
        base, index = self.value(node.value), self.value(node.slice)
        found = join([base, index])
        if index.time:
            place = node.value
            recorded = self._frames[-1].function is None and self.code.is_recorded(place, self.recorded)
            found = found._replace(chosen=True, time=False, fresh=found.fresh or recorded)
        if key_of(node) in RECORDED_KEYS and "@item" in base.deps:
            found = found._replace(fresh=True)
        # A slice is a shorter text or list, not a table's entry for a state.
        return (
            found if isinstance(node.slice, ast.Slice) else found._replace(looked=found.looked | index.deps)
        )

    def _comprehension(self, node: ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp) -> Flow:
        for generator in node.generators:
            self._bind(generator.target, generator.iter, inner=True)
            for test in generator.ifs:
                self.value(test)
        if isinstance(node, ast.DictComp):
            return join([self.value(node.key), self.value(node.value)])
        return self.value(node.elt)

    def _call(self, node: ast.Call) -> Flow:
        name = called_name(node)
        arguments = [self.value(arg) for arg in node.args]
        named = {k.arg: self.value(k.value) for k in node.keywords}
        given = join([*arguments, *named.values()])
        self.asks = self.asks or name in _ASKING
        if isinstance(node.func, ast.Attribute):
            root = node.func.value
            library = isinstance(root, ast.Name) and root.id in self.imported
            if not library:
                if name == "act":  # The contract's name: its result is an action, even if it keeps state.
                    return given._replace(chosen=True, bent=_NOTHING)
                followed = [
                    (c, m) for c, m in self.code.methods.get(name, []) if m is not self._frames[-1].function
                ]
                if followed:
                    return self._follow_method(node.func, followed, arguments, named, node)
                if name in _ADDING:
                    self._weaken(root, given)
                    return Flow()
                given = join([self.value(root), given])
        elif isinstance(node.func, ast.Name):
            functions = self.code.functions.get(name, [])
            if functions:
                return join(self._follow(f, arguments, named, node) for f in functions[:3])
            if name not in self.imported and name not in _BUILTINS and name not in self.code.classes:
                return self._unknown(arguments, given)
        else:
            return self._unknown(arguments, join([self.value(node.func), given]))
        if name == "heappush" and node.args:
            self.queued = True
            self._weaken(node.args[0], given)
        if name in _ASKING:
            given = given._replace(asked=True)
        if name in _DRAWING:
            given = given._replace(chosen=True)
        if name in _CHOOSING:
            given = given._replace(chosen=True, bent=_NOTHING)
        return _bent(given) if name in _CURVED else given

    def _unknown(self, arguments: list[Flow], given: Flow) -> Flow:
        """A callable passed in as a value. If its arguments include a state and another choice, it may be a model."""
        chosen = [a for a in arguments if a.chosen]
        states = [a for a in arguments if a.deps and not a.chosen]
        found = given._replace(chosen=True)
        return _bent(found) if chosen and states else found._replace(bent=_NOTHING)

    def _follow_method(
        self,
        func: ast.Attribute,
        methods: list[tuple[ast.ClassDef, ast.FunctionDef]],
        arguments: list[Flow],
        named: dict[str | None, Flow],
        call: ast.Call,
    ) -> Flow:
        place: str | None = None
        owner = self.value(func.value)
        if isinstance(func.value, ast.Name):
            place = self._place(func.value.id)
        elif isinstance(func.value, ast.Attribute):
            place = self._dotted(func.value)
        found = []
        for _, method in methods[:3]:
            found.append(self._follow(method, [owner, *arguments], named, call, own=place))
        return join(found)

    def _follow(
        self,
        function: Function,
        arguments: list[Flow],
        named: dict[str | None, Flow],
        call: ast.Call | None,
        own: str | None = None,
    ) -> Flow:
        given = join([*arguments, *named.values()])
        if len(self._frames) > _DEPTH or any(frame.function is function for frame in self._frames):
            return given
        parameters = parameters_of(function)
        if (
            own is None
            and parameters[:1] == ["self"]
            and len(arguments) < len(parameters)
            and call is not None
        ):
            parameters = parameters[1:]
        frame = _Frame(function)
        starred = call is not None and any(isinstance(arg, ast.Starred) for arg in call.args)
        for number, parameter in enumerate(parameters):
            if starred:
                frame.values[parameter] = given
            else:
                frame.values[parameter] = named.get(
                    parameter, arguments[number] if number < len(arguments) else Flow()
                )
        shift = 1 if own is not None else 0
        if own is not None and parameters:
            frame.stands_for[parameters[0]] = own
        if call is not None and not starred:
            for parameter, argument in zip(parameters[shift:], call.args, strict=False):
                if (
                    isinstance(argument, ast.Name)
                    and (place := self._place(argument.id)) is not None
                    and _changes(function, parameter)
                ):
                    frame.stands_for[parameter] = place
        self._frames.append(frame)
        try:
            if isinstance(function, ast.Lambda):
                return self.value(function.body)
            self.run(function.body)
        finally:
            self._frames.pop()
        return join(frame.returned)


def _changes(function: Function, parameter: str) -> bool:
    """Whether the function stores into a part of its parameter."""
    for node in own_nodes(function):
        stored = isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store)
        if stored and parameter in stored_names(node):
            return True
    return False


def _bent(flow: Flow) -> Flow:
    return flow._replace(bent=flow.deps)


def _loaded(node: ast.expr) -> ast.expr:
    """The same expression in load context."""
    if isinstance(node, ast.Name):
        return ast.Name(id=node.id, ctx=ast.Load())
    if isinstance(node, ast.Attribute):
        return ast.Attribute(value=node.value, attr=node.attr, ctx=ast.Load())
    if isinstance(node, ast.Subscript):
        return ast.Subscript(value=node.value, slice=node.slice, ctx=ast.Load())
    return node


_BUILTINS = frozenset(
    {"abs", "all", "any", "bool", "complex", "dict", "divmod", "enumerate", "float", "frozenset", "getattr", "hash", "int",
     "isinstance", "iter", "len", "list", "map", "max", "min", "next", "object", "open", "pow", "print", "range", "repr",
     "reversed", "round", "set", "slice", "sorted", "str", "sum", "super", "tuple", "type", "zip", "filter", "vars", "input",
     "format", "ord", "chr", "hasattr", "setattr", "id", "bytes", "bytearray"}
)  # fmt: skip
