"""A hash of a bundle's units that is independent of the bundle's own names, and of the order and module of its
definitions.

Names are made canonical in three steps. Names local to a function are numbered by first use in it. A reference to
another definition is replaced by that definition's own label, refined over a few rounds (Weisfeiler and Leman's
colour refinement), so that calling another helper is a change and renaming one is not. Attributes and globals are
then numbered by first use over the units in label order.
"""

from __future__ import annotations

import hashlib

_ROUNDS = 3
PROTOCOL_NAMES = frozenset({"Policy", "act", "reset"})
"""Names defined by the contract, not by the bundle: never made canonical."""

Token = str | tuple[str, str]
"""Text, or a name with its kind: `n` bare name, `a` attribute, `m` attribute of a local module, `k` keyword."""


class Names:
    """Every name that the bundle defines, over all its modules."""

    def __init__(self) -> None:
        self.top_defs: set[str] = set()
        self.method_defs: set[str] = set()
        self.global_names: set[str] = set()
        self.attribute_names: set[str] = set()
        self.parameters: set[str] = set()


class Scope:
    """The names that one module's import statements bind."""

    def __init__(self) -> None:
        self.external: dict[str, str] = {}
        self.modules: set[str] = set()
        self.aliases: dict[str, str] = {}


class Unit:
    """One function, class or statement of a module or class body: its tokens, and the names that it binds."""

    __slots__ = ("children", "globals", "is_function", "module", "name", "stored", "tokens")

    def __init__(self, module: Scope, name: str, is_function: bool) -> None:
        self.module = module
        self.name = name
        self.is_function = is_function
        self.tokens: list[Token] = []
        self.children: list[Unit] = []
        self.stored: set[str] = set()
        self.globals: set[str] = set()


def stable_hash(parts: list[str]) -> str:
    """A hash that is the same in every process."""
    return hashlib.blake2b("\x1f".join(parts).encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()


def canonical(units: list[Unit], names: Names) -> str:
    """One hash of the units: equal for equal structure, independent of the bundle's names and order."""
    every: list[Unit] = []
    queue = list(reversed(units))
    while queue:
        unit = queue.pop()
        every.append(unit)
        queue.extend(reversed(unit.children))
    resolved = [_resolve(unit, names) for unit in every]
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
        ):  # a class precedes its children, and its label includes theirs
            if turn and not references[i] and not every[i].children:
                continue
            for at, name in references[i]:
                texts[i][at] = "d" + labels.get(name, "")
            own[i] = stable_hash([*texts[i], *sorted(own[place[id(child)]] for child in every[i].children)])
        by_name: dict[str, list[str]] = {}
        for unit, label in zip(every, own, strict=True):
            if unit.name:
                by_name.setdefault(unit.name, []).append(label)
        labels = {name: stable_hash(sorted(found)) for name, found in by_name.items()}
    order = sorted(range(len(every)), key=lambda i: own[i])
    shared: dict[tuple[str, str], str] = {}
    final = {id(every[i]): stable_hash(_numbered(resolved[i], labels, shared)) for i in order}

    def fold(unit: Unit) -> str:
        return stable_hash([final[id(unit)], *sorted(fold(child) for child in unit.children)])

    return stable_hash(sorted(fold(unit) for unit in units))


def _resolve(unit: Unit, names: Names) -> list[Token]:
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
            if name in names.method_defs and name not in PROTOCOL_NAMES and not name.startswith("__"):
                out.append(("d", name))
            else:
                out.append(("a", name) if name in names.attribute_names else name)
            continue
        if kind == "k":
            out.append(("k", name) if name in names.parameters else name)
            continue
        if kind == "n" and name in local:
            out.append(("l", name))
            continue
        target = scope.aliases.get(name, name)
        if kind == "n" and name in scope.external:
            out.append(scope.external[name])
        elif target in names.top_defs:
            out.append(("d", target))
        elif target in names.global_names:
            out.append(("g", target))
        elif target in names.attribute_names and not unit.is_function:
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
