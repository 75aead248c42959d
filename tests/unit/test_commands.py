"""How every command looks: help, version, completion, usage errors, and what it says without its extra."""

from __future__ import annotations

import os
import re
import socket
import subprocess
from pathlib import Path

import pytest
from commands import STILL
from documents import APPS
from forked import BIN, Forks
from invented.run_dirs import write_run
from program_runs import run_program, run_python

from evopolicy_common import installation
from evopolicy_gateway.harnesses import FORMS

pytestmark = pytest.mark.slow

PROGRAMS = sorted(APPS)
MODULES = {
    "evopolicy": "evopolicy_common.entry:evopolicy",
    "evopolicy-coordinator": "evopolicy_common.entry:coordinator",
    "evopolicy-worker": "evopolicy_common.entry:worker",
}

WITHOUT = """
import importlib, sys
blocked = sys.argv.pop(1).split(",")


class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


class NoSpec:
    def __call__(self, name, *rest):
        return None if name.partition(".")[0] in blocked else find_spec(name, *rest)


import importlib.util
find_spec = importlib.util.find_spec
importlib.util.find_spec = NoSpec()
sys.meta_path.insert(0, Blocker())
module, function = sys.argv.pop(1).split(":")
getattr(importlib.import_module(module), function)()
"""
"""Starts a program in which some modules cannot be imported, as where their extra is not installed."""


