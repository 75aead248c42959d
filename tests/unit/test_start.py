"""The start of a command: what it imports, and Ctrl-C meanwhile."""

from __future__ import annotations

import os

import pytest
from program_runs import run_python

LARGE = {
    *("asyncio", "cryptography", "jinja2", "logging", "matplotlib", "msgspec", "numpy", "orjson", "rich"),
    *("socket", "ssl", "starlette", "structlog", "tempfile", "tomllib", "uvicorn", "zenoh", "zstandard"),
    *("evopolicy_coordinator", "evopolicy_results", "evopolicy_worker"),
    *("evopolicy_gateway.cli.play", "evopolicy_gateway.operator"),
}
"""Modules that take longer to import than typer, or import it."""
ASYNCIO = {"asyncio", "logging", "socket", "ssl", "tempfile"}
"""asyncio, and what it imports."""
LISTED = "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); "
FRONT = LISTED + "sys.argv[0] = 'evopolicy'; from evopolicy_gateway.cli.main import main; main()"


def imported(program: str, *words: str, **environment: str) -> set[str]:
    """Names of all modules that are there when the program ends."""
    done = run_python(program, *words, env=os.environ | environment)
    assert done.returncode == 0
    assert done.stdout
    return set(done.stderr.split())


def test_the_help_imports_nothing_large() -> None:
    found = imported(FRONT, "--help")
    assert "typer" in found  # the list is one of modules
    assert not found & LARGE


def test_the_version_and_a_completed_name_import_nothing_large_either() -> None:
    assert not imported(FRONT, "--version") & LARGE
    asked = {"_EVOPOLICY_COMPLETE": "complete_bash", "COMP_WORDS": "evopolicy --ver", "COMP_CWORD": "1"}
    # typer itself asks bash for its version with asyncio.
    assert not imported(FRONT, **asked) & LARGE - ASYNCIO


def test_a_run_ends_without_scipy() -> None:
    """A gateway alone does not install it."""
    ends = "import evopolicy_gateway.suite.runs, numpy, evopolicy_common.statistics.intervals as intervals; "
    found = imported(f"{LISTED}{ends}print(intervals.over_cases(numpy.arange(8.0)).low)")
    assert "evopolicy_gateway.suite.runs" in found
    assert "scipy" not in found


def test_processes_log_without_importing_rich() -> None:
    ours = ("coordinator.server.service", "gateway.cli.serve", "worker.supervisor")
    names = [f"evopolicy_{name}" for name in (*ours, "gateway.agent_supervisor.supervisor")]
    found = imported(f"{LISTED}import {', '.join(names)}; print('imported')")
    assert {"structlog", *names} <= found
    assert "rich" not in found


CTRL_C = """
import os, signal, sys

module, program = sys.argv.pop(1), sys.argv.pop(1)


class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                pass  # as in a callback of the import system, which an exception does not leave


sys.meta_path.insert(0, Finder())
from evopolicy_common import entry

getattr(entry, program)()
"""
"""Starts a program, and sends it Ctrl-C when it imports a module."""


@pytest.mark.parametrize(
    ("module", "program", "word"),
    [
        ("typer", "evopolicy", "--help"),
        ("typer", "coordinator", "--help"),
        ("typer", "worker", "--help"),
        ("evopolicy_coordinator.cli.status", "evopolicy", "status"),
        ("evopolicy_coordinator.server", "coordinator", "identity"),
        ("evopolicy_worker.supervisor", "worker", "doctor"),
    ],
)
def test_ctrl_c_during_the_imports_ends_a_program_with_one_line(module: str, program: str, word: str) -> None:
    done = run_python(CTRL_C, module, program, word)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")
