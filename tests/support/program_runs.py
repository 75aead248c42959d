"""Programs of a test's own, and how a program ended with all that it said."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any


def put_program(path: Path, text: str) -> Path:
    """An executable file with that text: a script of `sh`, where its first line names no other program."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text if text.startswith("#!") else f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def run_program(*words: str | Path, **more: Any) -> subprocess.CompletedProcess[str]:
    """The end of a program, whatever its exit status unless `check`; `more`: of `subprocess.run`."""
    options = {"capture_output": True, "text": True, "timeout": 120.0, "check": False, **more}
    return subprocess.run([*map(str, words)], **options)


def run_python(code: str, *words: str | Path, **more: Any) -> subprocess.CompletedProcess[str]:
    return run_program(sys.executable, "-c", code, *words, **more)
