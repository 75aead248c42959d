"""`evopolicy-worker setup`: what is installed for a family, and what is said where that is impossible."""

from __future__ import annotations

import os
import sys
from importlib import metadata
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.errors import ConfigError
from evopolicy_worker import cli, setup
from evopolicy_worker.environments import missing
from evopolicy_worker.environments.browser import chromium


@pytest.fixture(autouse=True)
def _own_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(installs.FOLDER_VARIABLE, str(tmp_path / "installs"))


def refused(*arguments: str) -> str:
    """The error of a command that cannot be carried out, on one line."""
    done = CliRunner().invoke(cli.app, ["setup", *arguments])
    assert done.exit_code != 0, done.output
    return " ".join(done.output.split())


def test_every_environment_that_needs_packages_belongs_to_a_row() -> None:
    without = {each.id for each in catalogue.entries().values() if not installs.family_of(each.id)}
    assert without == set(catalogue.suites()["toy"].environments)


def test_the_extras_of_the_rows_are_those_of_the_distribution() -> None:
    known = set(metadata.metadata("evopolicy").get_all("Provides-Extra") or ())
    assert {each.extra for each in installs.installs().values()} <= known


def test_pins_of_a_family_replace_those_of_the_constraints() -> None:
    lines = setup.constraints({"mo_gymnasium": installs.installs()["mo_gymnasium"]}).splitlines()
    assert "highway-env==1.11" in lines
    assert not any(line.startswith("highway-env==1.12") for line in lines)
    assert "mujoco==3.10.0" in lines
    assert "mo-gymnasium==1.3.2" in lines


def test_what_is_installed_apart_belongs_to_the_families_that_are_asked_for() -> None:
    assert "nle==1.3.0" in installs.apart(["atari", "nethack"])
    assert installs.apart(["atari"]) == []
    assert "nle==1.3.0" in installs.apart()


@pytest.mark.parametrize(
    ("families", "told"),
    [
        (["pinball"], "atari"),
        (["core16"], "its environments need"),
        (["atari", "mo_gymnasium"], "set it up alone"),
    ],
)
def test_families_that_cannot_be_installed_are_refused(families: list[str], told: str) -> None:
    assert told in refused(*families)


def test_another_python_than_the_tested_ones_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 9, 1))
    assert "is tested with Python 3.11 up to" in refused("minigrid")


def test_a_disk_that_is_too_small_is_reported_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = msgspec.structs.replace(installs.installs()["minigrid"], megabytes=1 << 40)
    monkeypatch.setattr(installs, "installs", lambda: {"minigrid": row})
    assert "are needed; make room" in refused("minigrid")
    assert not (tmp_path / "installs" / "minigrid").exists()


def test_a_browser_that_is_missing_is_named_before_anything_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chromium, "_PROGRAMS", ())
    monkeypatch.setattr(chromium, "_NAMES", ())
    chromium.program.cache_clear()
    output = refused("miniwob")
    chromium.program.cache_clear()
    assert "install chromium" in output
    assert "EVOPOLICY_BROWSER" in output
    assert not (tmp_path / "installs").exists()


@pytest.mark.slow
@pytest.mark.system
def test_a_browser_that_is_missing_is_all_that_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chromium, "lacking", lambda: "Chromium")
    monkeypatch.setattr(installs, "is_here", lambda family: True)
    assert missing("miniwob/click-test-v1") == "Chromium"
    monkeypatch.setattr(installs, "is_here", lambda family: False)
    assert "or `evopolicy-worker setup miniwob`" in missing("miniwob/click-test-v1")


def test_a_package_index_that_cannot_be_reached_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"INDEX_URL": "http://127.0.0.1:9/simple", "EXTRA_INDEX_URL": "", "FIND_LINKS": ""}
    for name, value in (settings | {"RETRIES": "0", "CONFIG_FILE": "/dev/null", "NO_CACHE_DIR": "1"}).items():
        monkeypatch.setenv(f"PIP_{name}", value)
    assert "minigrid cannot be installed: ERROR: " in refused("minigrid")
    found = installs.read_made(tmp_path / "installs" / "minigrid")
    assert found is not None
    assert not found.ready
    assert installs.made() == []


def made(root: Path, name: str, **fields: object) -> Path:
    """A folder as `setup` leaves it, with an interpreter that is a link to this one."""
    folder = root / name
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").symlink_to(sys.executable)
    document = {"families": [name], "version": metadata.version("evopolicy"), "ready": True, **fields}
    (folder / installs.MARK).write_bytes(msgspec.json.encode(document))
    return folder


def test_ids_are_divided_among_the_interpreters_that_can_play_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installs, "is_here", lambda family: family != "robotics")
    asked = ["toy/line", "gymnasium/FetchReach-v4", "my_pkg:Env-v0", "gymnasium/CartPole-v1"]
    with pytest.raises(ConfigError, match=r"FetchReach-v4: evopolicy-worker setup robotics"):
        installs.divided(asked)
    half = made(tmp_path / "installs", "robotics", ready=False)
    with pytest.raises(ConfigError, match="setup robotics"):
        installs.divided(asked)
    (half / installs.MARK).unlink()
    folder = made(tmp_path / "installs", "robotics+atari", families=["robotics", "atari"])
    assert installs.divided(asked) == {
        sys.executable: ["toy/line", "my_pkg:Env-v0", "gymnasium/CartPole-v1"],
        str(folder / "bin" / "python"): ["gymnasium/FetchReach-v4"],
    }
    (folder / installs.MARK).write_bytes(
        msgspec.json.encode({"families": ["robotics"], "version": "0.0.1", "ready": True})
    )
    with pytest.raises(ConfigError, match=r"evopolicy 0.0.1, and this is .*setup robotics"):
        installs.divided(asked)


def test_the_latest_installation_comes_first(tmp_path: Path) -> None:
    older, newer = made(tmp_path / "installs", "robotics"), made(tmp_path / "installs", "atari+robotics")
    os.utime(older / installs.MARK, (1, 1))
    assert [each.folder for each in installs.made()] == [str(newer), str(older)]


def test_an_installation_is_made_anew_in_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made(tmp_path / "installs", "robotics")
    (folder / "old").touch()
    monkeypatch.setattr(setup, "_run", lambda program, part: None)
    monkeypatch.setattr(setup, "_try", lambda made, family: None)
    done = CliRunner().invoke(cli.app, ["setup", "robotics"])
    assert done.exit_code == 0, done.output
    assert not (folder / "old").exists()
    assert (found := installs.read_made(folder)) is not None
    assert found.ready


def test_an_installation_is_named_by_its_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installs.own.cache_clear()
    before = installs.own()
    # The system refuses to look at a name of this length, as at a folder without permission.
    monkeypatch.setattr(sys, "path", [*sys.path, f"/{'x' * 5000}", str(tmp_path)])
    installs.own.cache_clear()
    assert installs.own() == before
    (tmp_path / "acme-1.0.dist-info").mkdir()
    installs.own.cache_clear()
    assert installs.own() != before
    assert str(tmp_path) not in installs.own()
    installs.own.cache_clear()
