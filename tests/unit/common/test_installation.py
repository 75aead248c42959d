"""Hints name commands that work here when they are pasted."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from documents import commands
from program_runs import run_program

from evopolicy_common import installation
from evopolicy_common.installation import COMMANDS, add_extra, as_called, program

BIN = Path(sys.executable).parent


def made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in ("evopolicy", "evopolicy-worker"):
        (folder / name).touch(0o755)
    return folder


def test_a_program_is_named_as_it_was_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made(tmp_path / "a clone" / ".venv" / "bin")
    monkeypatch.chdir(tmp_path / "a clone")
    monkeypatch.setenv("PATH", "/nonexistent")
    for called in (".venv/bin/evopolicy", str(folder / "evopolicy")):
        monkeypatch.setattr(sys, "argv", [called])
        assert program("evopolicy-worker") == ".venv/bin/evopolicy-worker"
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["./evopolicy"])
    assert program("evopolicy") == "./evopolicy"
    monkeypatch.chdir("/")
    monkeypatch.setattr(sys, "argv", [str(folder / "evopolicy")])
    assert program("evopolicy") == f"'{str(folder)[1:]}/evopolicy'"


def test_a_program_on_the_path_keeps_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, other = made(tmp_path / "bin"), made(tmp_path / "other")
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(sys, "argv", [str(folder / "evopolicy")])
    assert program("evopolicy") == "evopolicy"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(other / "evopolicy")])
    assert program("evopolicy") == "other/evopolicy"


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("next: evopolicy report runs --out report", "next: PROGRAM report runs --out report"),
        ("`evopolicy runs` shows them", "`PROGRAM runs` shows them"),
        ("see evopolicy --help", "see PROGRAM --help"),
        ("evopolicy-worker --env core16", "PROGRAM-worker --env core16"),
        ("there: evopolicy-worker --env core16", "there: evopolicy-worker --env core16"),
        ("install this version of evopolicy on both", "install this version of evopolicy on both"),
        ("evopolicy 0.2.0 (Python 3.12)", "evopolicy 0.2.0 (Python 3.12)"),
        ("/srv/evopolicy run.json", "/srv/evopolicy run.json"),
    ],
)
def test_commands_in_a_text_are_those_to_call(
    text: str, printed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "program", lambda name: name.replace("evopolicy", "PROGRAM"))
    assert as_called(text) == printed


def test_the_commands_that_a_text_may_name_are_ours() -> None:
    assert {name.split()[1] for name, _ in commands() if " " in name} == set(COMMANDS.split("|"))


def test_an_error_names_the_program_as_it_was_called(tmp_path: Path) -> None:
    near = tmp_path / "near"
    near.symlink_to(BIN)
    done = run_program("near/evopolicy", "files", "no-such-file", cwd=tmp_path)
    assert "`near/evopolicy files` lists all" in done.stderr


def test_an_extra_is_added_from_the_clone_or_from_the_wheels_file(monkeypatch: pytest.MonkeyPatch) -> None:
    clone = Path(__file__).parents[3]
    monkeypatch.chdir(clone)
    assert add_extra("llm").endswith("install -e '.[llm]'")
    monkeypatch.chdir("/")
    assert add_extra("llm").endswith(f"install -e '{clone}[llm]'")
    monkeypatch.setattr(installation, "source", lambda: ("file:///d/evopolicy-1-py3-none-any.whl", False))
    assert add_extra("llm").endswith("install 'evopolicy[llm] @ file:///d/evopolicy-1-py3-none-any.whl'")
    assert Path(add_extra("llm").split()[0]).name.startswith(("python", "uv"))
