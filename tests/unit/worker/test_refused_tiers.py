"""A machine that forbids user namespaces: a worker that needs the sandbox ends with one line, which has the remedy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

WORKER = [sys.executable, "-m", "evopolicy_worker.cli", "--env", "toy/line", "--need-tier", "bwrap"]
FORBIDDEN = 'echo 0 > /proc/sys/user/max_user_namespaces && exec "$@"'
BWRAP = """#!/bin/sh
echo 'bwrap: setting up uid map: Permission denied' >&2
exit 1
"""


@pytest.mark.parametrize("how", ["by a limit of namespaces", "by AppArmor"])
def test_a_worker_without_its_sandbox_says_how_to_permit_it(how: str, tmp_path: Path) -> None:
    """The limit is real, in a namespace of the test's own, whose root the worker is. AppArmor is a stand-in."""
    (tmp_path / "bwrap").write_text(BWRAP)
    (tmp_path / "bwrap").chmod(0o755)
    limited = ["unshare", "--user", "--map-root-user", "sh", "-c", FORBIDDEN, "sh"]
    done = subprocess.run(
        [*(limited if "limit" in how else []), *WORKER, "--ready-file", str(tmp_path / "never")],
        env=os.environ | ({} if "limit" in how else {"PATH": f"{tmp_path}:{os.environ['PATH']}"}),
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )
    lines = done.stderr.splitlines()
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert lines[-1].startswith("error: sandbox tier bwrap does not work here: "), lines
    assert "permit user namespaces" in lines[-1]
    assert "--tier" in lines[-1]