def without(modules: str, words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    variables = os.environ | {"XDG_STATE_HOME": str(folder / "state")}
    return run_python(WITHOUT, modules, MODULES[words[0]], *words[1:], cwd=folder, env=variables)


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_tells_its_version_and_how_a_line_goes_on(program: str, forked: Forks) -> None:
    assert forked([program, "--version"]).stdout.startswith("evopolicy 0.")
    variable = f"_{program.upper().replace('-', '_')}_COMPLETE"
    asked = {variable: "complete_bash", "COMP_WORDS": f"{program} --ver", "COMP_CWORD": "1"}
    assert forked([program], **asked).stdout.split() == ["--version"]


def test_completion_knows_the_commands_and_choices_of_all_rooms(forked: Forks) -> None:
    asked = {"_EVOPOLICY_COMPLETE": "complete_bash"}
    lines = {"workers": "evopolicy wor", "pause": "evopolicy workers pa", "bwrap": "evopolicy local --tier b"}
    for word, line in lines.items():
        done = forked(["evopolicy"], **asked, COMP_WORDS=line, COMP_CWORD=str(line.count(" ")))
        assert done.stdout.split() == [word]


def test_a_wrong_choice_is_reported_with_the_choices(forked: Forks) -> None:
    output = forked(["evopolicy", "local", "--help"]).stdout
    for choices in ("<bwrap|landlock|none>", "<bwrap|open-network|none>", "<off|first|all>"):
        assert choices in output
    done = forked(["evopolicy", "run", "--env", "toy", "--agent", "evolve", "--tier", "x"])
    assert done.returncode == 2
    assert done.stderr == (
        "error: Invalid value for '--tier': 'x' is not one of 'bwrap', 'landlock', 'none'; see"
        f" {installation.program('evopolicy')} run --help\n"
    )


LOCAL = ["evopolicy", "local", "--env", "toy", "--agent"]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ([*LOCAL, "evolve", "--budget", "ten"], "'--budget': 'ten' is not a whole number"),
        ([*LOCAL, "evolve", "--budget", "0"], "'--budget': '0' is less than 1"),
        ([*LOCAL, "evolve", "--slots", "2000"], "'--slots': '2000' is more than 1024"),
        ([*LOCAL, "evolve", "--min-episodes", "2"], "give it as --set min_episodes=VALUE"),
        ([*LOCAL, "evolve", "--repeated", "2"], "local --help"),
        ([*LOCAL, "mine.toml"], "write --agent file:mine.toml"),
        ([*LOCAL, "run.py 3"], "write --agent 'command:python3 run.py 3'"),
        ([*LOCAL, "sh run"], "write --agent 'command:sh run'"),
        ([*LOCAL, "/usr"], "write --agent replay:/usr"),
        ([*LOCAL, "evolv"], "write --agent evolve, or one of these forms:\nevolve, random, replay:DIR, "),
        (["evopolicy", "export", "RUNS", "--to", "csv", "--out", "FILE"], "choose another folder with --out"),
        (
            ["evopolicy", "report", "EMPTY", "--out", "new"],
            "no finished run in EMPTY; nothing written. Name run",
        ),
        (["evopolicy", "disk", "--state", "EMPTY"], "it has no coordinator.sqlite; name one with --state"),
        (["evopolicy", "web", "--tls-certificate", "FILE"], "both in PEM"),
        (["evopolicy-coordinator", "--state", "new", "--listen", "tcp/127.0.0.1:IN USE"], "with --listen"),
        (["evopolicy-coordinator", "certs", "revoke", "x", "--state", "EMPTY"], "certs init --state EMPTY"),
        (["evopolicy-worker", "check-env", "toy/line", "--results", "FILE/x"], "folder with --results"),
        ([*LOCAL, "random", "--policy-package", ".."], "'..' is no name of a package; leave it out"),
        ([*LOCAL, "random", "--slots", "1_000"], "'--slots': '1_000' is not a finite number in digits"),
        ([*LOCAL, "random", "--budget", "20001"], "a budget of 20,001 episodes; 20,000 are the limit"),
        (
            ["evopolicy", "try", STILL, "--env", "toy/line", "--cases", "0,64"],
            "no train case 64; the cases are 0 to 63",
        ),
        (["evopolicy", "gc", "--older-than", "inf"], "'inf' is not a finite number in digits"),
        (["evopolicy", "diff", "EMPTY", "RUNS"], "EMPTY is no run directory: it has neither run.json nor"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_value_is_named_with_the_remedy(
    words: list[str], problem: str, tmp_path: Path, forked: Forks
) -> None:
    write_run(tmp_path / "RUNS", [])
    (tmp_path / "EMPTY").mkdir()
    (tmp_path / "FILE").write_text("text\n")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        words = [word.replace("IN USE", port) for word in words]
        done = forked(words, cwd=tmp_path, XDG_STATE_HOME=str(tmp_path / "state"))
    assert done.returncode in (1, 2), done.stdout
    assert problem in done.stderr
    lines = [line for line in done.stderr.splitlines() if line not in FORMS]
    assert lines[-1].startswith("error: ")
    assert "Traceback" not in done.stderr
    assert ".rs:" not in done.stderr
    assert not any((tmp_path / "EMPTY").iterdir())


def test_a_command_in_a_deleted_folder_says_so(tmp_path: Path) -> None:
    here = tmp_path / "here"
    here.mkdir()
    command = f"{BIN / 'evopolicy'} run --env toy/line --agent random"
    done = run_program("sh", "-c", f"cd {here} && rmdir {here} && exec {command}")
    assert done.returncode == 1
    assert done.stderr == "error: the folder in which this command was started is gone: change to another\n"


def test_a_long_value_is_shortened_and_the_remedy_stays(forked: Forks) -> None:
    done = forked(["evopolicy", "workers", "drain", "x" * 100_000])
    assert done.returncode == 2
    assert len(done.stderr) < 1_000
    assert "has 100,000 characters, and 32,768 are the limit" in done.stderr


def test_ctrl_c_is_told_whatever_a_command_was_doing() -> None:
    program = """
from evopolicy_common.cli.frame import App, run_app
app = App()
@app.command()
def interrupted() -> None:
    raise KeyboardInterrupt
run_app(app)
"""
    done = run_python(program)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")


@pytest.mark.parametrize(
    ("modules", "words", "extra"),
    [
        ("starlette,uvicorn,h11", ["evopolicy", "local", "--env", "toy", "--agent", "evolve"], "local"),
        ("cryptography", ["evopolicy", "demo"], "local"),
        ("cryptography", ["evopolicy", "try", STILL, "--env", "toy/line"], "local"),
        ("starlette,uvicorn,h11", ["evopolicy", "web"], "coordinator"),
        ("starlette,uvicorn,h11", ["evopolicy", "suite", "smoke.toml", "--local"], "gateway"),
        ("cryptography", ["evopolicy-coordinator"], "coordinator"),
        ("jinja2,matplotlib", ["evopolicy", "report", "RUN", "--out", "report"], "coordinator"),
        ("gymnasium,mujoco,av", ["evopolicy-worker", "--env", "gym/acrobot"], "worker"),
    ],
    ids=lambda value: value if isinstance(value, str) else "_".join(value[:2]),
)
def test_a_command_without_its_extra_names_it(
    modules: str, words: list[str], extra: str, tmp_path: Path
) -> None:
    write_run(tmp_path / "RUN", [])
    done = without(modules, words, tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("error: ")
    assert re.search(rf"pip install .*\[{extra}\]'|the extra is {extra}\n", done.stderr)
    assert "Traceback" not in done.stderr


def test_a_program_without_its_extra_tells_its_version(tmp_path: Path) -> None:
    done = without("cryptography,uvicorn", ["evopolicy-coordinator", "--version"], tmp_path)
    assert (done.returncode, done.stdout.partition(" ")[0]) == (0, "evopolicy"), done.stderr
    done = without("cryptography,uvicorn", ["evopolicy-coordinator", "--help"], tmp_path)
    assert done.returncode == 2
    assert "evopolicy files docs/reference/cli.md`" in done.stderr


@pytest.mark.parametrize("words", [["status"], ["verify", "x"], ["data", "check", "x"], ["gc", "--dry-run"]])
def test_commands_that_serve_nothing_do_without_the_gateways_extra(words: list[str], tmp_path: Path) -> None:
    done = without("starlette,uvicorn,h11", ["evopolicy", *words], tmp_path)
    assert "pip install" not in done.stderr
    assert "Traceback" not in done.stderr
