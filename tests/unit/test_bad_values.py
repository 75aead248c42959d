"""Values that options and arguments refuse, one test for each kind of value.

Texts and numbers are checked where every command's words are parsed, so the tests give them to every parameter. Paths
are checked by the commands themselves: each row of a table is one way to read or to write a file.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import pytest
import typer
from commands import STILL
from documents import commands
from forked import Forks
from invented.run_dirs import write_run
from typer.exceptions import TyperException

from evopolicy_common.cli.frame import SEVERAL_LINES

TEXTS = {
    "empty": "",
    "blanks": "   ",
    "control": "a\x1b[2Jb",
    "line": "a\nerror: b",
    "long": "x" * 100_000,
    "unicode": "\udcff\udcfe",
}
"""Texts that no parameter takes."""
NUMBERS = ("1e309", "nan", "inf", "1_000", "ten", "no/such")
"""Values that no number takes."""
PARAMETERS = [
    (name, command, each)
    for name, command in commands()
    for each in command.params
    if each.name not in ("help", "_", "install_completion", "show_completion")
]


def refusal(name: str, command: Any, parameter: Any, value: str) -> str:
    """The error of a command with this value of a parameter; empty if it accepts the words."""
    options, arguments = [], []
    for each in command.params:
        is_option = each.param_type_name == "option"
        if each is parameter or each.required:
            word = value if each is parameter else {"role": "worker"}.get(each.name, ".")
            options += [f"{each.opts[0]}={word}"] * is_option
            arguments += [word] * (not is_option)
    words = [*options, "--", *arguments]
    try:
        command.make_context(name, words)
    except (typer.BadParameter, TyperException) as error:
        return str(error.format_message())
    return ""


def is_number(command: Any, parameter: Any) -> bool:
    for value in ("1", "64"):
        try:
            taken = parameter.process_value(typer.Context(command), value)
        except typer.BadParameter:
            continue
        if isinstance(taken, int | float) and not isinstance(taken, bool):
            return True
    return False


@pytest.mark.parametrize("kind", TEXTS)
def test_no_parameter_takes_a_text_that_is_empty_endless_or_unprintable(kind: str) -> None:
    for name, command, parameter in PARAMETERS:
        if kind == "line" and parameter.name in SEVERAL_LINES:
            continue
        error = refusal(name, command, parameter, TEXTS[kind])
        names = (*parameter.opts, f"'{parameter.name}'", str(parameter.metavar))
        assert any(each in error for each in names), (name, parameter.name, error)
        assert len(error) < 1_000, (name, parameter.name)
        assert "\x1b" not in error


@pytest.mark.parametrize("value", NUMBERS)
def test_no_number_takes_what_is_no_finite_number(value: str) -> None:
    numbers = [each for each in PARAMETERS if is_number(*each[1:])]
    assert len(numbers) > 20
    for name, command, parameter in numbers:
        assert parameter.opts[0] in refusal(name, command, parameter, value), (name, parameter.name)


def test_no_switch_takes_a_value() -> None:
    switches = [each for each in PARAMETERS if getattr(each[2], "is_flag", False)]
    assert len(switches) > 20
    assert [each[0] for each in switches if not refusal(*each, "yes")] == []


READ = (
    "suite BAD --runs played",
    "report BAD --out report",
    "report BAD.csv --out report",
    "export BAD --to csv",
    "verify BAD --local",
    "rescore BAD --cases 8 --local",
    "publish BAD --out new.evp --local",
    "check BAD",
    "diff BAD RUN",
    "replay BAD",
    "finish BAD",
    "harbor BAD --http 127.0.0.1:0",
    "data check BAD",
    "disk --state BAD",
    "status --credentials BAD",
    "web BAD --http 127.0.0.1:0",
    "web --http 127.0.0.1:0 --tls-certificate BAD",
    f"try {STILL} --env BAD.toml --credentials RUN",
    "try BAD --env toy/line --state BAD",
    "local --env toy/line --agent file:BAD",
    "local --env toy/line --agent replay:BAD",
    "local --env toy/line --agent random --set agents_md=BAD",
    "local --env toy/line --agent random --set prompts=BAD",
    "run --env toy/line --agent random --credentials BAD",
)
"""Commands that read the file or folder BAD."""
WRITE = (
    "suite smoke.toml --local --runs BAD/x",
    "local --env toy/line --agent random --runs BAD/x",
    "report RUN --out BAD",
    "export RUN --to csv --out BAD",
    "leaderboard FILE --out BAD",
    "data make --env toy/line --root BAD/x",
    "files deploy --to BAD",
)
"""Commands that would write into the file BAD."""
KINDS = ("pipe", "device", "binary", "missing")


def contents(folder: Path) -> dict[str, Any]:
    """Every file with its size and time of change; of a folder only that it is there."""
    found = {}
    for path in folder.rglob("*"):
        info = path.lstat()
        found[str(path)] = None if stat.S_ISDIR(info.st_mode) else (info.st_size, info.st_mtime_ns)
    return found


@pytest.fixture
def here(tmp_path: Path) -> Path:
    here = tmp_path / "here"
    here.mkdir()
    write_run(here / "RUN", [])
    (here / "FILE").write_text("text\n")
    for ending in ("", ".csv", ".toml"):
        os.mkfifo(here / f"pipe{ending}")
        (here / f"device{ending}").symlink_to("/dev/zero")
        (here / f"binary{ending}").write_bytes(bytes(range(256)) * 16)
    return here


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "kind"),
    # A folder that is missing is made.
    [(line, kind) for line in (*READ, *WRITE) for kind in KINDS if kind != "missing" or line in READ],
)
def test_a_bad_path_is_refused_in_one_line_and_nothing_changes(
    line: str, kind: str, here: Path, forked: Forks
) -> None:
    before = contents(here)
    words = ["evopolicy", *line.replace("BAD", kind).split()]
    done = forked(words, cwd=here, XDG_STATE_HOME=str(here.parent / "state"))
    assert done.returncode in (1, 2, 3), done.stdout
    assert "Traceback" not in done.stderr
    assert [text.startswith("error: ") for text in done.stderr.splitlines()].count(True) == 1, done.stderr
    assert len(done.stderr) < 4_000
    assert kind in done.stderr
    assert contents(here) == before
