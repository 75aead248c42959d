"""The selected policy in the workspace of a finished run."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from program_runs import run_python

NOBODY = 65534
PUTS = f"""
import os, sys
from pathlib import Path
from evopolicy_common.errors import ConfigError
from evopolicy_common.records.policies.bundles import Bundle, BundleFile
from evopolicy_gateway.run.record import _put_in_place

os.setuid({NOBODY})
try:
    _put_in_place(Path(sys.argv[1]), Bundle("", b"", (BundleFile("policy.py", False, b"x = 1"),)))
except ConfigError as error:
    print("told:", error)
"""


@pytest.fixture
def workspace() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp())
    yield folder
    shutil.rmtree(folder)


@pytest.mark.root  # files of two users
def test_folders_of_a_containers_root_are_named_with_the_remedy(workspace: Path) -> None:
    """Python in a container writes `__pycache__` as root."""
    system = workspace / "system"
    (system / "__pycache__").mkdir(parents=True)
    (system / "__pycache__" / "policy.pyc").touch()
    os.chown(workspace, NOBODY, NOBODY)
    os.chown(system, NOBODY, NOBODY)

    def put() -> str:
        done = run_python(PUTS, system)
        assert done.returncode == 0, done.stderr
        return done.stdout

    answer = put()
    assert f"told: {system} cannot be removed" in answer
    assert f"chown -R {NOBODY} {workspace}" in answer
    os.chown(system / "__pycache__", NOBODY, NOBODY)
    assert put() == ""
    assert [path.name for path in system.iterdir()] == ["policy.py"]
