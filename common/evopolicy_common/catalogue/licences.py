"""Licences of the packages that evopolicy requires directly, and of their assets, as the packages state them.

`docs/_site/licences.py` writes `licences.json` from installed metadata; `installs.toml` names the assets.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.resources import files

import msgspec

from evopolicy_common.catalogue.installs import installs

UNKNOWN = "unknown"
"""Licence of what a package contains without stating one for it."""
BASE = ("core", "coordinator", "gateway")
"""Parts of the software besides families, by which packages are used."""


class Licence(msgspec.Struct, frozen=True, kw_only=True):
    """The licence of a package, or of assets in it."""

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
    found = (
        (each, tuple(name for name in each.used_by if name in wanted)) for each in (*packages(), *assets())
    )
    return tuple(msgspec.structs.replace(each, used_by=used) for each, used in found if used)
