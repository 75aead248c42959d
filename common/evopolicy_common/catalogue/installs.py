"""Installation requirements of environments, and the virtual environments that `evopolicy-worker setup` makes for
them.

Packages of some families conflict with those of others. A worker in a separate virtual environment plays such a family.
`installs.toml` has a row for each family: the extra of this software that installs it, a module that shows that it is
installed, and its versions that differ from `constraints.txt`.

Each virtual environment has a file `MARK` that names its families. They are in the folder `EVOPOLICY_INSTALLS`, or in
`evopolicy/installs` in the user's data folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import msgspec

import evopolicy_common
from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError

FOLDER_VARIABLE = "EVOPOLICY_INSTALLS"
MARK = "evopolicy-install.json"


class Install(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a family is installed."""

    extra: str
    modules: tuple[str, ...]
    """Modules without which its environments cannot be played."""
    megabytes: int
    """Approximate size of a virtual environment with it, MB."""
    adapters: tuple[str, ...] = ()
    """Adapters of its environments; empty: the one of its name."""
    pins: Mapping[str, str] = {}
    """Versions beside, and in place of, those of `constraints.txt`. Empty: it shares an installation with others."""
    apart: Mapping[str, str] = {}
    """Distributions, and their versions, that are installed without what they require, because that excludes others'
    versions with which they work. The extra has the rest of what they need."""
    browser: bool = False
    """Whether it needs Chromium, which belongs to the machine and to no virtual environment."""
    python: tuple[str, str] = ("3.11", "3.14")
    """First Python version it was tested with, and the first that it was not."""
    assets: Mapping[str, tuple[str, ...]] = {}
    """Files in its packages that may have another licence than the package: ROMs, sprites, meshes. Each with
    the words that state its licence and the installed file that has them; with none where no file states
    one."""

    @property
    def fits(self) -> bool:
        """Whether it was tested with this interpreter's version."""
        first, beyond = (tuple(map(int, version.split("."))) for version in self.python)
        return first <= sys.version_info[:2] < beyond


class MadeEnvironment(msgspec.Struct, frozen=True, kw_only=True):
    """A virtual environment that `setup` made, as its file `MARK` describes it."""

    families: tuple[str, ...]
    version: str
    """Of evopolicy."""
    ready: bool = False
    """False while it is being made, or when that failed."""
    folder: str = ""
    """Its folder; not in the file."""

    @property
    def python(self) -> str:
        return str(Path(self.folder, "bin", "python"))


@cache
def installs() -> dict[str, Install]:
    """How each family is installed, by its key."""
    table = tomllib.loads(files(__package__).joinpath("installs.toml").read_text("utf-8"))
    return msgspec.convert(table, dict[str, Install])


def family_of(env_id: str) -> str:
    """The family, a key of `installs()`, that must be installed to play an environment; empty when nothing must."""
    entry = catalogue.known_entry(env_id)
    adapter = "" if entry is None else entry.adapter
    return next((name for name, each in installs().items() if adapter in (each.adapters or (name,))), "")


def apart(families: Iterable[str] = ()) -> list[str]:
    """Requirements that pip installs with `--no-deps` for families; by default for all that share."""
    rows = [each for name, each in installs().items() if name in families or not (families or each.pins)]
    return [f"{name}=={version}" for each in rows for name, version in each.apart.items()]


def is_here(family: str) -> bool:
    """Whether this interpreter has the family's packages; found without importing them."""
    return all(find_spec(module) is not None for module in installs()[family].modules)


@cache
def own() -> str:
    """This interpreter's installation as `NAME@DIGEST`: the families for which `setup` made it, joined with `+`, or
    else `base`; and 12 hex digits of the SHA-256 of the names and versions of all packages in it. Tells no path."""
    here = read_made(Path(sys.prefix))
    names = {
        each.name.removesuffix(".dist-info")
        # Unlike `Path.is_dir`, this raises nothing for a folder of PYTHONPATH that may not be looked at.
        for path in filter(os.path.isdir, sys.path)
        for each in Path(path).glob("*.dist-info")
    }
    digest = hashlib.sha256("\n".join(sorted(names)).encode()).hexdigest()
    return f"{'+'.join(here.families) if here is not None else 'base'}@{digest[:12]}"


