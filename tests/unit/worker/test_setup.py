"""`evopolicy-worker setup`: what is installed for a family, and what is said where that is impossible."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.errors import ConfigError, MachineError
from evopolicy_worker import cli, setup
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


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    assert "has other files" in refused("minigrid", "--into", str(tmp_path / "mine"))
    assert (tmp_path / "mine" / "thesis.tex").exists()


def test_a_python_that_is_too_old_or_missing_is_named(tmp_path: Path) -> None:
    old = tmp_path / "python3.9"
    old.write_text("#!/bin/sh\necho 3.9\n")
    old.chmod(0o755)
    output = refused("minigrid", "--into", str(tmp_path / "new"), "--python", str(old))
    assert "is 3.9" in output
    assert "--python" in output
    assert not (tmp_path / "new").exists()
    assert "cannot be started" in refused("minigrid", "--python", str(tmp_path / "nowhere"))


def test_a_disk_that_is_too_small_is_reported_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = msgspec.structs.replace(installs.installs()["minigrid"], megabytes=1 << 40)
    monkeypatch.setattr(installs, "installs", lambda: {"minigrid": row})
    assert "are needed; make room" in refused("minigrid", "--into", str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


APT = """#!/bin/sh
echo "$@" >> {folder}/asked
[ "$1" = update ] && touch {folder}/updated && exit 0
[ -e {folder}/updated ] || {{ echo "E: Unable to locate package chromium" >&2; exit 100; }}
[ -e {folder}/refuses ] && {{ echo "E: Held packages" >&2; exit 100; }}
printf '' > {folder}/chromium && chmod +x {folder}/chromium
"""


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A machine without a browser. Its apt-get writes down what it is asked, and installs one once it has been
    updated."""
    folder = tmp_path / "machine"
    folder.mkdir()
    (folder / "apt-get").write_text(APT.format(folder=folder))
    (folder / "apt-get").chmod(0o755)
    monkeypatch.setattr(chromium, "_PROGRAMS", (str(folder / "chromium"),))
    monkeypatch.setattr(chromium, "_NAMES", ())
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    chromium.program.cache_clear()
    yield folder
    chromium.program.cache_clear()


def test_root_gets_the_browser_installed(machine: Path) -> None:
    setup.install_browser()
    assert chromium.program() == str(machine / "chromium")
    asked = (machine / "asked").read_text().splitlines()
    assert [line.split()[0] for line in asked] == ["install", "update", "install"]
    setup.install_browser()
    assert (machine / "asked").read_text().splitlines() == asked


def test_a_browser_that_setup_may_not_or_cannot_install_is_reported(
    machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (machine / "refuses").touch()
    into = ("miniwob", "--into", str(tmp_path / "new"))
    assert "cannot be installed: E: Held packages" in refused(*into)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    output = refused(*into)
    assert "install chromium" in output
    assert "EVOPOLICY_BROWSER" in output
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
@pytest.mark.system
def test_a_package_index_that_cannot_be_reached_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {
        "INDEX_URL": "http://127.0.0.1:9/simple",
        "RETRIES": "0",
        "EXTRA_INDEX_URL": "",
        "FIND_LINKS": "",
        "CONFIG_FILE": "/dev/null",
    }.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    monkeypatch.setenv("PIP_NO_CACHE_DIR", "1")
    assert "can be reached: check the network" in refused("minigrid", "--into", str(tmp_path / "new"))
    found = installs.read(tmp_path / "new")
    assert found is not None
    assert not found.ready
    assert installs.made() == []


@pytest.mark.parametrize(
    ("output", "kind", "problem"),
    [
        ("ERROR: Could not install packages: [Errno 28] No space left on device", MachineError, "make room"),
        (
            "(from versions: 0.11)\nERROR: No matching distribution found for ale-py==0.12.1",
            ConfigError,
            "has no ale-py==0.12.1",
        ),
        ("note: x\nERROR: ResolutionImpossible\nfor help visit y", ConfigError, "ResolutionImpossible"),
    ],
)
def test_pips_words_become_a_problem_and_its_remedy(output: str, kind: type, problem: str) -> None:
    error = setup.failure("minigrid", output)
    assert type(error) is kind
    assert problem in str(error)


def test_a_wheel_of_an_installed_distribution_can_be_installed(tmp_path: Path) -> None:
    built = setup.wheel(metadata.distribution("typer"), tmp_path)
    named = built.rename(tmp_path / f"typer-{metadata.version('typer')}-py3-none-any.whl")
    with zipfile.ZipFile(named) as file:
        assert {"typer/__init__.py", f"typer-{metadata.version('typer')}.dist-info/RECORD"} <= set(
            file.namelist()
        )
    target = tmp_path / "target"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target"]
    subprocess.run([*install, target, named], check=True, capture_output=True)
    assert (target / "typer" / "__init__.py").is_file()


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
    folder = made(tmp_path / "elsewhere", "robotics")
    (tmp_path / "installs" / "also").symlink_to(folder)
    assert installs.divided(asked) == {
        sys.executable: ["toy/line", "my_pkg:Env-v0", "gymnasium/CartPole-v1"],
        str(folder / "bin" / "python"): ["gymnasium/FetchReach-v4"],
    }
    (folder / installs.MARK).write_bytes(
        msgspec.json.encode({"families": ["robotics"], "version": "0.0.1", "ready": True})
    )
    with pytest.raises(ConfigError, match=r"evopolicy 0.0.1, and this is .*setup robotics"):
        installs.divided(asked)


def test_the_latest_installation_is_found_also_beside_one_in_the_default_folder(tmp_path: Path) -> None:
    usual = made(tmp_path / "installs", "robotics")
    os.utime(usual / installs.MARK, (1, 1))
    other, third = made(tmp_path / "disk", "robotics"), made(tmp_path / "elsewhere", "robotics")
    os.utime(third / installs.MARK, (2, 2))
    for folder in (other, third, other, usual):
        setup._link(folder, "robotics")
    assert [each.folder for each in installs.made()] == list(map(str, (other, third, usual)))
    assert (usual / installs.MARK).is_file()


def test_a_link_to_a_folder_that_was_deleted_hides_no_other_installation(tmp_path: Path) -> None:
    gone, kept = made(tmp_path / "disk", "robotics"), made(tmp_path / "installs", "minigrid")
    setup._link(gone, "robotics")
    shutil.rmtree(gone)
    assert [each.folder for each in installs.made()] == [str(kept)]
    again = made(tmp_path / "elsewhere", "robotics")
    setup._link(again, "robotics")
    assert {each.folder for each in installs.made()} == {str(kept), str(again)}


@pytest.mark.parametrize("deleted", [False, True])
def test_an_installation_that_is_elsewhere_is_made_anew_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deleted: bool
) -> None:
    folder, written = made(tmp_path / "disk", "robotics"), list[Path]()
    setup._link(folder, "robotics")
    if deleted:
        shutil.rmtree(folder)
    monkeypatch.setattr(setup, "_make", lambda wanted, folder, python: written.append(folder))
    done = CliRunner().invoke(cli.app, ["setup", "robotics"])
    assert done.exit_code == 0, done.output
    assert written == [folder]
    assert (tmp_path / "installs" / "robotics").resolve() == folder


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
