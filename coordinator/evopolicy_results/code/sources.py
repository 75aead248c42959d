"""The policy source bundle: `policy.py` and the local modules that it can reach by imports.

This is the boundary of the paper's code diagnostics (mechanism section, Table "Realized computational structure"): it
excludes modules that nothing imports, data files and learned weights. Files are read as bytes and never imported or
executed; unparseable files are kept as opaque bytes.

Differences of sources have a bound on the work, as a policy's author may choose lines that are all alike: beyond
`MAX_STEPS` the sources count as entirely different.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from evopolicy_common.processes.left_files import left_files
from evopolicy_common.records.code_metrics import parse
from evopolicy_common.regular_files import read_regular

MAX_FILE_BYTES = 1 << 20
"""Larger Python files are not parsed: they are data in disguise, and would stall a report."""

MAX_FILES = 400

_MAX_KEPT_BYTES = 1 << 20
"""Sources whose trees are kept: a tree takes about a hundred times the memory."""
_kept: dict[bytes, tuple[ast.AST, ...]] = {}


def parsed(source: bytes) -> tuple[ast.AST, ...]:
    """All nodes of a Python source, its module first, breadth first; none if it cannot be parsed. The latest trees are
    kept, as several passes read each source and most checkpoints share sources."""
    nodes = _kept.pop(source, None)
    if nodes is None:
        tree = parse(source)
        nodes = () if tree is None else tuple(ast.walk(tree))
    _kept[source] = nodes
    while sum(map(len, _kept)) > _MAX_KEPT_BYTES:
        del _kept[next(iter(_kept))]
    return nodes


def read_python_files(system_dir: Path) -> dict[str, bytes]:
    """Regular Python files under a checkpoint's `system/`, by relative path with `/`, sorted: at most `MAX_FILES`,
    each at most `MAX_FILE_BYTES`. Raises OSError when the folder cannot be read."""
    if not system_dir.is_dir():
        raise FileNotFoundError(f"folder {system_dir} not found")
    files = left_files(system_dir, enter=lambda name: name != "__pycache__" and not name.startswith("."))
    sources = (path for path, size in files if path.name.endswith(".py") and size <= MAX_FILE_BYTES)
    read = {
        path.relative_to(system_dir).as_posix(): read_regular(path) for path in islice(sources, MAX_FILES)
    }
    return dict(sorted(read.items()))


class Module(NamedTuple):
    name: str
    path: str
    source: bytes
    nodes: tuple[ast.AST, ...]
    """As `parsed` gives them; none if the source cannot be parsed."""

    @property
    def imports(self) -> list[ast.Import | ast.ImportFrom]:
        """Every import statement, also inside functions."""
        return [node for node in self.nodes if isinstance(node, ast.Import | ast.ImportFrom)]


def reachable_modules(files: Mapping[str, bytes]) -> dict[str, Module]:
    """Modules reachable from `policy.py` by any import, also inside functions or by a literal `import_module("x")`, by
    dotted name. A package includes its `__init__`. Empty without a `policy.py`."""
    by_name = {_module_name(path): path for path in files}
    depth = 1 + max((name.count(".") for name in by_name), default=0)
    modules: dict[str, Module] = {}
    queue = ["policy"]
    while queue:
        name = queue.pop()
        path = by_name.get(name)
        if path is None or name in modules:
            continue
        module = modules[name] = Module(name, path, files[path], parsed(files[path]))
        for target in _imported(module, path.endswith("__init__.py")):
            # The prefixes of a dotted name with at most `depth` parts: `import a.a.a…` may have any number.
            parts = target.split(".", depth)[:depth]
            queue += [".".join(parts[: i + 1]) for i in range(len(parts))]
    return dict(sorted(modules.items()))


def source_digest(modules: Mapping[str, Module]) -> str:
    """SHA-256 over the paths and bytes of the reachable modules: equal digests mean a byte-identical source bundle."""
    digest = hashlib.sha256()
    for module in modules.values():
        for part in (module.path.encode(), module.source):
            digest.update(len(part).to_bytes(8, "big"))
            digest.update(part)
    return digest.hexdigest()


def _module_name(path: str) -> str:
    parts = path.removesuffix(".py").split("/")
    if parts[-1] == "__init__" and len(parts) > 1:
        parts.pop()
    return ".".join(parts)


def _imported(module: Module, is_package: bool) -> set[str]:
    targets: set[str] = set()
    for statement in module.imports:
        if isinstance(statement, ast.Import):
            targets.update(alias.name for alias in statement.names)
        else:
            base = absolute_import(statement, module.name, is_package)
            if base:
                targets.add(base)
            targets.update(f"{base}.{alias.name}" if base else alias.name for alias in statement.names)
    if b"import_module" in module.source or b"__import__" in module.source:
        targets.update(filter(None, map(called_import, module.nodes)))
    return targets


def called_import(node: ast.AST) -> str:
    """The literal of `import_module("x")` or `__import__("x")`; empty for any other node."""
    match node:
        case ast.Call(
            func=ast.Attribute(attr="import_module" | "__import__")
            | ast.Name(id="import_module" | "__import__"),
            args=[ast.Constant(value=str(name)), *_],
        ):
            return name
    return ""


def absolute_import(node: ast.ImportFrom, name: str, is_package: bool) -> str:
    """The dotted module that a `from … import` in module `name` refers to; empty for the top level itself."""
    if not node.level:
        return node.module or ""
    package = name.split(".") if is_package else name.split(".")[:-1]
    up = node.level - 1
    base = package[: len(package) - up] if up <= len(package) else []
    return ".".join([*base, *([node.module] if node.module else [])])


MAX_STEPS = 3_000_000
"""Maximum number of compared pairs of equal lines: about a second."""
_CONTEXT = 3


class _TooAlikeError(Exception):
    """The lines repeat so often that comparing them would take too long."""


class _Matcher(difflib.SequenceMatcher[Hashable]):
    def __init__(self, old: Sequence[Hashable], new: Sequence[Hashable]) -> None:
        self._steps = MAX_STEPS
        self._old = old
        super().__init__(None, old, new, autojunk=False)

    def find_longest_match(
        self, alo: int = 0, ahi: int | None = None, blo: int = 0, bhi: int | None = None
    ) -> difflib.Match:
        places: dict[Hashable, list[int]] = self.b2j  # type: ignore[attr-defined]
        end = len(self._old) if ahi is None else ahi
        self._steps -= sum(1 + len(places.get(self._old[i], ())) for i in range(alo, end))
        if self._steps < 0:
            raise _TooAlikeError
        return super().find_longest_match(alo, ahi, blo, bhi)


def n_changed(old: Sequence[object], new: Sequence[object]) -> int:
    """Number of lines removed plus lines added."""
    for _ in range(2):  # without equal lines at the beginning, then at the end
        unequal = (i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
        head = next(unequal, min(len(old), len(new)))
        old, new = old[head:][::-1], new[head:][::-1]
    try:
        kept = sum(block.size for block in _Matcher(old, new).get_matching_blocks())
    except _TooAlikeError:
        kept = (Counter(old) & Counter(new)).total()
    return len(old) + len(new) - 2 * kept


def unified(old: Sequence[str], new: Sequence[str]) -> list[str]:
    """A unified diff with three lines of context, without the two lines that name the files."""
    try:
        groups = list(_Matcher(old, new).get_grouped_opcodes(_CONTEXT))
    except _TooAlikeError:
        groups = [[("replace", 0, len(old), 0, len(new))]]
    out: list[str] = []
    for group in groups:
        (_, first_old, _, first_new, _), (_, _, last_old, _, last_new) = group[0], group[-1]
        out.append(f"@@ -{_range(first_old, last_old)} +{_range(first_new, last_new)} @@")
        for tag, a, b, c, d in group:
            if tag == "equal":
                out += [f" {line}" for line in old[a:b]]
                continue
            out += [f"-{line}" for line in old[a:b]]
            out += [f"+{line}" for line in new[c:d]]
    return out


def _range(start: int, stop: int) -> str:
    """A range of lines as in `diff -u`."""
    length = stop - start
    return str(start + 1) if length == 1 else f"{start + 1 if length else start},{length}"
