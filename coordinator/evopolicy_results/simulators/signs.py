"""Rules by which code looks like a simulator: signs with points; three points in one place make a flag.

A loop is judged by its use of its own earlier values, not by its names. It looks like a rollout if

- a state is computed from the previous state by more than addition (multiplied, passed through a function, looked up
  in a table),
- a decision is made in between: a policy's answer, an item of a plan, a branch, a candidate that is tried, and
- some value of the states is summed, counted or compared: a return, a length, a final distance.

Loops that read recorded data at each pass (filters, statistics, training, replays through a policy), and loops whose
sums come from another process (submits), do not count. One step for each observation, as in a filter's `act`, is no
loop.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import Literal

import msgspec

from evopolicy_common.records.code_metrics import parse
from evopolicy_common.simulators import SIMULATORS
from evopolicy_results.simulators.code import (
    Code,
    Function,
    Part,
    Scope,
    called_name,
    own_nodes,
    parameters_of,
    selects,
)
from evopolicy_results.simulators.flow import Flow, Pass, TooMuchError, join

Kind = Literal["package", "rollout", "recursion", "environment class", "solver", "sums of sums"]
FLAGGED = 3.0
_PACKAGES = frozenset(SIMULATORS) | {
    "brax",
    "gymnax",
    "pymunk",
    "jumanji",
    "mujoco_mjx",
    "envpool",
    "safety_gymnasium",
}
_HARMLESS = ("spaces",)
_SOLVERS = frozenset({"solve_ivp", "odeint", "ode", "RK45", "RK23", "DOP853", "LSODA", "odeint_adjoint"})
_FOLDS = frozenset({"reduce", "accumulate", "scan", "fori_loop", "while_loop"})
_MAX_STATES = 80

_CONSTANTS: dict[str, tuple[frozenset[float], int]] = {
    "gym/acrobot": (frozenset({12.566, 28.274, 9.8, 0.2, 0.5}), 4),
    "gym/continuouscar": (frozenset({0.0015, 0.0025, 0.07, 0.45, 1.2, 0.6}), 4),
    "gymnasium/parking-v0": (frozenset({0.0667, 0.2, 0.12, 0.3, 0.02, 2.5}), 4),
}
"""Numbers of an environment's dynamics, and how many of them together are no coincidence."""


class Sign(msgspec.Struct, frozen=True, kw_only=True):
    """One place that looks like a simulator."""

    kind: Kind
    points: float
    path: str
    """File in the bundle."""
    line: int
    end_line: int
    """1-based, inclusive."""
    reasons: tuple[str, ...]


def signs_of(code: Code) -> list[Sign]:
    """Every sign in a bundle, strongest first. Independent of the numbers in its code."""
    found: list[Sign] = []
    for part in code.parts:
        found += _packages(part)
        for scope in part.scopes:
            found += [
                _sign(part, kind, node, points, reasons)
                for points, kind, node, reasons in _judged(code, scope)
            ]
        for node in ast.walk(part.tree):
            if isinstance(node, ast.ClassDef):
                found += _environment_class(code, part, node)
    return sorted(found, key=lambda sign: (-sign.points, sign.path, sign.line))


def _sign(part: Part, kind: Kind, node: ast.AST, points: float, reasons: tuple[str, ...]) -> Sign:
    first, last = getattr(node, "lineno", 1), getattr(node, "end_lineno", None) or 1
    shift = part.first_line - 1
    return Sign(
        kind=kind, points=points, path=part.path, line=first + shift, end_line=last + shift, reasons=reasons
    )


# -- packages


