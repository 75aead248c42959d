"""A process of a test's own that answers each line of JSON with one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

_REASON = 2_000
"""Characters of its last output."""


class HelperProcess:
    """A script of ours with `words`. When it ends early, one test fails with its last output and the others are
    skipped."""

    def __init__(self, script: Path | str, *words: str) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        paths = {"PYTHONPATH": str(Path(__file__).parent)}
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(script), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | paths,
        )
        self._ended = ""

    def ask(self, request: Any) -> Any:
        if self._ended:
            pytest.skip(f"{self._ended}, as the first failure says")
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            print(json.dumps(request), file=self._process.stdin, flush=True)
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if answer:
            return json.loads(answer)
        self._ended = f"{Path(self._process.args[2]).name} ended with exit code {self._process.wait()}"  # type: ignore[index]
        self._errors.seek(0)
        last = self._errors.read().decode(errors="replace")[-_REASON:]
        pytest.fail(f"{self._ended}:\n{last}", pytrace=False)

    def close(self) -> None:
        with self._errors:
            self._process.communicate()


def serve(answer: Callable[[Any], Any]) -> None:
    """In the process: answers the requests. Whatever else it prints goes to stderr."""
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)
        for line in sys.stdin:
            print(json.dumps(answer(json.loads(line))), file=answers, flush=True)
