"""The first hour: an ordinary user with a fresh clone and a terminal of 80 columns follows the README and the
tutorial to the letter, and then every line `next: …` that was printed.

Only the packages are those of the environment that runs the tests: the clone's `.venv` finds them behind its own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import site
import struct
import subprocess
import tempfile
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
from ordinary_user import ordinary, own_all

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(1800)]

ROOT = Path(__file__).parents[3]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMANDS = ("make ", ".venv/bin/", "export ")
STAMPS = (".core", ".families", ".installed")
"""Of the Makefile: everything is installed."""


class Newcomer:
    """A user in a clone, at a terminal."""

    def __init__(self, home: Path) -> None:
        self.clone = home / "evopolicy"
        python, self.prefix = ordinary()
        listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.check_output(listed, cwd=ROOT, text=True).split("\0")
        there = "\n".join(name for name in names if (ROOT / name).is_file())
        self.clone.mkdir()
        copy = ["cp", "--parents", "--no-dereference", "-t", str(self.clone)]
        subprocess.run(["xargs", "-d", "\n", *copy], cwd=ROOT, input=there, text=True, check=True)
        own_all(home, self.prefix)
        self.environment = {
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "HOME": str(home),
            "LANG": "C.UTF-8",
            "TERM": "xterm",
        }
        self.run(f"{python} -m venv --without-pip .venv")
        (packages,) = (self.clone / ".venv" / "lib").glob("python3*/site-packages")
        (packages / "third_party.pth").write_text("\n".join(site.getsitepackages()) + "\n")
        install = "-m pip install -q --no-deps --no-index --no-build-isolation --ignore-installed -e ."
        self.run(f".venv/bin/python {install}")
        for name in STAMPS:
            (self.clone / ".venv" / name).touch()

    def run(self, line: str) -> str:
        """What the terminal shows."""
        terminal, end = pty.openpty()
        fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        process = subprocess.Popen(
            [*self.prefix, "bash", "-euc", line],
            cwd=self.clone,
            env=self.environment | {"PWD": str(self.clone)},
            stdin=end,
            stdout=end,
            stderr=end,
            start_new_session=True,
        )
        os.close(end)
        shown = b""
        with contextlib.suppress(OSError):  # the other end is closed
            while piece := os.read(terminal, 65536):
                shown += piece
        os.close(terminal)
        text = shown.decode().replace("\r\n", "\n")
        assert process.wait() == 0, f"{line}\n{text[-4000:]}"
        return text


@pytest.fixture
def newcomer() -> Iterator[Newcomer]:
    # Not below pytest's own folder, which is closed to other users.
    with tempfile.TemporaryDirectory(prefix="evp-clone-") as name:
        yield Newcomer(Path(name))


def test_a_newcomer_follows_the_first_pages_and_every_printed_hint(newcomer: Newcomer) -> None:
    shown: dict[str, str] = {}
    for page in ("README.md", "docs/tutorial.md"):
        for language, code in FENCE.findall((ROOT / page).read_text()):
            if language == "python":
                path = newcomer.clone / code.splitlines()[0].removeprefix("# ")
                path.parent.mkdir(exist_ok=True)
                path.write_text(code)
                own_all(newcomer.clone, newcomer.prefix)
            elif code.startswith(COMMANDS):
                # Without the tests, of which this is one.
                shown[code] = newcomer.run(re.sub(r"^make test .*\n", "", code, flags=re.MULTILINE))
    (agent, *_) = (text for code, text in shown.items() if "$PWD/my_agent.py" in code)
    assert re.search(r"^gym/continuouscar +9\d\.\d+ .* submit 2 ", agent, re.MULTILINE), "as the README says"
    shown["doctor"] = newcomer.run(".venv/bin/evopolicy doctor")
    while hints := set(re.findall(r"^next: (.+)$", "\n".join(shown.values()), re.MULTILINE)) - shown.keys():
        shown |= {hint: newcomer.run(hint) for hint in sorted(hints)}
    assert {".venv/bin/evopolicy demo", ".venv/bin/evopolicy report runs --out report"} <= shown.keys()
    assert (newcomer.clone / "report" / "index.html").is_file()