def setup_line(family: str) -> str:
    """The command that makes a virtual environment for a family."""
    return f"evopolicy-worker setup {family}"


def advice(env_id: str) -> str:
    """How to make an environment playable on a machine, for an error text; empty when nothing must be installed."""
    family = family_of(env_id)
    return f"`{setup_line(family)}` installs {catalogue.families().get(family, family)}" if family else ""


def root() -> Path:
    """The folder with the virtual environments of this user."""
    if named := os.environ.get(FOLDER_VARIABLE):
        return Path(named).absolute()
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data, "evopolicy", "installs")


def read_made(folder: Path) -> MadeEnvironment | None:
    """The description of a virtual environment; None when the folder is none that `setup` made."""
    try:
        made = msgspec.json.decode((folder / MARK).read_bytes(), type=MadeEnvironment)
    except (OSError, msgspec.MsgspecError):
        return None
    return msgspec.structs.replace(made, folder=str(folder))


def made() -> list[MadeEnvironment]:
    """The finished virtual environments of this user, the latest first."""
    try:
        folders = list(root().iterdir())
    except OSError:
        return []
    ready = [made for each in folders if (made := read_made(each)) is not None and made.ready]

    def finished_at(made: MadeEnvironment) -> float:
        with contextlib.suppress(OSError):
            return Path(made.folder, MARK).stat().st_mtime
        return 0.0

    return sorted((each for each in ready if Path(each.python).exists()), key=finished_at, reverse=True)


def divided(env_ids: Iterable[str]) -> dict[str, list[str]]:
    """The ids by the interpreter whose worker can play them. Ids that this interpreter can play, or that are not known
    here, are this interpreter's.

    Raises ConfigError that names the `setup` line for ids that nothing here can play, and for a virtual environment of
    another version of evopolicy.
    """
    by_python: dict[str, list[str]] = {}
    lacking: dict[str, list[str]] = {}
    for env_id in env_ids:
        family = family_of(env_id)
        if not family or is_here(family):
            by_python.setdefault(sys.executable, []).append(env_id)
        elif (one := next((each for each in made() if family in each.families), None)) is None:
            lacking.setdefault(family, []).append(env_id)
        elif one.version != (ours := evopolicy_common.__version__):
            again = f"make it again with `{setup_line(family)}`"
            raise ConfigError(f"{one.folder} has evopolicy {one.version}, and this is {ours}: {again}")
        else:
            by_python.setdefault(one.python, []).append(env_id)
    if lacking:
        remedies = "; ".join(
            f"{env_ids[0]}{f' and {len(env_ids) - 1} more' * (len(env_ids) > 1)}: {setup_line(family)}"
            for family, env_ids in lacking.items()
        )
        raise ConfigError(f"not installed on this machine: {remedies}")
    return by_python


# Licences of the packages that evopolicy requires directly, and of their assets, as the packages state them:
# `docs/_site/licences.py` writes `licences.json` from installed metadata.

UNKNOWN = "unknown"
"""Licence of what a package contains without stating one for it."""
BASE = ("core", "coordinator", "gateway")
"""Parts of the software besides families, by which packages are used."""


class Licence(msgspec.Struct, frozen=True, kw_only=True):
    what: str
    """Name of the package, or the assets in words."""
    version: str = ""
    """Empty for assets."""
    licence: str = UNKNOWN
    used_by: tuple[str, ...]
    """Keys of `installs()`, and names of `BASE`."""


@cache
def packages() -> tuple[Licence, ...]:
    """Of all parts, by name and version."""
    data = files(__package__).joinpath("licences.json").read_bytes()
    return msgspec.json.decode(data, type=tuple[Licence, ...])


@cache
def assets() -> tuple[Licence, ...]:
    """Of all families, in the order of `installs.toml`."""
    return tuple(
        Licence(what=what, licence=stated[0] if stated else UNKNOWN, used_by=(family,))
        for family, row in installs().items()
        for what, stated in row.assets.items()
    )


def licences(parts: Iterable[str]) -> tuple[Licence, ...]:
    """Packages and assets of some families, each with those of the families that use it."""
    wanted = frozenset(parts)
    used = ((each, tuple(name for name in each.used_by if name in wanted)) for each in packages() + assets())
    return tuple(msgspec.structs.replace(each, used_by=names) for each, names in used if names)
