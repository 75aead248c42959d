"""Files of the operator's folders that an environment's process sees: modules, and the data that definitions declare.

A folder on the module search path may hold anything besides: run directories with hidden returns, state folders, keys.
Shown are its modules, packages, and metadata of installed packages, without names that begin with a dot, key files, run
directories and state folders, also inside packages and declared folders.

A link is shown if it leads to a file of its own package (for a module that is one file, to a module in the same folder)
to which these rules apply in the same way; a link to a folder is never followed. In a folder that is shown as a whole,
links stay links, whose targets do not exist in the jail unless they are shown, too. A hard link is a file like any
other: git and archives make none to files outside, and Linux none to files that their maker may not write
(fs.protected_hardlinks). A bind mount, which only root can make, is shown as the folder that it is.
"""

from __future__ import annotations

import importlib.machinery
import os
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import SandboxError

_MODULES = tuple(importlib.machinery.all_suffixes())
_INSTALLED = (".dist-info", ".egg-info", ".libs")
_KEYS = (".pem", ".key", ".p12", ".pfx")
_OURS = frozenset(("run.json", "suite.json", ".gateway", "identity.json", "coordinator.sqlite"))
"""Files that mark run directories, folders of suites, and state folders."""
_MOST = 1000
_INIT = tuple(f"__init__{suffix}" for suffix in _MODULES)


def modules(folder: str) -> list[str]:
    """Paths of what is shown of a folder on the module search path, which need not exist."""
    shown: list[str] = []
    for entry in _entries(folder):
        if entry.name.endswith(_MODULES) and _is_module(entry.path):
            shown.append(entry.path)
        elif entry.is_dir(follow_symlinks=False) and (
            entry.name.endswith(_INSTALLED) or any(os.path.exists(f"{entry.path}/{name}") for name in _INIT)
        ):
            shown += content(entry.path)
    return shown


def content(path: str, package: str = "") -> list[str]:
    """The paths that are shown of a file or folder: the folder itself if nothing in it is hidden. Raises
    SandboxError where that are too many files.

    `package`: the folder to which a file belongs; without one, it is a module of its folder.
    """
    if not os.path.isdir(path):
        return [path] if (_is_shown(path, package) if package else _is_module(path)) else []
    if os.path.islink(path):
        return []
    shown, whole = _content(path, path)
    if len(shown) > _MOST and not whole:
        raise SandboxError(
            f"{path} has {len(shown):,} files and folders to show one by one, and {_MOST:,} are the limit: move hidden"
            " files, keys, links and run directories out of it"
        )
    return [path] if whole else shown


def declared(definitions: Iterable[Entry], folders: Sequence[str]) -> list[str]:
    """The paths shown for these definitions in addition: their data, and their modules wherever installed.

    `folders`: those that are searched for modules before this process's own.
    """
    shown: dict[str, None] = {}
    for entry in definitions:
        names = (entry.gymnasium_id or "", *(wrapper.wrapper for wrapper in entry.wrappers))
        places = [_place(name.partition(":")[0].partition(".")[0], folders) for name in names if ":" in name]
        for path in entry.data:
            real = os.path.realpath(path)
            package = os.path.commonpath([os.path.dirname(real), os.path.realpath(os.path.dirname(path))])
            shown |= dict.fromkeys([*content(path, package), *content(real, package)])
        for path in filter(None, places):
            shown |= dict.fromkeys(content(path))
    return list(shown)


def mirror(folder: str, shown: Iterable[str], place: Path) -> None:
    """Makes the folder `place`, in which links to the shown files of `folder` have their relative paths. Landlock can
    show a file in a folder, but not that the folder has it, and a module is found by listing its folder."""
    for path in shown:
        for base, _, names in (
            os.walk(path) if os.path.isdir(path) else [(os.path.dirname(path), [], [os.path.basename(path)])]
        ):
            own = place / os.path.relpath(base, folder)
            own.mkdir(parents=True, exist_ok=True)
            for name in names:
                (own / name).symlink_to(f"{base}/{name}")


def _place(top: str, folders: Sequence[str]) -> str:
    """Path of a module, found without importing it; of an installation by reference too. Empty if there is none."""
    try:
        spec = importlib.machinery.PathFinder.find_spec(top, folders) or find_spec(top)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    place = next(iter(spec.submodule_search_locations or ()), spec.origin or "")
    return place if os.path.isabs(place) else ""


def _hidden(name: str) -> bool:
    return name.startswith(".") or name.endswith(_KEYS)


def _is_private(folder: str) -> bool:
    """Whether it is a run directory, a folder of suites, or a state folder."""
    return any(os.path.lexists(f"{folder}/{name}") for name in _OURS)


def _is_shown(path: str, package: str) -> bool:
    """Whether the path leads to a file in the folder `package` of which no part is hidden."""
    real, folder = os.path.realpath(path), os.path.realpath(package)
    if not real.startswith(f"{folder}/") or not os.path.isfile(real):
        return False
    for part in os.path.relpath(real, folder).split("/"):
        if _hidden(part) or _is_private(folder):
            return False
        folder = f"{folder}/{part}"
    return True


def _is_module(path: str) -> bool:
    """Whether the path is a module that is one file, or a link to one in the same folder."""
    if os.path.isfile(path) and not os.path.islink(path):
        return True
    real, folder = os.path.realpath(path), os.path.dirname(path)
    beside = os.path.dirname(real) == os.path.realpath(folder) and real.endswith(_MODULES)
    return beside and _is_shown(path, folder)


def _entries(folder: str) -> list[os.DirEntry[str]]:
    """The entries of a folder that may be shown; none of one that cannot be read."""
    try:
        with os.scandir(folder) as listed:
            entries = sorted(listed, key=lambda entry: entry.name)
    except OSError:
        return []
    return [entry for entry in entries if not _hidden(entry.name)]


def _content(folder: str, package: str) -> tuple[list[str], bool]:
    """The paths that are shown of a folder in a package, and whether they are all of it."""
    if _is_private(folder):
        return [], False
    shown: list[str] = []
    entries = _entries(folder)
    whole = len(entries) == len(os.listdir(folder))
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            inner, entirely = _content(entry.path, package)
            shown += [entry.path] if entirely else inner
            whole = whole and entirely
        elif entry.is_file(follow_symlinks=False) or (entry.is_symlink() and _is_shown(entry.path, package)):
            shown.append(entry.path)
        elif not entry.is_symlink():
            whole = False
    return shown, whole
