"""`evopolicy` as an operator starts it: a child process, everything below which can be found, and a cluster for it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from coordinator_harness import Coordinator
from program_runs import run_program
from waiting import TIMEOUT_S, wait_until

from evopolicy_common.processes import proc
from evopolicy_common.records.run_record import RunRecord, decode_run_record

MARK = "EVOTEST_MARK"
SMALL = ["--budget", "6", "--validation", "2", "--heldout", "2"]

AGENT = """
import json, os, subprocess, sys, time, urllib.request

def submit(body, **headers):
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=json.dumps({"env_instances": body}).encode(), headers=headers
    )
    try:
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as error:
        return json.load(error)

def submit_policy(text, body):
    with open("system/policy.py", "w") as file:
        file.write(text)
    return submit(body)

def patient_submit(body, key):
    while True:
        try:
            return submit(body, **{"Idempotency-Key": key})
        except (OSError, ValueError):
            time.sleep(0.1)
"""


def agent(folder: Path, code: str) -> str:
    """`--agent` for a program with that code, which has `submit` and `patient_submit`."""
    path = folder / "agent.py"
    path.write_text(AGENT + code)
    return f"command:{sys.executable} {path}"


def evopolicy(
    cwd: Path | None,
    *args: str,
    code: int | None = None,
    program: str = "evopolicy_gateway.cli",
    **environment: str,
) -> subprocess.CompletedProcess[str]:
    """`evopolicy`, or another program of ours, with these arguments in `cwd`, to its end. `code`: the exit code that it
    has to have."""
    more = {"cwd": cwd, "env": {**os.environ, **environment}, "timeout": 1200}
    done = run_program(sys.executable, "-m", program, *args, **more)
    assert code in (None, done.returncode), done.stdout + done.stderr
    return done


def words(text: str) -> list[str]:
    """The words of a command line without quotes."""
    return text.split()


@contextlib.contextmanager
def process(
    log: Path, *arguments: str, cwd: Path | None = None, **environment: str
) -> Iterator[subprocess.Popen[bytes]]:
    """A module of ours, or a script, that runs, with its output in `log`, until the `with` is left."""
    words = [sys.executable, *(() if arguments[0].endswith(".py") else ("-m",)), *arguments]
    with log.open("ab") as out:
        running = subprocess.Popen(words, stdout=out, stderr=out, cwd=cwd, env={**os.environ, **environment})
    try:
        yield running
    finally:
        running.terminate()
        try:
            running.wait(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()


class Command:
    """`evopolicy` that runs; it and all that it starts carry a mark in their environment."""

    def __init__(self, cwd: Path, *arguments: str) -> None:
        self.mark = uuid.uuid4().hex
        self._out, self._err = cwd / f"{self.mark}.out", cwd / f"{self.mark}.err"
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "evopolicy_gateway.cli", *arguments],
                cwd=cwd,
                env={**os.environ, "XDG_STATE_HOME": str(cwd / "xdg"), MARK: self.mark},
                stdout=out,
                stderr=err,
            )

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    @property
    def text(self) -> str:
        """All that it has said."""
        return self.out + self.err

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Its exit code."""
        return self.process.wait(timeout=timeout_s)

    def finish(self, timeout_s: float = TIMEOUT_S) -> tuple[int, str, str]:
        """Exit code, standard output, standard error."""
        return self.wait(timeout_s), self.out, self.err

    def alive(self) -> list[int]:
        """The command and what it has started, as far as it lives."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdecimal():
                with contextlib.suppress(OSError):
                    state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                    if state != "Z" and f"{MARK}={self.mark}".encode() in (entry / "environ").read_bytes():
                        found.append(int(entry.name))
        return found

    def running(self, module: str) -> int:
        """The one process below it that runs this module."""
        (pid,) = [pid for pid in self.alive() if module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()]
        return pid

    def kill_below(self, words: bytes) -> bool:
        """Kills a Python process below it with these words in its command line; False when there is none just now."""
        for pid in proc.descendants(self.process.pid):
            with contextlib.suppress(OSError):
                line = Path(f"/proc/{pid}/cmdline").read_bytes()
                if words in line and b"python" in line.partition(b"\0")[0]:
                    os.kill(pid, signal.SIGKILL)
                    return True
        return False

    def kill(self) -> None:
        """Sends SIGKILL to the command alone, and waits until the processes that it started have noticed."""
        self.process.kill()
        self.process.wait()
        wait_until(lambda: not self.alive())

    def kill_all(self) -> None:
        """Sends SIGKILL to the command and all that it started, and waits until nothing of it lives."""

        def are_gone() -> bool:
            pids = self.alive()
            for pid in pids:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            return not pids

        wait_until(are_gone)
        self.process.wait()


@contextlib.contextmanager
def command(cwd: Path, *arguments: str) -> Iterator[Command]:
    """`evopolicy` with these arguments in `cwd`; nothing of it lives after the `with`."""
    # The mark has to pass the agent's jail too.
    marked = ("--jail-env", MARK) if arguments[0] in ("run", "local") else ()
    running = Command(cwd, *arguments, *marked)
    try:
        yield running
    finally:
        running.kill_all()


def ended(cwd: Path, *arguments: str, ends: int = 0) -> tuple[str, str]:
    """Standard output and standard error of `evopolicy`, which ends with that code."""
    with command(cwd, *arguments) as running:
        code, out, err = running.finish()
    assert code == ends, out + err
    return out, err


class Ran(NamedTuple):
    """A run named `t` that has ended, and what its command said."""

    folder: Path
    out: str
    err: str

    @property
    def record(self) -> RunRecord:
        return record_in(self.folder)


def ran_on(operator_file: Path, cwd: Path, agent_name: str, *more: str, ends: int = 0) -> Ran:
    """A run on that cluster, whose command ends with that code."""
    out, err = ended(cwd, *run_arguments(operator_file, agent_name), *more, ends=ends)
    return Ran(run_dir(cwd), out, err)


Plays = Callable[..., Ran]


@contextlib.contextmanager
def worker_of(
    coordinator: Coordinator, *options: str, **environment: str
) -> Iterator[subprocess.Popen[bytes]]:
    """A worker with these options, until the `with` is left; of two slots, if they do not say otherwise."""
    usual = {"--slots": "2", "--grace": "0", "--credentials": coordinator.ready["credentials"]["worker"]}
    words = [*options, *(f"{name}={value}" for name, value in usual.items() if name not in options)]
    own = {"XDG_STATE_HOME": str(coordinator.state.parent / "xdg"), **environment}
    with process(coordinator.log, "evopolicy_worker.cli", *words, **own) as running:
        yield running


@contextlib.contextmanager
def toy_cluster(root: Path, *arguments: str) -> Iterator[Path]:
    """The operator's credentials for a coordinator, with these arguments, and a worker with two slots for the toy
    environments."""
    with contextlib.ExitStack() as stack:
        coordinator = Coordinator(root / "s", *arguments)
        stack.callback(coordinator.stop)
        stack.enter_context(worker_of(coordinator, "--env", "toy", "--need-tier", "bwrap"))
        yield Path(coordinator.ready["credentials"]["operator"])


def run_arguments(operator_file: Path, agent_name: str) -> list[str]:
    arguments = ["run", "--env", "toy/line", "--agent", agent_name, "--exp-id", "t", *SMALL]
    return [*arguments, "--credentials", str(operator_file)]


def played_here(
    cwd: Path, agent_name: str, *more: str, timeout_s: float = TIMEOUT_S
) -> tuple[RunRecord, str]:
    """The record of a short run named `t` on a cluster of its own, and what the command said."""
    arguments = ["local", "--env", "toy/line", "--agent", agent_name, "--exp-id", "t", "--budget", "4"]
    with command(cwd, *arguments, "--validation", "1", "--heldout", "1", "--slots", "1", *more) as running:
        assert running.wait(timeout_s) == 0, running.text
        return record_in(run_dir(cwd)), running.text


STILL = str(Path(__file__).with_name("still"))
"""Folder of a policy that returns zeros."""


def run_dir(cwd: Path, env: str = "toy_line", exp_id: str = "t") -> Path:
    """The one run directory of that name."""
    (found,) = (cwd / "runs").glob(f"*/{env}/{exp_id}")
    return found


def record_in(folder: Path) -> RunRecord:
    return decode_run_record((folder / "run.json").read_bytes())