def _packages(part: Part) -> Iterator[Sign]:
    texts = {
        t.id: _text(node.value, {})
        for node in part.tree.body
        if isinstance(node, ast.Assign)
        for t in node.targets
        if isinstance(t, ast.Name)
    }
    checked = {
        id(inner)
        for node in ast.walk(part.tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(part.tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif (
            isinstance(node, ast.Call)
            and called_name(node) in ("import_module", "__import__", "find_spec")
            and node.args
        ):
            names = [_text(node.args[0], texts)]
        for name in names:
            root, _, rest = name.partition(".")
            if root in _PACKAGES and rest.split(".")[0] not in _HARMLESS and id(node) not in checked:
                yield _sign(part, "package", node, FLAGGED, (f"imports {root}, which simulates",))


def _text(node: ast.expr, names: dict[str, str]) -> str:
    """A text assembled from pieces; empty if it cannot be determined."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.Name):
        return names.get(node.id, "")
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left, names) + _text(node.right, names)
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(v.value if isinstance(v, ast.FormattedValue) else v, names) for v in node.values)
    if (
        isinstance(node, ast.Call)
        and called_name(node) == "join"
        and node.args
        and isinstance(node.args[0], ast.List | ast.Tuple)
    ):
        return "".join(_text(part, names) for part in node.args[0].elts)
    if (
        isinstance(node, ast.Subscript)
        and isinstance(node.slice, ast.Slice)
        and "-1" in ast.unparse(node.slice)
    ):
        return _text(node.value, names)[::-1]
    return ""


# -- loops

_Judged = tuple[float, Kind, ast.AST, tuple[str, ...]]


def _judged(code: Code, scope: Scope) -> Iterator[_Judged]:
    for node in own_nodes(scope):
        try:
            if isinstance(node, ast.For | ast.AsyncFor | ast.While):
                yield from _loop(code, scope, node)
            elif isinstance(node, ast.ListComp | ast.GeneratorExp) and any(
                isinstance(n, ast.NamedExpr) for n in ast.walk(node)
            ):
                yield from _comprehension(code, scope, node)
            elif isinstance(node, ast.Call):
                yield from _fold(code, scope, node)
                yield from _solver(code, scope, node)
        except TooMuchError:
            continue
    if not isinstance(scope, ast.Module):
        try:
            yield from _recursion(code, scope)
        except TooMuchError:
            pass
        yield from _sums_of_sums(code, scope)


def _begin(code: Code, scope: Scope) -> Pass:
    return Pass(code, code.recorded.get(scope, set()))


def _loop(code: Code, scope: Scope, node: ast.For | ast.AsyncFor | ast.While) -> Iterator[_Judged]:
    run = _begin(code, scope)
    if isinstance(node, ast.While):
        run.tested.append(run.value(node.test))
    else:
        run.bind_loop(node.target, node.iter)
    run.run(node.body)
    yield from _verdict(code, scope, node, run)


def _comprehension(code: Code, scope: Scope, node: ast.ListComp | ast.GeneratorExp) -> Iterator[_Judged]:
    run = _begin(code, scope)
    generator = node.generators[0]
    run.bind_loop(generator.target, generator.iter)
    for test in generator.ifs:
        run.value(test)
    worth = run.value(node.elt)
    summed = any(
        isinstance(call, ast.Call)
        and called_name(call) in ("sum", "max", "min", "fsum")
        and node in call.args
        for call in own_nodes(scope)
    )
    if summed:
        run.sums.setdefault("sum()", []).append(worth)
        run.values["sum()"] = worth
    yield from _verdict(code, scope, node, run, sinks=frozenset({"sum()"}))


class _States:
    """The names that a loop carries from pass to pass, and their relations."""

    def __init__(self, run: Pass) -> None:
        self.new = dict(run.values)
        roots = {key for key in self.new if "." not in key}
        self.carried = set[str]()
        self.edges: dict[str, set[str]] = {}
        self.bent: dict[str, set[str]] = {}
        for key, flow in self.new.items():
            self.edges[key] = {self._name(dep, roots) for dep in flow.deps} & set(self.new)
            self.bent[key] = {self._name(dep, roots) for dep in flow.bent} & set(self.new)
        for key in self.new:
            if any(key in self.edges[other] for other in self.new):
                self.carried.add(key)
        self.sums = {
            key
            for key in run.sums
            if key in self.new
            and key not in run.stored_otherwise
            and not any(
                key in self.edges[other] for other in self.carried if other != key and other not in run.sums
            )
            and not any(key in {self._name(d, roots) for d in flow.deps} for flow in run.sums[key])
        }
        """Sums that only they themselves depend on."""
        self.states = self._cycles() - self.sums

    @staticmethod
    def _name(dep: str, roots: set[str]) -> str:
        root = dep.split(".")[0]
        return root if root in roots else dep

    def _cycles(self) -> set[str]:
        """Names whose new value depends, through any other names, on their own old value, with a nonlinear step on
        the way."""
        names = sorted(self.carried)[:_MAX_STATES]
        reach: dict[str, set[str]] = {}
        for name in names:
            seen, queue = set[str](), [name]
            while queue:
                for nearer in self.edges[queue.pop()]:
                    if nearer not in seen:
                        seen.add(nearer)
                        queue.append(nearer)
            reach[name] = seen
        found = set[str]()
        for name in names:
            circle = {other for other in reach[name] if name in reach.get(other, ())}
            if name in circle and any(
                self.bent[one] & circle or self._looked(one) & circle for one in circle
            ):
                found.add(name)
        return found

    def _looked(self, name: str) -> frozenset[str]:
        """Names used as an index of a table together with a choice: `after[state, action]`."""
        flow = self.new[name]
        return flow.looked if flow.chosen else frozenset()


def _verdict(
    code: Code, scope: Scope, node: ast.AST, run: Pass, sinks: frozenset[str] = frozenset()
) -> Iterator[_Judged]:
    found = _States(run)
    states = found.states - sinks
    if not states or run.asks or any(found.new[name].fresh for name in states):
        return
    reasons = [
        f"{_listed(states)} follow{'s' * (len(states) == 1)} from {'its' if len(states) == 1 else 'their'} own value a pass before"
    ]
    points = 1.0
    tried = _tries_candidates(code, scope, node)
    if any(found.new[name].chosen for name in states):
        points += 1.0
        reasons.append("a decision or a plan's item enters")
    elif tried:
        points += 1.0
        reasons.append("one of several candidates enters")
    worth = _objective(scope, node, run, found, states, tried)
    if worth is not None:
        points += worth[0]
        reasons.append(worth[1])
    depended = {dep for name in states for dep in found.edges[name]} & found.carried
    if len(states) > 1 or len(depended - found.sums) > 1:
        points += 0.5
        reasons.append("several of them hang together")
    yield points, "rollout", node, tuple(reasons)


def _listed(names: set[str]) -> str:
    shown = sorted(names)[:4]
    return ", ".join(shown) + (" …" if len(names) > 4 else "")


def _touches(flow: Flow, states: set[str]) -> bool:
    return any(dep in states or dep.split(".")[0] in states for dep in flow.deps)


def _objective(
    scope: Scope, node: ast.AST, run: Pass, found: _States, states: set[str], tried: bool
) -> tuple[float, str] | None:
    for name in sorted(found.sums):
        for flow in run.sums[name]:
            if _touches(flow, states) and not flow.asked and not flow.fresh and _used(scope, node, name):
                return 1.0, f"{name} sums up what comes of it"
    if run.queued:
        return 1.0, "a queue orders what comes of it"
    if any(_touches(flow, states) for flow in run.exchanged):
        return 1.0, "each pass hands out what comes of it and takes in an answer"
    if any(_touches(test, states) for test in run.tested):
        counted = {name for name in found.sums if not any(flow.deps for flow in run.sums[name])}
        if isinstance(node, ast.For) and isinstance(node.target, ast.Name):
            counted.add(node.target.id)
        if any(_returned(scope, name) for name in counted):
            return (1.0 if tried else 0.5), "the number of passes until a condition on them is the result"
    if tried and not isinstance(scope, ast.Module) and _used_at_end(scope, states):
        return 0.5, "the function's result follows from their last values"
    return None


def _used(scope: Scope, loop: ast.AST, name: str) -> bool:
    """Whether a sum is read outside its loop, returned from it, or belongs to an object."""
    if "." in name or name == "sum()":
        return True
    inside = {id(n) for n in ast.walk(loop)}
    stored = any(isinstance(n, ast.Name) and n.id == name for n in own_nodes(scope, lambdas=True))
    read = any(
        isinstance(n, ast.Name) and n.id == name and isinstance(n.ctx, ast.Load) and id(n) not in inside
        for n in own_nodes(scope, lambdas=True)
    )
    return read or not stored or _returned(scope, name)


def _returned(scope: Scope, name: str) -> bool:
    last = name.split(".")[-1]
    return any(
        (isinstance(inner, ast.Name) and inner.id == name)
        or (isinstance(inner, ast.Attribute) and inner.attr == last and "." in name)
        for node in own_nodes(scope)
        if isinstance(node, ast.Return | ast.Yield) and node.value is not None
        for inner in ast.walk(node.value)
    )


def _used_at_end(scope: Scope, states: set[str]) -> bool:
    return any(
        isinstance(inner, ast.Name) and inner.id in states
        for node in own_nodes(scope)
        if isinstance(node, ast.Return) and node.value is not None and not isinstance(node.value, ast.Name)
        for inner in ast.walk(node.value)
    )


def _tries_candidates(code: Code, scope: Scope, node: ast.AST) -> bool:
    """Whether the loop runs for each of several candidates, of which one is selected."""
    if not isinstance(scope, ast.Module) and scope in code.selected:
        return True
    outer = (
        loop
        for loop in own_nodes(scope)
        if isinstance(loop, ast.For) and loop is not node and any(inner is node for inner in ast.walk(loop))
    )
    return any(True for _ in outer) and any(selects(n) for n in own_nodes(scope, lambdas=True))


# -- other forms of a loop


def _fold(code: Code, scope: Scope, call: ast.Call) -> Iterator[_Judged]:
    """`reduce` and similar functions: the first parameter of the passed function is the state."""
    if called_name(call) not in _FOLDS or not call.args:
        return
    for argument in call.args[:3]:
        functions: list[Function] = [argument] if isinstance(argument, ast.Lambda) else []
        if isinstance(argument, ast.Name):
            functions = code.functions.get(argument.id, [])
        for function in functions:
            parameters = parameters_of(function)
            if len(parameters) < 2:
                continue
            run = _begin(code, function)
            run.values |= {name: Flow(frozenset({"@item"}), chosen=True) for name in parameters[1:]}
            body = function.body if isinstance(function, ast.Lambda) else None
            if body is not None:
                after = run.value(body)
            else:
                run.run(function.body)  # type: ignore[arg-type]
                after = join(run.returned)
            if parameters[0] not in after.bent:
                continue
            points, reasons = (
                1.0,
                [
                    f"{called_name(call)} makes {parameters[0]} from {parameters[0]} and an item, again and again"
                ],
            )
            if "@item" in after.deps:
                points += 1.0
                reasons.append("a plan's item enters")
            if not isinstance(scope, ast.Module) and scope in code.selected:
                points += 1.0
                reasons.append("one of several candidates is chosen by what comes of it")
            yield points, "rollout", call, tuple(reasons)
            return


def _solver(code: Code, scope: Scope, call: ast.Call) -> Iterator[_Judged]:
    if called_name(call) in _SOLVERS:
        tried = not isinstance(scope, ast.Module) and scope in code.selected
        reasons = (f"{called_name(call)} integrates equations of motion",)
        yield (
            (FLAGGED, "solver", call, (*reasons, "one of several candidates is chosen by what comes of it"))
            if tried
            else (2.0, "solver", call, reasons)
        )


def _recursion(code: Code, function: Function) -> Iterator[_Judged]:
    if isinstance(function, ast.Lambda):
        return
    parameters = set(parameters_of(function))
    for node in own_nodes(function, lambdas=True):
        if not isinstance(node, ast.Call) or called_name(node) != function.name:
            continue
        run = _begin(code, function)
        choices = [n for n in own_nodes(function) if isinstance(n, ast.For | ast.GeneratorExp | ast.ListComp)]
        over = [c for c in choices if any(inner is node for inner in ast.walk(c))]
        flow = join(run.value(a.value if isinstance(a, ast.Starred) else a) for a in node.args)
        bent = {dep for dep in flow.bent if dep in parameters}
        if not bent:
            continue
        points, reasons = 1.0, [f"{function.name} calls itself with what follows from {_listed(bent)}"]
        if over:
            points += 1.0
            reasons.append("for each of several choices")
        returns = [n for n in own_nodes(function) if isinstance(n, ast.Return) and n.value is not None]
        if any(_weighs(statement.value, node) for statement in returns if statement.value is not None) or (
            over and _selects(function)
        ):
            points += 1.0
            reasons.append("and adds up or compares what comes of it")
        yield points, "recursion", function, tuple(reasons)
        return


def _weighs(value: ast.expr, call: ast.Call) -> bool:
    """Whether an expression adds to, or compares, the result of `call`."""
    for node in ast.walk(value):
        if (isinstance(node, ast.BinOp) or selects(node)) and any(inner is call for inner in ast.walk(node)):
            return True
    return False


def _selects(function: Function) -> bool:
    return any(selects(node) for node in own_nodes(function, lambdas=True))


def _sums_of_sums(code: Code, function: Scope) -> Iterator[_Judged]:
    """Speeds as the cumulative sum of accelerations, and places as that of speeds: a rollout without a loop."""
    summed: set[str] = set()
    statements = [n for n in own_nodes(function) if isinstance(n, ast.Assign)]
    for statement in sorted(statements, key=lambda n: n.lineno):
        calls = [
            n
            for n in ast.walk(statement.value)
            if isinstance(n, ast.Call) and called_name(n) in ("cumsum", "cumulative_sum")
        ]
        inner = {n.id for call in calls for n in ast.walk(call) if isinstance(n, ast.Name)}
        nested = any(
            isinstance(n, ast.Call) and n is not call and called_name(n) == "cumsum"
            for call in calls
            for n in ast.walk(call)
        )
        if calls and (nested or inner & summed):
            chosen = any(selects(n) for n in own_nodes(function, lambdas=True)) or function in code.selected
            yield (
                FLAGGED if chosen else 2.0,
                "sums of sums",
                statement,
                (
                    "integrates twice by cumulative sums",
                    *(["one of several candidates is chosen"] if chosen else []),
                ),
            )
        if calls:
            summed |= {n.id for t in statement.targets for n in ast.walk(t) if isinstance(n, ast.Name)}


# -- classes


def _environment_class(code: Code, part: Part, node: ast.ClassDef) -> Iterator[Sign]:
    """A class that answers each choice with several values, one of them a score, and that can be reset."""
    methods = [m for m in node.body if isinstance(m, ast.FunctionDef)]
    if any(method.name == "act" for method in methods):
        return  # a policy: its own state and its observations
    for method in methods:
        parameters = parameters_of(method)
        if len(parameters) < 2 or method.name in ("act", "__init__"):
            continue
        matches = [
            n.value for n in own_nodes(method) if isinstance(n, ast.Return) and isinstance(n.value, ast.Tuple)
        ]
        if not any(len(answer.elts) >= 2 for answer in matches):
            continue
        run = _begin(code, method)
        try:
            run.run(method.body)
        except TooMuchError:
            continue
        own = parameters[0]
        changed = {key: flow for key, flow in run.values.items() if key.startswith(f"{own}.")}
        states = {
            key
            for key, flow in changed.items()
            if any(dep.startswith(f"{own}.") for dep in flow.deps) and key not in _counters(run)
        }
        moved = {k for k in states if set(parameters[1:]) & changed[k].deps or changed[k].chosen}
        again = [
            other
            for other in methods
            if other is not method
            and {
                _attribute(t, own)
                for n in own_nodes(other)
                if isinstance(n, ast.Assign)
                for x in n.targets
                for t in ast.walk(x)
            }
            & states
            and other.name != "__init__"
        ]
        if not moved or not again:
            continue
        if not any(_is_number_and_end(answer) for answer in matches):
            continue
        bent = any(dep.startswith(f"{own}.") for key in states for dep in changed[key].bent)
        reasons = [
            f"{node.name}.{method.name} makes {_listed(states)} from {'their' if len(states) > 1 else 'its'} own value and its argument",
            "answers with several values, one of them an end",
            f"{again[0].name} begins again",
        ]
        looped = _called_in_loop(code, method.name)
        points = 2.0 + (1.0 if bent else 0.0) + (1.0 if looped else 0.0)
        if looped:
            reasons.append("is called in a loop")
        yield _sign(part, "environment class", method, points, tuple(reasons))


def _counters(run: Pass) -> set[str]:
    return {key for key, flows in run.sums.items() if not any(flow.deps for flow in flows)}


def _attribute(node: ast.AST, own: str) -> str:
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == own:
        return f"{own}.{node.attr}"
    return ""


def _is_number_and_end(answer: ast.Tuple) -> bool:
    """Whether the answer has at least two values besides the observation: a score and an end flag."""
    return len(answer.elts) >= 3


def _called_in_loop(code: Code, name: str) -> bool:
    for part in code.parts:
        for node in ast.walk(part.tree):
            if isinstance(node, ast.For | ast.While):
                for inner in ast.walk(node):
                    if isinstance(inner, ast.Call) and called_name(inner) == name and inner.args:
                        return True
    return False


# -- numbers


def with_numbers(sign: Sign, source: bytes, env: str) -> Sign:
    """Adds half a point if the sign's file has too many numbers of the environment's dynamics for a coincidence."""
    if not FLAGGED - 0.5 <= sign.points < FLAGGED or env not in _CONSTANTS:
        return sign
    numbers, enough = _CONSTANTS[env]
    found = set[float]()
    tree = parse(source)
    for node in ast.walk(tree) if tree is not None else ():
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, int | float)
            and not isinstance(node.value, bool)
        ):
            found |= {n for n in numbers if abs(abs(node.value) - n) < 1e-3 * n}
        elif (
            isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult) and "pi" in ast.unparse(node.right)
        ):
            left = node.left.value if isinstance(node.left, ast.Constant) else None
            if isinstance(left, int | float):
                found |= {n for n in numbers if abs(left * 3.14159 - n) < 1e-3 * n}
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            sides = [s.value if isinstance(s, ast.Constant) else None for s in (node.left, node.right)]
            if all(isinstance(s, int | float) and s for s in sides):
                found |= {n for n in numbers if abs(sides[0] / sides[1] - n) < 1e-3}  # type: ignore[operator]
    if len(found) < enough:
        return sign
    reason = f"the file has {len(found)} numbers of this environment's dynamics"
    return msgspec.structs.replace(sign, points=sign.points + 0.5, reasons=(*sign.reasons, reason))
