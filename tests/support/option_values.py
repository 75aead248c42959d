"""Gives every option and argument of every command bad values, and tells the command's faults.

A command runs in a fork of a process that has imported it, in a folder of its own. It is stopped where it would start
another program: by then it has accepted its options.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import functools
import gc
import importlib
import os
import resource
import select
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import typer
from helper_process import HelperProcess, serve

from evopolicy_gateway.harnesses import FORMS

VALUES = {
    "empty": "",
    "blanks": "   ",
    "parent": "..",
    "control": "a\x1b[2Jb",
    "line": "a\nerror: b",
    "long": "x" * 100_000,
    "unicode": "\udcff\udcfe",
    "negative": "-1",
    "zero": "0",
    "enormous": "9" * 30,
    "infinite": "1e309",
    "nan": "nan",
    "inf": "inf",
    "underscore": "1_000",
    "pipe": "pipe",
    "device": "device",
    "folder": "folder",
    "missing": "no/such",
    "binary": "binary",
    "locked": "locked/file",
    "twice": "",
}
"""Values by their names. `twice` stands for the option given two times."""
NEVER_TEXT = ("empty", "blanks", "control", "line", "long", "unicode")
"""Values that no option takes."""
NEVER_NUMBER = ("infinite", "nan", "inf", "underscore", "pipe", "device", "folder", "missing", "binary")
"""Values that no number takes."""
SEVERAL_LINES = {("evopolicy local", "agent"), ("evopolicy run", "agent")}
"""Options whose values may have several lines: an agent may be a shell script."""
BASES = {
    "evopolicy demo": ["--runs=played"],
    "evopolicy try": ["{policy_dir}", "--env=toy/line", "--state=new"],
    "evopolicy local": [
        "--env=toy/line",
        "--agent=random",
        "--jail=none",
        "--tier=none",
        "--runs=played",
        "--state=new",
    ],
    "evopolicy run": ["--env=toy/line", "--agent=random", "--jail=none", "--tier=none", "--runs=played"],
    "evopolicy harbor": ["--http=127.0.0.1:TAKEN"],
    "evopolicy suite": ["{file}", "--runs=played"],
    "evopolicy report": ["folder", "--out=report"],
    "evopolicy export": ["{runs}", "--to=csv"],
    "evopolicy publish": ["{runs}", "--out=new.evp"],
    "evopolicy leaderboard": ["{files}", "--out=board"],
    "evopolicy rescore": ["{runs}", "--cases=8"],
    "evopolicy runs repin": ["{run}", "{fingerprint_class}", "--reason=lost"],
    "evopolicy disk": ["--state=state"],
    "evopolicy gc": ["--state=state", "--dry-run"],
    "evopolicy web": ["--http=127.0.0.1:TAKEN"],
    "evopolicy data make": ["--env=toy/line", "--root=splits", "--train=2", "--valid=2", "--heldout=2"],
    "evopolicy-coordinator": ["--state=new", "--listen=tcp/127.0.0.1:TAKEN"],
    "evopolicy-coordinator identity": ["--state=state"],
    "evopolicy-coordinator countersign": ["{head}", "--out=head.json", "--state=state"],
    "evopolicy-coordinator router-config": ["{name}", "--folder=router", "--state=state"],
    "evopolicy-coordinator backup": ["{target}", "--state=state"],
    "evopolicy-coordinator certs init": ["--state=state"],
    "evopolicy-coordinator certs issue": ["{role}", "{name}", "--state=state", "--out=issued"],
    "evopolicy-coordinator certs revoke": ["{name}", "--state=state"],
    "evopolicy-coordinator certs list": ["--state=state"],
    "evopolicy-coordinator epoch list": ["--state=state"],
    "evopolicy-coordinator epoch new": ["--state=state"],
    "evopolicy-worker": ["--env=toy/line"],
    "evopolicy-worker check-env": ["{env}", "--steps=2"],
    "evopolicy-worker setup": ["{family}"],
}
"""The words of a command that is otherwise right. Where a command has no words here, its required arguments stand
alone."""
ARGUMENTS = {
    "policy_dir": "policy",
    "run_directory": "runs/Agent-A/gym_acrobot/exp",
    "runs": "runs",
    "run": "runs/Agent-A/gym_acrobot/exp",
    "left": "runs/Agent-A/gym_acrobot/exp",
    "right": "runs/Agent-A/gym_acrobot/exp",
    "file": "suite.toml",
    "files": "binary",
    "worker": "lab-1",
    "environment": "my/glider@0123456789abcdef",
    "fingerprint_class": "b23d564d30c1",
    "which": "prompts",
    "folder": "folder",
    "head": "0" * 64,
    "target": "backup",
    "role": "worker",
    "name": "lab-1",
    "env": "toy/line",
    "family": "miniwob",
}
"""A right value for each argument, by its name."""
SUITE = """
name = "sweep"
environments = ["toy/line"]
[[agents]]
name = "random"
agent = "random"
"""
LOCKED = "home/here/locked"
"""The folder of the value `locked`, which only root can read."""
SECONDS = 60.0
"""The longest time of a command on a busy machine: none of these waits for anything."""
BEGAN = 99
MOST_TEXT = 4_000
"""Characters of an error."""


class Case(NamedTuple):
    """A command, one of its parameters (none: none is bad), and the name of a value."""

    command: str
    parameter: str
    value: str


class Outcome(NamedTuple):
    """A finished command: exit code (None: it hung), both outputs, and the changes in its folder."""

    code: int | None
    out: str
    err: str
    changes: tuple[str, ...]


@functools.cache
def cases() -> list[Case]:
    """Every parameter with every value, in a stable order."""
    return [
        Case(name, parameter.name, value)
        for name, command in _commands()
        for parameter in command.params
        for value in VALUES
        if value != "twice" or parameter.param_type_name == "option"
        if parameter.name not in ("help", "version", "install_completion", "show_completion")
    ]


@contextlib.contextmanager
def player(folder: Path) -> Iterator[Player]:
    """Plays cases below `folder`."""
    process = HelperProcess(__file__, str(folder))
    try:
        yield Player(process)
    finally:
        process.close()


class Player:
    """The process that forks the commands."""

    def __init__(self, process: HelperProcess) -> None:
        self._process = process

    def faults(self, case: Case) -> list[str]:
        """What is wrong with the command's answer to a bad value; empty if nothing is."""
        return self._process.ask(case)


