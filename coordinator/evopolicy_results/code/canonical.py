"""A hash of a bundle's units that is independent of the bundle's own names, and of the order and module of its
definitions.

Names are made canonical in three steps. Names local to a function are numbered by first use in it. A reference to
another definition is replaced by that definition's own label, refined over a few rounds (Weisfeiler and Leman's
colour refinement), so that calling another helper is a change and renaming one is not. Attributes and globals are
then numbered by first use over the units in label order.
"""

from __future__ import annotations

import hashlib

import msgspec

_ROUNDS = 3
PROTOCOL_NAMES = frozenset({"Policy", "act", "reset"})
"""Names defined by the contract, not by the bundle: never made canonical."""

Token = str | tuple[str, str]
"""Text, or a name with its kind: `n` bare name, `a` attribute, `m` attribute of a local module, `k` keyword."""


class Names(msgspec.Struct):
    """Every name that the bundle defines, over all its modules."""

    top_defs: set[str] = set()
    method_defs: set[str] = set()
    global_names: set[str] = set()
    attribute_names: set[str] = set()
    parameters: set[str] = set()


class Scope(msgspec.Struct):
    """The names that one module's import statements bind."""

    external: dict[str, str] = {}
    modules: set[str] = set()
    aliases: dict[str, str] = {}


class Unit(msgspec.Struct):
    """One function, class or statement of a module or class body: its tokens, and the names that it binds."""

    module: Scope
    name: str
    is_function: bool
    tokens: list[Token] = []
    children: list[Unit] = []
    stored: set[str] = set()
    globals: set[str] = set()


def stable_hash(parts: list[str]) -> str:
    """A hash that is the same in every process."""
    return hashlib.blake2b("\x1f".join(parts).encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()


def canonical(units: list[Unit], names: Names) -> str:
    """One hash of the units: equal for equal structure, independent of the bundle's names and order."""
    every: list[Unit] = []

    def collect(some: list[Unit]) -> None:
        for unit in some:
            every.append(unit)
            collect(unit.children)

    collect(units)
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
        for i in reversed(range(len(every))):  # a class precedes its children, and its label includes theirs
            if turn and not references[i] and not every[i].children:
                continue
            for at, name in references[i]:
                texts[i][at] = "d" + labels.get(name, "")
            own[i] = stable_hash([*texts[i], *sorted(own[place[id(child)]] for child in every[i].children)])
        by_name: dict[str, list[str]] = {}
        for unit, label in zip(every, own, strict=True):
            if unit.name:
                by_name.setdefault(unit.name, []).append(label)
        labels = {name: stable_hash(sorted(several)) for name, several in by_name.items()}
    order = sorted(range(len(every)), key=lambda i: own[i])
    shared: dict[tuple[str, str], str] = {}
    final = {id(every[i]): stable_hash(_numbered(resolved[i], labels, shared)) for i in order}

    def fold(unit: Unit) -> str:
        return stable_hash([final[id(unit)], *sorted(map(fold, unit.children))])

    return stable_hash(sorted(map(fold, units)))


def _resolve(unit: Unit, names: Names) -> list[Token]:
    """Tokens whose names are marked local (`l`), definition (`d`), global (`g`), attribute (`a`), or plain text."""
    local = unit.stored - unit.globals if unit.is_function else frozenset()
    scope = unit.module

    def resolved(token: Token) -> Token:
        if isinstance(token, str):
            return token
        kind, name = token
        if kind == "a":
            if name in names.method_defs and name not in PROTOCOL_NAMES and not name.startswith("__"):
                return "d", name
            return ("a", name) if name in names.attribute_names else name
        if kind == "k":
            return ("k", name) if name in names.parameters else name
        if kind == "n" and name in local:
            return "l", name
        if kind == "n" and name in scope.external:
            return scope.external[name]
        target = scope.aliases.get(name, name)
        if target in names.top_defs:
            return "d", target
        if target in names.global_names:
            return "g", target
        return ("a", target) if target in names.attribute_names and not unit.is_function else target

    return list(map(resolved, unit.tokens))


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
