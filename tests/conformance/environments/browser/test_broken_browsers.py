"""A browser that is none, dies, or hangs: the error names the program and the remedy, and nothing of it is left."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import wait_until

from evopolicy_common.errors import WorkerError
from evopolicy_worker.environments import make, missing
from evopolicy_worker.environments.browser import chromium, page
from evopolicy_worker.environments.checks import conformance
from evopolicy_worker.environments.interface.settings import BROWSER

pytestmark = pytest.mark.families

ENV = "miniwob/click-test-v1"
BROKEN = {
    "it ends at once": (b"#!/bin/sh\n", "has ended|has gone"),
    "it dies with words": (
        b"#!/bin/sh\necho 'libnss3.so: not found' >&2\nexit 127\n",
        "libnss3.so: not found",
    ),
    "it hangs": (b"#!/bin/sh\nexec sleep 1000\n", "it hangs"),
    "it is of another machine": (b"\x7fELF\x02\x01\x01" + bytes(100), "Exec format error"),
    "it says something else": (b"#!/bin/sh\nprintf 'hello\\0' >&4\nexec sleep 1000\n", "an invalid reply"),
    "it has no version": (b"#!/bin/sh\nprintf '{\"id\":1}\\0' >&4\nexec sleep 1000\n", "version"),
    "it dies after its first answer": (
        b"""#!/bin/sh\nhead -c 1 <&3 > /dev/null\nprintf '{"id":1,"result":{"product":"a"}}\\0' >&4\n""",
        "opens no page",
    ),
}


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where profiles are kept; no browser has started before, and none of these is kept for other tests."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setattr(chromium, "START_S", 2.0)
    page.shared().lose()
    page.shared.cache_clear()
    yield folder
    monkeypatch.undo()
    page.shared.cache_clear()
    chromium.program.cache_clear()


def use(path: Path | str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(BROWSER, str(path))
    chromium.program.cache_clear()


def running_in(folder: Path) -> list[str]:
    """Processes whose home is below a folder, as a browser's is."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if f"HOME={folder}".encode() in path.read_bytes():
                found.append(path.parent.name)
    return found


@pytest.mark.parametrize("how", BROKEN)
def test_an_error_names_the_program_what_it_did_and_the_remedy(
    how: str, scratch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, told = BROKEN[how]
    program = tmp_path / "browser"
    program.write_bytes(content)
    program.chmod(0o755)
    use(program, monkeypatch)
    with pytest.raises(WorkerError, match=told) as error:
        make(ENV)
    assert str(program) in str(error.value)
    assert "EVOPOLICY_BROWSER" in str(error.value)
    assert not list(scratch.iterdir())
    assert not running_in(scratch)


@pytest.mark.parametrize("program", ["/nonexistent", "/etc/passwd", "/usr"])
def test_what_is_no_program_is_named_before_anything_starts(
    program: str, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(program, monkeypatch)
    assert program in missing(ENV)
    assert "EVOPOLICY_BROWSER" in missing(ENV)
    with pytest.raises(WorkerError, match=f"'{program}' is no program"):
        make(ENV)


@pytest.mark.parametrize(
    ("program", "code", "told"),
    [("/bin/true", 1, "/bin/true does not start as a browser"), ("/nonexistent", 2, "/nonexistent")],
)
def test_a_command_says_it_too(program: str, code: int, told: str) -> None:
    command = [sys.executable, "-P", "-m", "evopolicy_worker.cli", "check-env", ENV]
    known = os.environ | {BROWSER: program}
    done = subprocess.run(command, env=known, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == code, done.stderr
    assert told in done.stdout + done.stderr


ENDING = f"""
import tempfile
from evopolicy_worker.environments import make
make({ENV!r})
assert any(name.startswith("browser-") for name in os.listdir(tempfile.gettempdir()))
"""


@pytest.mark.parametrize("end", ["", "if os.fork() == 0: sys.exit()\nos.wait()", "raise SystemExit(3)"])
def test_a_process_that_ends_removes_its_browser_and_the_profile(end: str, tmp_path: Path) -> None:
    program = f"import os, sys\n{ENDING}\n{end}"
    variables = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-P", "-c", program], env=variables, check=False, timeout=120)
    assert done.returncode == (3 if "3" in end else 0)
    assert not list(tmp_path.iterdir())
    assert not running_in(tmp_path)


def test_a_check_leaves_no_profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (played,) = conformance.play_all([ENV], 2)
    assert played.verdict(None) == "ok"
    assert not list(tmp_path.iterdir())
    wait_until(lambda: not running_in(tmp_path))
