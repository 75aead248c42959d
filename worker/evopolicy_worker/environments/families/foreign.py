"""Environments that do not ship: any that Gymnasium can create from an environment file or from `module:Id`.

Nothing about them is trusted: each episode gets a fresh environment, and their source is part of their fingerprint.
Texts in `info` may tell of the machine, so only those that the definition declares are passed on.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.processes.packages import distribution_of
from evopolicy_worker.environments.families import miniwob
from evopolicy_worker.environments.interface.calls import unreadable
from evopolicy_worker.environments.interface.fingerprint import versions
from evopolicy_worker.environments.interface.gymnasium_adapter import GymnasiumFamily

_OF_GYMNASIUM = ("mujoco", "box2d", "pygame-ce", "ale-py")
"""Distributions of Gymnasium's own environments, besides Gymnasium."""
_SOURCES = (".py", ".pyx", ".so", ".xml", ".json", ".toml", ".yaml", ".csv", ".npz", ".npy")
_MAX_FILES = 5000
_MAX_NAMED, _MAX_NAME = 16, 100
_PAGES = "evopolicy_worker.environments.browser.registered"
"""Registers pages with options of one's own."""

dropped: dict[str, dict[str, None]] = {}
"""By id, the keys of `info` whose texts were left out since it was last made for a description or a job, the first
`_MAX_NAMED`."""


class ForeignFamily(GymnasiumFamily):
    remembers = True
    measures = True

    def __init__(self, entry: Entry) -> None:
        self._id = entry.id
        name = entry.gymnasium_id or ""
        self._module = name.partition(":")[0] if ":" in name else ""
        self._strings = frozenset(entry.info_strings)
        self._dropped = dropped[entry.id] = {}

    def installed(self) -> bool:
        return super().installed() and (not self._module or _package(self._module) is not None)

    def needs(self) -> str:
        return f"the package with the module {self._module!r} (installed, or in a folder on PYTHONPATH)"

    def load(self) -> None:
        top = self._module.partition(".")[0]
        for path in (os.path.join(folder, name) for folder in sys.path for name in (top, f"{top}.py")):
            # Python takes such a package for an empty one.
            if top and os.path.exists(path) and not os.access(path, os.R_OK | os.X_OK * os.path.isdir(path)):
                raise WorkerError(f"environment {self._id}, make: it cannot read {path}{unreadable(path)}")
        super().load()

    def rebuilds(self, entry: Entry) -> bool:
        return True

    def info(self, info: Mapping[str, Any]) -> dict[str, Any]:
        plain = super().info(info)
        if self._module == _PAGES:  # its texts are ours
            return plain
        for key in [
            key for key, value in plain.items() if isinstance(value, str) and key not in self._strings
        ]:
            del plain[key]
            if len(self._dropped) < _MAX_NAMED:
                self._dropped[key[:_MAX_NAME]] = None
        return plain

    def packages(self, entry: Entry) -> dict[str, str]:
        common = super().packages(entry)
        if not self._module:
            return common | versions(_OF_GYMNASIUM)
        own = _own(self._module.partition(".")[0], entry.data)
        return common | own | (miniwob.FAMILY.packages(entry) if self._module == _PAGES else {})

    def version(self, entry: Entry) -> str:
        packages = ", ".join(
            f"{name} {each}" for name, each in self.packages(entry).items() if name != "numpy"
        )
        return f"{entry.gymnasium_id} ({packages})"


@cache
def _package(module: str) -> Path | None:
    """Path of a module's top-level package or file, found without importing it; None if there is none."""
    spec = find_spec(module.partition(".")[0])
    if spec is None:
        return None
    places = list(spec.submodule_search_locations or ())
    return Path(places[0]) if places else Path(spec.origin or "")


@cache
def _own(top: str, data: tuple[str, ...] = ()) -> dict[str, str]:
    """The package's version, where it is a distribution's, and a digest of its files and its data: code that is edited
    in place has no other version."""
    place, digest = _package(top), hashlib.sha256()
    for each in (*filter(None, (place,)), *map(Path, data)):
        files = sorted(path for path in each.rglob("*") if path.is_file()) if each.is_dir() else [each]
        if each == place and each.is_dir():
            files = [path for path in files if path.name.endswith(_SOURCES)]
        for path in files[:_MAX_FILES]:
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    name = distribution_of(top)
    return {(name or top).lower(): f"{version(name) if name else '0'}+src.{digest.hexdigest()[:12]}"}
