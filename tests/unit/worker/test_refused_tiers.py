"""A machine that forbids user namespaces: a worker that needs the sandbox ends with one line, which has the remedy."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from program_runs import put_program, run_program

WORKER = [sys.executable, "-m", "evopolicy_worker.cli", "--env", "toy/line", "--need-tier", "bwrap"]
FORBIDDEN = 'echo 0 > /proc/sys/user/max_user_namespaces && exec "$@"'
BWRAP = "echo 'bwrap: setting up uid map: Permission denied' >&2\nexit 1"


@pytest.mark.parametrize("how", ["by a limit of namespaces", "by AppArmor"])
def test_a_worker_without_its_sandbox_says_how_to_permit_it(how: str, tmp_path: Path) -> None:
    """The limit is real, in a namespace of the test's own, whose root the worker is. AppArmor is a stand-in."""
    put_program(tmp_path / "bwrap", BWRAP)
    limited = ["unshare", "--user", "--map-root-user", "sh", "-c", FORBIDDEN, "sh"]
    words = [*(limited if "limit" in how else []), *WORKER, "--ready-file", str(tmp_path / "never")]
    path = os.environ["PATH"] if "limit" in how else f"{tmp_path}:{os.environ['PATH']}"
    done = run_program(*words, env=os.environ | {"PATH": path}, timeout=150)
    lines = done.stderr.splitlines()
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert lines[-1].startswith("error: sandbox tier bwrap does not work here: "), lines
    assert "permit user namespaces" in lines[-1]
    assert "--tier" in lines[-1]
