"""Which files a policy's interpreter needs: the standard library, shared libraries, and the allowed packages alone.

Never the site-packages folder as a whole: simulators and our own code are in it.
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
    """What to show of this machine, read-only."""

    interpreter: str
    """The interpreter's own file, no link and no launcher of a virtual environment."""
    read: tuple[str, ...]
    """Files and folders, to be seen at their own paths."""
    libraries: tuple[str, ...]
    """Those of them that hold the system's shared libraries, of which Python needs a few."""
    hidden: tuple[str, ...]
    """Folders below those in `read` that must look empty."""
    packages: dict[str, str]
    """Name in the packages folder, and where it is: modules, packages and their bundled libraries."""


def find(allowed_packages: tuple[str, ...]) -> PythonFiles:
    """The files for this interpreter and these importable packages with what they depend on.

    SandboxError naming a package that is not installed.
    """
    interpreter = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
    prefix = os.path.realpath(sys.base_prefix)
    read = [interpreter]
    if prefix in _SYSTEM_PREFIXES:
        read += [sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib")]
    else:
        # A prefix of Python's own (pyenv, conda, uv, /usr/local): libraries beside the standard library too.
        read.append(f"{prefix}/lib")
    libraries = _shared_libraries()
    read += libraries
    # Resolved one by one: `/lib` is a link to `/usr/lib` on most systems, and both names are used.
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
    """Folders of installed packages below what is shown."""
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
    """Folders and modules of one package, and the distributions it depends on."""
    if name == "numpy":
        # The usual case, without reading every distribution's metadata.
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
