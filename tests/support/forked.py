"""Commands of ours as processes that are forked where all that commands import is imported: without the start of
Python."""

from __future__ import annotations

import gc
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

BIN = Path(sys.executable).parent


class Ended(NamedTuple):
    """A finished command."""

    returncode: int
    stdout: str
    stderr: str


class Forks:
    """The process that forks the commands."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(
        self, words: list[str], cwd: Path | None = None, *, unread: bool = False, **environment: str
    ) -> Ended:
        """The command with these words, to its end. `unread`: its standard output is a pipe that nobody reads."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = [words, str(cwd or Path.cwd()), unread, os.environ | environment]
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return Ended(*json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        self._process.communicate()


def _output(unread: bool) -> int:
    if not unread:
        return os.memfd_create("stdout")
    reader, writer = os.pipe()
    os.close(reader)
    return writer


def _become(words: list[str], cwd: str, environment: dict[str, str], *outputs: int) -> None:
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    for target, source in enumerate((os.open(os.devnull, os.O_RDONLY), *outputs)):
        os.dup2(source, target)
    sys.argv = [str(BIN / words[0]), *words[1:]]
    getattr(importlib.import_module("evopolicy_common.entry"), words[0].rpartition("evopolicy-")[2])()


def _serve() -> None:
    from documents import commands

    commands()
    gc.collect()
    gc.freeze()  # or each child would look through, and so copy, all of it at its end
    for line in sys.stdin:
        words, cwd, unread, environment = json.loads(line)
        outputs = _output(unread), os.memfd_create("stderr")
        child = os.fork()
        if not child:
            _become(words, cwd, environment, *outputs)
            return
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        texts = ["" if fd == outputs[0] and unread else os.pread(fd, 1 << 20, 0).decode() for fd in outputs]
        print(json.dumps([status, *texts]), flush=True)
        for fd in outputs:
            os.close(fd)


if __name__ == "__main__":
    _serve()
