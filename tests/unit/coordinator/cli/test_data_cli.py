"""`evopolicy data`: what it writes, what it refuses to overwrite, and its exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evopolicy_common import catalogue
from evopolicy_coordinator.cli.data import app


def call(*args: object) -> Result:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def test_made_splits_pass_their_check(tmp_path: Path) -> None:
    assert call("make", "--env", "core16", "--root", tmp_path, "--seed", 7).exit_code == 0
    result = call("check", tmp_path)
    assert result.exit_code == 0
    rows = [line.split() for line in result.stdout.splitlines() if "/" in line]
    assert {row[0] for row in rows} == set(catalogue.suites()["core16"].environments)
    assert {tuple(row[1:5]) for row in rows} == {("64", "16", "32", "no")}
    assert {row[-1] for row in rows} == {"ok"}
    assert call("check", tmp_path / "gym_acrobot").exit_code == 0


def test_same_public_seed_gives_same_files_and_no_seed_gives_secret_ones(tmp_path: Path) -> None:
    for root in ("a", "b"):
        assert call("make", "--env", "toy/line", "--root", tmp_path / root, "--seed", 7).exit_code == 0
        assert call("make", "--env", "toy/maze", "--root", tmp_path / root).exit_code == 0
    files = {
        (root, env): (tmp_path / root / env / "heldout.json").read_bytes()
        for root in "ab"
        for env in ("toy_line", "toy_maze")
    }
    assert files["a", "toy_line"] == files["b", "toy_line"]
    assert files["a", "toy_maze"] != files["b", "toy_maze"]
    assert json.loads(files["a", "toy_line"])["secret"] is False
    assert json.loads(files["a", "toy_maze"])["secret"] is True


def test_files_that_differ_are_kept_unless_forced(tmp_path: Path) -> None:
    args = ("make", "--env", "toy/line", "--root", tmp_path, "--seed", 7)
    assert call(*args).exit_code == 0
    before = (tmp_path / "toy_line" / "train.json").read_bytes()
    assert call(*args).exit_code == 0
    refused = call(*args, "--train", 5)
    assert refused.exit_code == 2
    assert "--force" in refused.stderr
    assert (tmp_path / "toy_line" / "train.json").read_bytes() == before
    assert call(*args, "--train", 5, "--force").exit_code == 0
    assert len(json.loads((tmp_path / "toy_line" / "train.json").read_text())["cases"]) == 5


def test_folders_are_made_without_a_colon(tmp_path: Path) -> None:
    assert call("make", "--env", "my/pkg:Glider-v0", "--root", tmp_path, "--seed", 7).exit_code == 0
    assert list(tmp_path.iterdir()) == [tmp_path / "my_pkg_Glider-v0"]


def test_check_tells_what_is_wrong_and_exits_1(tmp_path: Path) -> None:
    call("make", "--env", "toy/*", "--root", tmp_path, "--seed", 7)
    train = tmp_path / "toy_line" / "train.json"
    (tmp_path / "toy_line" / "valid.json").write_bytes(train.read_bytes())
    (tmp_path / "toy_maze" / "valid.json").unlink()
    result = call("check", tmp_path)
    assert result.exit_code == 1
    assert "is train case 0 and valid case 0" in result.stdout
    assert "toy_maze/valid.json" in result.stdout.replace("\n", "")


def test_check_reads_the_published_tree(tmp_path: Path) -> None:
    call("make", "--env", "toy/*", "--root", tmp_path / "ours", "--seed", 7)
    (tmp_path / "theirs" / "toy").mkdir(parents=True)
    for name in ("line", "maze"):
        (tmp_path / "ours" / f"toy_{name}").rename(tmp_path / "theirs" / "toy" / name)
    result = call("check", tmp_path / "theirs")
    assert result.exit_code == 0, result.stdout
    assert [line.split()[0] for line in result.stdout.splitlines() if "/" in line] == ["toy/line", "toy/maze"]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("make", "--env", "gym/acrobat", "--root", "x"), "gym/acrobot"),
        (("make", "--env", "toy", "--root", "x", "--train", "0"), "--train"),
        (("make", "--env", "toy"), "--root"),
        (("check", "no/such/folder"), "is not a folder"),
        (("check", "."), "no train.json"),
    ],
)
def test_wrong_usage_is_reported_and_exits_2(
    args: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = call(*args)
    assert result.exit_code == 2
    assert message in result.stderr
    assert list(tmp_path.iterdir()) == []
