"""The tutorial, executed as it stands in a folder of its own."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(900)]

DOCS = Path(__file__).parents[3] / "docs"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def test_the_tutorial_works_as_written(tmp_path: Path) -> None:
    programs = tmp_path / ".venv" / "bin"
    programs.parent.mkdir()
    programs.symlink_to(Path(sys.executable).parent)
    environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path / "state"), "PWD": str(tmp_path)}
    ran = []
    for language, code in FENCE.findall((DOCS / "tutorial.md").read_text()):
        if language == "python":
            path = tmp_path / code.splitlines()[0].removeprefix("# ")
            path.parent.mkdir(exist_ok=True)
            path.write_text(code)
            continue
        for line in code.splitlines():
            if line == "make install":
                line = ".venv/bin/evopolicy demo"  # as the README has it; its run is in the tutorial's report
            words = [os.path.expandvars(word.replace("$PWD", str(tmp_path))) for word in shlex.split(line)]
            done = subprocess.run(
                words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
            ran.append(words[1])
    assert ran == ["demo", "try", "local", "local", "report", "verify"]
    assert (tmp_path / "report" / "index.html").is_file()
