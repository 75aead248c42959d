"""Installation requirements of environments, and the virtual environments that `evopolicy-worker setup` makes for
them.

Packages of some families conflict with those of others. A worker in a separate virtual environment plays such a family.
`installs.toml` has a row for each family: the extra of this software that installs it, a module that shows that it is
installed, and its versions that differ from `constraints.txt`.

Each virtual environment has a file `MARK` that names its families. `EVOPOLICY_INSTALLS`, or `evopolicy/installs` in the
user's data folder, contains one entry for each: the virtual environment, or a link to it.
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
    """Extra of this software."""
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
    """Files in its packages that may have another licence than the package: ROMs, sprites, meshes, maps. Each
    with two texts, the words that state its licence and the installed file that has them, below
    `site-packages`; with none where no file states one."""


class Made(msgspec.Struct, frozen=True, kw_only=True):
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
        """Its interpreter."""
        return str(Path(self.folder, "bin", "python"))


@cache
def installs() -> dict[str, Install]:
    """How each family is installed, by its key."""
    table = tomllib.loads(files(__package__).joinpath("installs.toml").read_text("utf-8"))
    return msgspec.convert(table, dict[str, Install])


def family_of(env_id: str) -> str:
    """The family, a key of `installs()`, that must be installed to play an environment; empty when nothing must."""
    entry = catalogue.known(env_id)
    adapter = "" if entry is None else entry.adapter
    return next((name for name, each in installs().items() if adapter in (each.adapters or (name,))), "")


def apart(families: Iterable[str] = ()) -> list[str]:
    """Requirements (`NAME==VERSION`) that pip installs with `--no-deps` for the families; by default for all that
    share an installation."""
    rows = [each for name, each in installs().items() if name in families or not (families or each.pins)]
    return [f"{name}=={version}" for each in rows for name, version in each.apart.items()]


def is_here(family: str) -> bool:
    """Whether this interpreter has the family's packages; found without importing them."""
    return all(find_spec(module) is not None for module in installs()[family].modules)


@cache
def own() -> str:
    """This interpreter's installation as `NAME@DIGEST`: the families for which `setup` made it, joined with `+`, or
    else `base`; and 12 hex digits of the SHA-256 of the names and versions of all packages in it. Tells no path."""
    here = read(Path(sys.prefix))
    found = {
        each.name.removesuffix(".dist-info")
        # Unlike `Path.is_dir`, this raises nothing for a folder of PYTHONPATH that may not be looked at.
        for path in filter(os.path.isdir, sys.path)
        for each in Path(path).glob("*.dist-info")
    }
    digest = hashlib.sha256("\n".join(sorted(found)).encode()).hexdigest()
    return f"{'+'.join(here.families) if here is not None else 'base'}@{digest[:12]}"


def setup_line(family: str) -> str:
    """The command that makes a virtual environment for a family."""
    return f"evopolicy-worker setup {family}"


def advice(env_id: str) -> str:
    """How to make an environment playable on a machine, for an error text; empty when nothing must be installed."""
    family = family_of(env_id)
    return f"`{setup_line(family)}` installs {catalogue.families().get(family, family)}" if family else ""


def root() -> Path:
    """The folder with an entry for each virtual environment of this user."""
    if named := os.environ.get(FOLDER_VARIABLE):
        return Path(named).absolute()
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data, "evopolicy", "installs")


def read(folder: Path) -> Made | None:
    """The description of a virtual environment; None when the folder is none that `setup` made."""
    try:
        made = msgspec.json.decode((folder / MARK).read_bytes(), type=Made)
    except (OSError, msgspec.MsgspecError):
        return None
    return msgspec.structs.replace(made, folder=str(folder))


def made() -> list[Made]:
    """The finished virtual environments of this user, the latest first. Skips links to folders that are gone."""
    try:
        folders = {each.resolve() for each in root().iterdir()}
    except OSError:
        return []
    found = [made for each in folders if (made := read(each)) is not None and made.ready]
    return sorted((each for each in found if Path(each.python).exists()), key=_finished_at, reverse=True)


def _finished_at(made: Made) -> float:
    with contextlib.suppress(OSError):
        return Path(made.folder, MARK).stat().st_mtime
    return 0.0


def divided(env_ids: Iterable[str]) -> dict[str, list[str]]:
    """The ids by the interpreter whose worker can play them. Ids that this interpreter can play, or that are not known
    here, are this interpreter's.

    Raises ConfigError that names the `setup` line for ids that nothing here can play, and for a virtual environment of
    another version of evopolicy.
    """
    found: dict[str, list[str]] = {}
    lacking: dict[str, list[str]] = {}
    for env_id in env_ids:
        family = family_of(env_id)
        if not family or is_here(family):
            found.setdefault(sys.executable, []).append(env_id)
            continue
        playing = [each for each in made() if family in each.families]
        if not playing:
            lacking.setdefault(family, []).append(env_id)
            continue
        one = playing[0]
        if one.version != (ours := evopolicy_common.__version__):
            again = f"make it again with `{setup_line(family)}`"
            raise ConfigError(f"{one.folder} has evopolicy {one.version}, and this is {ours}: {again}")
        found.setdefault(one.python, []).append(env_id)
    if lacking:
        remedies = "; ".join(
            f"{env_ids[0]}{f' and {len(env_ids) - 1} more' * (len(env_ids) > 1)}: {setup_line(family)}"
            for family, env_ids in lacking.items()
        )
        raise ConfigError(f"not installed on this machine: {remedies}")
    return found
