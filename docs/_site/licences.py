"""Writes the licences of required packages into the catalogue and into THIRD_PARTY.md.

`python docs/_site/licences.py [SITE_PACKAGES...]` reads the metadata of installed packages, and of those in
other folders for families that need an installation of their own. Rows of versions that are installed nowhere
stay as they are.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib import metadata
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

import msgspec
from packaging.requirements import Requirement

from evopolicy_common.catalogue.installs import BASE, UNKNOWN, Licence, assets, installs, packages

TOP = Path(__file__).parents[2]
DATA = TOP / "common" / "evopolicy_common" / "catalogue" / "licences.json"
PAGE = TOP / "THIRD_PARTY.md"
HEAD = """# Third-party software

evopolicy's wheel contains one file of others: `idiomorph.min.js` of the live view, Zero-Clause BSD
([licence](coordinator/evopolicy_coordinator/web/content/static/idiomorph.LICENSE)). pip installs everything
else from where its authors published it, and only what the chosen extras need.
`python docs/_site/licences.py` writes this page.

## Packages

Packages that evopolicy requires directly, in the tested versions, with the licence that their metadata state.
*Used by* names a part of evopolicy, or a family of environments. Packages that these require in turn have
licences of their own.
"""
ASSETS = """
## Assets

Files in these packages that may have another licence than the package. The licence is quoted from a file in
the package; *unknown*: the package does not state one for them. Read it before you redistribute an
installation, an image of one, or pictures of such an environment.
"""


def licence_of(package: Distribution) -> str:
    """The SPDX expression, or else the first line of the licence's field, or the classifiers."""
    fields = package.metadata
    first = (fields.get("License") or "").strip().partition("\n")[0].strip()
    classifiers = (each.split("::") for each in fields.get_all("Classifier") or ())
    classified = ", ".join(last.strip() for kind, *_, last in classifiers if kind == "License ")
    return fields.get("License-Expression") or (first if len(first) <= 60 else "") or classified or UNKNOWN


def required() -> Iterator[tuple[str, str, str]]:
    """Name, version ("" for the one of constraints.txt), and user of each direct requirement."""
    project: dict[str, Any] = tomllib.loads((TOP / "pyproject.toml").read_text("utf-8"))["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]

    def names(listed: list[str]) -> Iterator[str]:
        for each in map(Requirement, listed):
            if each.name == "evopolicy":
                yield from (name for extra in each.extras for name in names(extras[extra]))
            else:
                yield each.name

    users = [("core", project["dependencies"], {})] + [(base, extras[base], {}) for base in BASE[1:]]
    users += [(family, extras[row.extra], {**row.pins, **row.apart}) for family, row in installs().items()]
    for user, listed, versions in users:
        for name in (*names(listed), *versions):
            yield name, versions.get(name, ""), user


def normal(name: str) -> str:
    """As PyPI compares names."""
    return re.sub(r"[-_.]+", "-", name).lower()


def rows(folders: Iterable[str] = ()) -> list[Licence]:
    """The table from installed metadata; `folders`: further `site-packages`."""
    stored = {(normal(each.what), each.version): each.licence for each in packages()}
    elsewhere, here = metadata.distributions(path=list(folders)), list(metadata.distributions())
    known = stored | {(normal(each.name), each.version): licence_of(each) for each in (*elsewhere, *here)}
    versions = dict(stored) | {normal(each.name): each.version for each in here}
    users: dict[tuple[str, str], dict[str, None]] = {}
    for name, version, user in required():
        users.setdefault((normal(name), version or versions[normal(name)]), {})[user] = None
    return [
        Licence(what=name, version=version, licence=known[name, version], used_by=tuple(used))
        for (name, version), used in sorted(users.items())
    ]


def page(listed: Iterable[Licence]) -> str:
    """THIRD_PARTY.md."""
    lines = [HEAD.rstrip(), "", "| package | version | licence | used by |", "|---|---|---|---|"]
    for each in listed:
        lines.append(f"| {each.what} | {each.version} | {each.licence} | {', '.join(each.used_by)} |")
    lines += [ASSETS.rstrip(), "", "| family | asset | licence |", "|---|---|---|"]
    lines += [f"| {each.used_by[0]} | {each.what} | {each.licence} |" for each in assets()]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    table = rows(sys.argv[1:])
    DATA.write_bytes(b"[\n" + b",\n".join(map(msgspec.json.encode, table)) + b"\n]\n")
    packages.cache_clear()
    PAGE.write_text(page(table), encoding="utf-8")
