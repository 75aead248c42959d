"""`metrics.json`: size and branching of a policy's source, by the published definitions. No code is run.

Sources come from an agent, so the work is bounded. A file counts as unparsable beyond `MAX_PARSED_BYTES` of Python
source in one policy, and where the parser's memory would grow with the square of its length.
"""

from __future__ import annotations

import ast
import gc
import hashlib
import re
import threading
import warnings
from collections.abc import Mapping
from pathlib import PurePosixPath

import msgspec

PUBLISHED_SCHEMA = "0.1"
"""`schema_version` of the published software's files and of ours, which extend their fields."""
MAX_PARSED_BYTES = 8 << 20
_UNCOUNTED_NAMES = frozenset({".keep", "_meta.json", "metrics.json"})
_UNCOUNTED_FOLDERS = frozenset({"__pycache__", ".pytest_cache", ".mypy_cache", ".ruff_cache"})

# CPython's parser copies every prefix of `a.a.a…`: gigabytes for an import of fifty thousand parts.
_ENDLESS_NAME = re.compile(rb"\b(?:\w++[ \t\f\r\n\\]*+\.[ \t\f\r\n\\]*+){100}")

_PARSING = threading.Lock()
"""Python 3.11 counts the depth of the tree that it builds once for all threads. A collection of garbage may let another
thread run and parse in between, and both fail with SystemError: no parse is interrupted by a collection."""


class CodeMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `metrics.json`."""

    schema_version: str = PUBLISHED_SCHEMA
    files: int
    python_files: int
    bytes: int
    """Size of all files."""
    policy_bytes: int
    """Size of `policy.py`; 0 without one."""
    lines: int
    """Lines of the Python files."""
    source_lines: int
    """Lines that are neither blank nor start with `#`."""
    classes: int
    functions: int
    imports: tuple[str, ...]
    """Top-level names of absolute imports, sorted."""
    import_count: int
    cyclomatic_total: int
    """Sum over all functions, nested ones counted in their parents too; without functions, the module's value."""
    cyclomatic_max: int
    parse_errors: tuple[str, ...]
    """Paths of the Python files that cannot be parsed."""
    test_files: int
    """Python files whose name starts with `test_`."""
    tree_hash: str
    """`sha256:` of the concatenation, over all files in path order, of path, NUL, bytes, NUL."""


TREND = (
    "source_lines",
    "python_files",
    "functions",
    "classes",
    "cyclomatic_total",
    "cyclomatic_max",
    "tree_hash",
)
"""Fields that `code_metrics_trend` follows over the submits."""


def code_metrics(files: Mapping[str, bytes]) -> CodeMetrics:
    """The metrics of a policy's files, given by their path relative to `system/`."""
    counted = {path: data for path, data in sorted(files.items()) if _counts(PurePosixPath(path))}
    sources = {
        path: data.decode("utf-8", "replace") for path, data in counted.items() if path.endswith(".py")
    }
    lines = [line.strip() for text in sources.values() for line in text.splitlines()]
    shapes: list[_Shape] = []
    errors: list[str] = []
    remaining = MAX_PARSED_BYTES
    for path, text in sources.items():
        remaining -= len(counted[path])
        tree = parse(text) if remaining >= 0 else None
        if tree is None:
            errors.append(path)
        else:
            shapes.append(_Shape(tree))
    complexities = [each for shape in shapes for each in shape.complexities]
    imports = sorted({name for shape in shapes for name in shape.imports})
    tree_hash = hashlib.sha256()
    for path, data in counted.items():
        tree_hash.update(path.encode() + b"\0" + data + b"\0")
    return CodeMetrics(
        files=len(counted),
        python_files=len(sources),
        bytes=sum(map(len, counted.values())),
        policy_bytes=len(counted.get("policy.py", b"")),
        lines=len(lines),
        source_lines=sum(1 for line in lines if line and not line.startswith("#")),
        classes=sum(shape.classes for shape in shapes),
        functions=sum(shape.functions for shape in shapes),
        imports=tuple(imports),
        import_count=len(imports),
        cyclomatic_total=sum(complexities),
        cyclomatic_max=max(complexities, default=0),
        parse_errors=tuple(errors),
        test_files=sum(PurePosixPath(path).name.startswith("test_") for path in sources),
        tree_hash=f"sha256:{tree_hash.hexdigest()}",
    )


def parse(source: bytes | str) -> ast.Module | None:
    """The module's tree; None when this Python cannot parse it, or only with memory quadratic in its length."""
    data = source if isinstance(source, bytes) else source.encode()
    if _ENDLESS_NAME.search(data) is not None:
        return None
    with _PARSING, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        collects = gc.isenabled()
        gc.disable()
        try:
            return ast.parse(source)
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            return None
        finally:
            if collects:
                gc.enable()


def _counts(path: PurePosixPath) -> bool:
    return path.name not in _UNCOUNTED_NAMES and _UNCOUNTED_FOLDERS.isdisjoint(path.parts[:-1])


class _Shape:
    """The counts of one module, from one walk. The walk keeps its own stack: an agent's code may nest without bound."""

    def __init__(self, tree: ast.Module) -> None:
        self.classes = self.functions = 0
        self.imports: set[str] = set()
        self.complexities: list[int] = []
        """Complexity of each function; of the module if it has none."""
        points = 0
        # A function's points are those found between its start and its end.
        stack: list[tuple[ast.AST, int | None]] = [(tree, None)]
        while stack:
            node, before = stack.pop()
            if before is not None:
                self.complexities.append(1 + points - before)
                continue
            points += _points(node)
            self.classes += isinstance(node, ast.ClassDef)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                self.functions += 1
                stack.append((node, points))
            elif isinstance(node, ast.Import):
                self.imports.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                self.imports.add(node.module.partition(".")[0])
            stack += [(child, None) for child in ast.iter_child_nodes(node)]
        if not self.functions:
            self.complexities = [1 + points]


def _points(node: ast.AST) -> int:
    """The part of its function's complexity that a node adds."""
    match node:
        case ast.If() | ast.For() | ast.AsyncFor() | ast.While() | ast.IfExp() | ast.ExceptHandler():
            return 1
        case ast.BoolOp():
            return len(node.values) - 1
        case ast.Try() | ast.TryStar():
            return len(node.handlers)
        case ast.comprehension():
            return len(node.ifs)
        case ast.Match():
            return len(node.cases)
    return 0
