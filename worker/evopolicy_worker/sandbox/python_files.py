"""The files that a policy's interpreter needs: the standard library, shared libraries, and only the allowed packages.

The site-packages folder is never shown as a whole, since it has simulators and our own code.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import sysconfig
from importlib import metadata
from pathlib import Path

import msgspec

from evopolicy_common.errors import SandboxError

_SITE_FOLDERS = ("site-packages", "dist-packages")
_SYSTEM_PREFIXES = ("/usr",)


class PythonFiles(msgspec.Struct, frozen=True, kw_only=True):
    """Files of this machine that the sandbox shows, read-only."""

    interpreter: str
    """The interpreter's real file: not a link, nor the launcher of a virtual environment."""
    read: tuple[str, ...]
    """Files and folders, shown at their own paths."""
    libraries: tuple[str, ...]
    """Those paths in `read` that hold the system's shared libraries, of which Python needs only a few."""
    hidden: tuple[str, ...]
    """Folders below those in `read` that must appear empty."""
    packages: dict[str, str]
    """Modules, packages and their bundled libraries: name in the packages folder → path on this machine."""


def find(allowed_packages: tuple[str, ...]) -> PythonFiles:
    """The files for this interpreter, and these importable packages with their dependencies.

    Raises SandboxError, naming the package, when an allowed package is not installed.
    """
    interpreter = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
    prefix = os.path.realpath(sys.base_prefix)
    read = [interpreter]
    if prefix in _SYSTEM_PREFIXES:
        read += [sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")]
    else:
        # A separate prefix (pyenv, conda, uv, /usr/local) also has shared libraries beside the standard library.
        read.append(f"{prefix}/lib")
    libraries = _shared_libraries()
    read += libraries
    # Not resolved: `/lib` is a link to `/usr/lib` on most systems, and both names are used.
    existing = tuple(dict.fromkeys(path for path in read if os.path.exists(path)))
    return PythonFiles(
        interpreter=interpreter,
        read=existing,
        libraries=tuple(path for path in existing if path in libraries),
        hidden=tuple(sorted(_site_folders(existing))),
        packages=_packages(allowed_packages),
    )


def _shared_libraries() -> list[str]:
    """The C library, its loader and the system's shared libraries."""
    paths = ["/lib64", "/etc/ld.so.cache"]
    triplet = sysconfig.get_config_var("MULTIARCH")
    if triplet and os.path.isdir(f"/lib/{triplet}"):
        paths += [f"/lib/{triplet}", f"/usr/lib/{triplet}"]
        loaders = Path("/lib").glob("ld-linux*")
        paths += [str(path) for path in loaders]
    else:
        paths += ["/lib", "/usr/lib64", "/usr/lib"]
    return paths


def _site_folders(read: tuple[str, ...]) -> set[str]:
    """Folders of installed packages below the shown folders."""
    found: set[str] = set()
    for root in read:
        if not os.path.isdir(root):
            continue
        for folder in [Path(root), *Path(root).glob("python3*")]:
            found.update(
                os.path.realpath(folder / name) for name in _SITE_FOLDERS if (folder / name).is_dir()
            )
    return found


def _packages(allowed: tuple[str, ...]) -> dict[str, str]:
    found: dict[str, str] = {}
    pending = list(allowed)
    seen: set[str] = set()
    while pending:
        name = pending.pop()
        if name in seen:
            continue
        seen.add(name)
        entries, needs = _one_package(name, required=name in allowed)
        found.update(entries)
        pending += needs
    return found


def _one_package(name: str, *, required: bool) -> tuple[dict[str, str], list[str]]:
    """Folders and modules of one package, and its dependencies. Raises SandboxError when a `required` one is not
    installed."""
    if name == "numpy":
        # The common case, handled without reading every distribution's metadata.
        spec = importlib.util.find_spec("numpy")
        if spec is None or not spec.submodule_search_locations:
            raise SandboxError(
                "numpy is not installed; install the worker again: pip install 'evopolicy[worker]'"
            )
        folder = Path(next(iter(spec.submodule_search_locations)))
        both = [folder, folder.with_name("numpy.libs")]
        return {path.name: str(path) for path in both if path.is_dir()}, []
    try:
        distribution = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        owners = metadata.packages_distributions().get(name)
        if not owners:
            if required:
                raise SandboxError(
                    f"package {name!r}, which policies may import, is not installed here; install it or leave it out"
                ) from None
            return {}, []
        distribution = metadata.distribution(owners[0])
    tops = {file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")}
    entries = {
        top: str(distribution.locate_file(top))
        for top in tops
        if not top.endswith((".dist-info", ".egg-info", ".pth"))
    }
    needs = [
        re.split(r"[\s;<>=!~\[(]", requirement, maxsplit=1)[0]
        for requirement in distribution.requires or ()
        if "extra ==" not in requirement
    ]
    return entries, needs
