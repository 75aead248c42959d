"""The licences that cards and THIRD_PARTY.md state are those of the installed packages."""

from __future__ import annotations

import runpy
import sys
import sysconfig
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from evopolicy_common.catalogue.installs import UNKNOWN, installs, is_here, licences, packages

ROOT = Path(__file__).parents[3]
SITE = Path(sysconfig.get_path("purelib"))
COMMAND = "python docs/_site/licences.py"


@pytest.fixture(scope="module")
def written() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs/_site/licences.py"))


def test_licences_are_those_of_installed_packages(written: dict[str, Any]) -> None:
    compared = 0
    for row in packages():
        try:
            found = metadata.distribution(row.what)
        except metadata.PackageNotFoundError:
            continue
        if found.version == row.version:
            assert row.licence == written["licence_of"](found), COMMAND
            compared += 1
    assert compared > len(packages()) / 2


def test_each_direct_requirement_of_each_part_has_a_row(written: dict[str, Any]) -> None:
    listed = {(row.what, user) for row in packages() for user in row.used_by}
    assert listed == {(written["normal"](name), user) for name, _, user in written["required"]()}, COMMAND


def test_versions_are_those_that_were_tested() -> None:
    lines = (ROOT / "constraints.txt").read_text().casefold().replace("_", "-").splitlines()
    tested = {line.partition(";")[0].strip() for line in lines}
    tested |= {
        f"{name}=={version}"
        for row in installs().values()
        for name, version in {**row.pins, **row.apart}.items()
    }
    assert {f"{row.what}=={row.version}" for row in packages()} - tested == set(), COMMAND


def test_the_page_of_third_parties_is_the_tables(written: dict[str, Any]) -> None:
    assert (ROOT / "THIRD_PARTY.md").read_text() == written["page"](packages()), COMMAND


@pytest.mark.parametrize("family", [name for name in installs() if is_here(name)])
def test_licences_of_assets_are_words_of_installed_files(family: str) -> None:
    for what, stated in installs()[family].assets.items():
        if stated:
            words, name = stated
            texts = [" ".join(path.read_text("utf-8").split()) for path in SITE.glob(name)]
            assert any(words in text for text in texts), (what, name, sys.prefix)


def test_a_family_has_its_own_packages_and_assets() -> None:
    found = {row.what: row for row in licences(["atari"])}
    assert found["ale-py"].licence == "GPL-2.0-only"
    assert found["game ROMs"].licence == UNKNOWN
    assert found["gymnasium"].used_by == ("atari",)
    assert "mujoco" not in found
    assert licences([]) == ()