class _Server:
    """The other side of a `Player`."""

    def __init__(self, folder: Path, port: int) -> None:
        self._folder = folder
        self._port = port
        self._commands = dict(_commands())
        self._bases: dict[str, Outcome] = {}
        self._make(folder / "template")
        self._renew()

    def faults(self, case: Case) -> list[str]:
        command = self._commands[case.command]
        parameter = next(each for each in command.params if each.name == case.parameter)
        if case.command not in self._bases:
            self._bases[case.command] = self._run(case.command.split() + self._words(case.command, None, []))
        base = self._bases[case.command]
        given = self._given(case, parameter)
        done = self._run(case.command.split() + self._words(case.command, parameter, given))
        return list(_judged(case, parameter, given[0], base, done))

    def _given(self, case: Case, parameter: Any) -> list[str]:
        if case.value != "twice":
            return [VALUES[case.value]]
        usual = [word for word in self._base(case.command) if word.startswith(f"{parameter.opts[0]}=")]
        return [usual[0].partition("=")[2] if usual else ARGUMENTS.get(parameter.name, "1")] * 2

    def _base(self, command: str) -> list[str]:
        required = [f"{{{each.name}}}" for each in self._commands[command].params if each.required]
        return [word.replace("TAKEN", str(self._port)) for word in BASES.get(command, required)]

    def _words(self, command: str, parameter: Any, values: list[str]) -> list[str]:
        """The words of a command with these values of a parameter."""
        options, arguments = [], []
        is_option = parameter is not None and parameter.param_type_name == "option"
        for word in self._base(command):
            if not word.startswith("{"):
                if not (is_option and word.partition("=")[0] in parameter.opts):
                    options.append(word)
            elif parameter is None or word[1:-1] != parameter.name:
                arguments.append(ARGUMENTS[word[1:-1]])
            else:
                arguments += values
                values = []
        if is_option:
            flag = getattr(parameter, "is_flag", False)
            words = (
                [parameter.opts[0]] * len(values)
                if flag and len(values) > 1
                else [f"{parameter.opts[0]}={each}" for each in values]
            )
            return [*options, *words, "--", *arguments]
        return [*options, "--", *arguments, *values]

    def _run(self, words: list[str]) -> Outcome:
        before = self._before
        with contextlib.ExitStack() as stack:
            files = [stack.enter_context(tempfile.TemporaryFile()) for _ in range(3)]
            pid = os.fork()
            if pid == 0:
                self._play(words, *(file.fileno() for file in files))
            code = self._wait(pid)
            out, err, modules = (
                os.pread(file.fileno(), 200_000, 0).decode(errors="replace") for file in files
            )
        # The next fork need not import them.
        for name in modules.split():
            with contextlib.suppress(Exception):
                importlib.import_module(name)
        after = _tree(self._folder / "w")
        changes = tuple(
            f"{'-' if path not in after else '+' if path not in before else '!'}{path}"
            for path in sorted(before.keys() | after.keys())
            if before.get(path) != after.get(path)
        )
        if changes:
            self._renew()
        return Outcome(code, out, err, changes)

    def _wait(self, pid: int) -> int | None:
        fd = os.pidfd_open(pid)
        ended, _, _ = select.select([fd], [], [], SECONDS)
        os.close(fd)
        if not ended:
            os.killpg(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        return os.waitstatus_to_exitcode(status) if ended else None

    def _play(self, words: list[str], out: int, err: int, modules: int) -> None:
        """In the fork: becomes the command."""
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (out, 1), (err, 2)):
            os.dup2(source, target)
        sys.stdin, sys.stdout, sys.stderr = (
            os.fdopen(fd, mode, closefd=False) for fd, mode in ((0, "r"), (1, "w"), (2, "w"))
        )
        resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
        resource.setrlimit(resource.RLIMIT_FSIZE, (64 << 20, 64 << 20))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        place = self._folder / "w" / "home" / "here"
        os.chdir(place)
        for name in ("HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
            os.environ[name] = str(place.parent)
        os.environ.pop("EVOPOLICY_STATE", None)
        known = set(sys.modules)

        def end(code: int) -> None:
            with contextlib.suppress(Exception):
                os.write(modules, " ".join(sys.modules.keys() - known).encode())
            os._exit(code)

        def stopped(event: str, arguments: tuple[Any, ...]) -> None:
            if event in ("subprocess.Popen", "os.posix_spawn", "os.exec"):
                words = arguments[1] if not isinstance(arguments[1], str) else [arguments[1]]
                if any("python" in os.fsdecode(word) or "evopolicy" in os.fsdecode(word) for word in words):
                    end(BEGAN)

        sys.addaudithook(stopped)
        sys.argv = words
        code = 1
        try:
            _main(words[0])()
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else int(error.code is not None)
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            end(code)

    def remove(self) -> None:
        """Removes the folder in which commands are played."""
        with contextlib.suppress(FileNotFoundError):
            (self._folder / "w" / LOCKED).chmod(0o700)
        shutil.rmtree(self._folder / "w", ignore_errors=True)

    def _renew(self) -> None:
        self.remove()
        subprocess.run(["cp", "-a", self._folder / "template", self._folder / "w"], check=True)
        # Here and not in the template, which has to be read.
        (self._folder / "w" / LOCKED).chmod(0)
        self._before = _tree(self._folder / "w")

    def _make(self, template: Path) -> None:
        from invented.run_dirs import write_run

        from evopolicy_coordinator.pki import machines
        from evopolicy_coordinator.storage.state_folder import StateFolder
        from evopolicy_coordinator.storage.store import Store

        here = template / "home" / "here"
        here.mkdir(parents=True)
        write_run(here / "runs", [])
        os.mkfifo(here / "pipe")
        try:
            os.mknod(here / "device", stat.S_IFCHR | 0o666, os.makedev(1, 5))
        except PermissionError:
            (here / "device").symlink_to("/dev/zero")
        (here / "folder").mkdir()
        (here / "folder" / "kept").write_text("kept\n")
        (here / "locked").mkdir()
        (here / "locked" / "file").write_bytes(bytes(range(256)))
        (here / "binary").write_bytes(bytes(range(256)) * 16)
        (here / "suite.toml").write_text(SUITE)
        (here / "policy").mkdir()
        (here / "policy" / "policy.py").write_text("class Policy:\n    pass\n")
        now = dt.datetime.now(dt.UTC)
        StateFolder.open(here / "state").close()
        Store(here / "state" / "coordinator.sqlite").close()
        machines.init(here / "state", "local", ("localhost",), now, 30, anew=False)


def _judged(case: Case, parameter: Any, given: str, base: Outcome, done: Outcome) -> Iterator[str]:
    """The faults of an answer to a value; `base`: the answer to the command without it."""
    shown = done.err[-600:]
    if done.code is None:
        yield f"hangs: {shown!r}"
        return
    if "Traceback" in done.err + done.out:
        yield f"a traceback: {shown!r}"
        return
    if done.code not in (0, 1, 2, 3, BEGAN):
        yield f"exit code {done.code}: {shown!r}"
        return
    if case.value in _never(case, parameter):
        if done.code in (0, BEGAN):
            yield f"is accepted: {done.out[-200:]!r} {shown!r}"
        elif not _named(parameter, done):
            yield f"is not named: {shown!r}"
    refused = done.code not in (0, BEGAN)
    if refused and not _same(parameter, base, done):
        lines = [line for line in done.err.splitlines() if line not in FORMS] or [""]
        errors = [line for line in lines if line.startswith("error: ")]
        if len(errors) != 1 or lines[-1] != errors[0]:
            yield f"not one line: {done.out[-200:]!r} {shown!r}"
        if len(done.err) > MOST_TEXT:
            yield f"{len(done.err)} characters: {shown!r}"
        # A folder may be named by its whole path, a number with commas.
        shown_as = [given.strip()[:12] or "?", *(["/w/home "] if case.value == "parent" else [])]
        plain = done.err.replace(",", "")
        if not any(each in done.err or each in plain for each in shown_as) and not _named(parameter, done):
            yield f"does not name the value: {shown!r}"
    may_write = not refused or _same(parameter, base, done)
    harmed = [
        each for each in done.changes if each not in base.changes and not (may_write and each[0] == "+")
    ]
    is_wanted = case.value == "twice" and getattr(parameter, "is_flag", False)
    if harmed and not is_wanted:
        yield f"changes {harmed[:9]}, exit code {done.code}: {shown!r}"


def _same(parameter: Any, base: Outcome, done: Outcome) -> bool:
    """Whether the command ended as it does without the value."""
    last = [outcome.err.splitlines()[-1:] for outcome in (base, done)]
    is_error = "error: " in base.err
    changes_output = getattr(parameter, "is_flag", False) or not is_error
    return base.code == done.code and (last[0] == last[1] or changes_output)


def _named(parameter: Any, done: Outcome) -> bool:
    """Whether an error names the parameter."""
    names = (
        parameter.opts
        if parameter.param_type_name == "option"
        else [f"'{parameter.name}'", str(parameter.metavar)]
    )
    return any(name in done.err for name in names)


def _never(case: Case, parameter: Any) -> Sequence[str]:
    if getattr(parameter, "is_flag", False):
        return [each for each in VALUES if each != "twice"]
    never = [
        each for each in NEVER_TEXT if each != "line" or (case.command, case.parameter) not in SEVERAL_LINES
    ]
    return [*never, *NEVER_NUMBER] if _is_number(dict(_commands())[case.command], parameter) else never


def _is_number(command: Any, parameter: Any) -> bool:
    def taken(value: str) -> Any:
        with contextlib.suppress(typer.BadParameter):
            return parameter.process_value(typer.Context(command), value)

    return any(isinstance(taken(each), int | float) for each in ("1", "64"))


def _tree(folder: Path) -> dict[str, Any]:
    found = {}
    for parent, names, files in os.walk(folder):
        for name in (*names, *files):
            path = os.path.join(parent, name)
            info = os.lstat(path)
            what = (info.st_size, info.st_mtime_ns) if not stat.S_ISDIR(info.st_mode) else ()
            found[os.path.relpath(path, folder)] = (info.st_mode, *what)
    return found


def _commands() -> Sequence[tuple[str, Any]]:
    from documents import commands

    return commands()


def _main(program: str) -> Any:
    module, function = {
        "evopolicy": ("evopolicy_gateway.cli.main", "main"),
        "evopolicy-coordinator": ("evopolicy_coordinator.cli", "program"),
        "evopolicy-gateway": ("evopolicy_gateway.cli", "gateway_program"),
        "evopolicy-worker": ("evopolicy_worker.cli", "main"),
    }[program]
    return getattr(importlib.import_module(module), function)


def _serve(folder: Path) -> None:
    # The forks find the commands made: each would spend most of its time on making them anew.
    typer.main.get_command = functools.cache(typer.main.get_command)
    _commands()
    gc.collect()
    gc.freeze()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        server = _Server(folder, taken.getsockname()[1])
        try:
            serve(lambda request: server.faults(Case(*request)))
        finally:
            server.remove()


if __name__ == "__main__":
    _serve(Path(sys.argv[1]))
