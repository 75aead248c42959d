"""Files of this machine that an agent's program needs: its installation, the interpreter of its first line, our Python.

A whole folder is shown only if it is an installation of its own by its marks; otherwise only the file.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shlex
import shutil
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from pathlib import Path

from evopolicy_common.processes.packages import SIMULATORS, files_of

SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32")
"""Folders visible in every jail."""

_HIDDEN = frozenset((*SIMULATORS, "evopolicy_worker", "evopolicy_coordinator", "evopolicy_results"))
"""Packages that no agent may see, in any Python installation."""

_INSTALLATION_MARKS = ("pyvenv.cfg", "lib", "libexec", "node_modules")
_SITE_FOLDERS = ("site-packages", "dist-packages")
_MAX_LINKS = 16
_SHEBANG_BYTES = 512


class Needs:
    """Paths to show read-only: files and folders as they are, and links as links."""

    def __init__(self) -> None:
        self.paths: dict[str, None] = {}
        self.links: dict[str, str] = {}
        """Path of each link to its target."""

    def path(self, path: str) -> None:
        if not _in_system(path) and os.path.exists(path):
            self.paths[path] = None

    def link(self, path: str) -> None:
        if not _in_system(path):
            self.links[path] = os.readlink(path)


def needs_of(command: Sequence[str], search: str | None, more: Sequence[Sequence[str]] = ()) -> Needs:
    """The files that the operator's command and programs of `more` need, and our Python. `search`: PATH."""
    needs = Needs()
    _our_python(needs)
    for words in (command, *more):
        program = shutil.which(words[0], path=search) if words else None
        if program is not None:
            _program(needs, os.path.abspath(program), search)
    for word in command[1:]:
        if os.path.isabs(word) and word != "/" and os.path.exists(word) and not _is_ours(word):
            needs.path(word)
    return needs


def hidden_below(folder: str) -> Iterator[str]:
    """Yields what no agent may see in Python installations at and directly below `folder`."""
    root = Path(folder)
    sites = [root] if root.name in _SITE_FOLDERS else []
    for base in ("", "lib/", "lib64/", "local/lib/", "versions/*/lib/", "envs/*/lib/", "*/lib/"):
        for name in _SITE_FOLDERS:
            sites += root.glob(f"{base}python3*/{name}")
    for site in sites:
        with contextlib.suppress(OSError):
            for name in os.listdir(site):
                if name.partition(".")[0] in _HIDDEN and not name.endswith((".dist-info", ".egg-info")):
                    yield str(site / name)


def _our_python(needs: Needs) -> None:
    """Adds the interpreter with its standard library, numpy, cloudpickle, and this package's agents; nothing else."""
    prefix, base = os.path.abspath(sys.prefix), os.path.abspath(sys.base_prefix)
    needs.path(base)
    needs.path(os.path.realpath(base))
    if prefix == base:
        return
    needs.path(f"{prefix}/pyvenv.cfg")
    for launcher in Path(prefix, "bin").glob("python*"):
        if launcher.is_symlink():
            needs.link(str(launcher))
        elif launcher.name.rstrip("0123456789.") == "python":
            needs.path(str(launcher))


def our_packages(more: Sequence[str] = ()) -> Iterator[tuple[str, str]]:
    """Yields shipped agents' packages and `more`, with paths in the jail. ConfigError for a missing one."""
    if os.path.abspath(sys.prefix) == os.path.abspath(sys.base_prefix):
        return
    site = sysconfig.get_path("platlib")
    usual = [name for name in ("cloudpickle",) if importlib.util.find_spec(name) is not None]
    for name, source in files_of(("numpy", *usual, *more), metadata_too=bool(more)).items():
        yield source, f"{site}/{name}"
    ours = Path(__file__).parents[1]
    yield str(ours / "__init__.py"), f"{site}/{ours.name}/__init__.py"
    yield str(ours / "agents"), f"{site}/{ours.name}/agents"


def _program(needs: Needs, path: str, search: str | None, depth: int = 0) -> None:
    """Adds a program: the links that lead to it, its installation, and the interpreter of its first line."""
    for _ in range(_MAX_LINKS):
        if not os.path.islink(path):
            break
        _installation(needs, path)
        if not _is_ours(path):
            needs.link(path)
        path = os.path.normpath(os.path.join(os.path.dirname(path), os.readlink(path)))
    _installation(needs, os.path.realpath(path))
    if not _is_ours(path):
        needs.path(path)
    interpreter = _interpreter(path, search)
    if interpreter is not None and depth < 3:
        _program(needs, interpreter, search, depth + 1)


def _installation(needs: Needs, path: str) -> None:
    """Adds the folder of the installation to which `path` belongs, if it is one of its own."""
    parts = Path(path).parts
    if "node_modules" in parts:
        needs.path(str(Path(*parts[: parts.index("node_modules") + 1])))
    elif Path(path).parent.name in ("bin", "shims"):
        root = Path(path).parents[1]
        home = Path(os.path.expanduser("~"))
        # `~/.local` holds far more than programs, including other software's state.
        too_wide = root == Path("/") or root == home or root in home.parents or root.name == ".local"
        marked = any((root / mark).exists() for mark in _INSTALLATION_MARKS)
        if not too_wide and marked and not _is_ours(path):
            needs.path(str(root))


def _interpreter(path: str, search: str | None) -> str | None:
    try:
        with open(path, "rb") as file:
            first = file.read(_SHEBANG_BYTES).partition(b"\n")[0]
    except OSError:
        return None
    if not first.startswith(b"#!"):
        return None
    try:
        words = shlex.split(first[2:].decode("utf-8", "replace"))
    except ValueError:
        return None
    if words and os.path.basename(words[0]) == "env":
        words = [word for word in words[1:] if not word.startswith("-") and "=" not in word]
    program = shutil.which(words[0], path=search) if words else None
    return None if program is None else os.path.abspath(program)


def _in_system(path: str) -> bool:
    return any(path == root or path.startswith(root + "/") for root in SYSTEM)


def _is_ours(path: str) -> bool:
    """Whether `path` is in the virtual environment of this package, of which only `our_packages` are shown."""
    prefix = os.path.abspath(sys.prefix)
    return prefix != os.path.abspath(sys.base_prefix) and (path + "/").startswith(prefix + "/")
