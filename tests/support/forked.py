"""Commands of ours as processes that are forked where all that commands import is imported: without the start of
Python."""

from __future__ import annotations

import gc
import importlib
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

from helper_process import HelperProcess, serve

BIN = Path(sys.executable).parent


class Ended(NamedTuple):
    """A finished command."""

    returncode: int
    stdout: str
    stderr: str


class Forks:
    """The process that forks the commands."""

    def __init__(self) -> None:
        self._process = HelperProcess(__file__)

    def __call__(
        self, words: list[str], cwd: Path | None = None, *, unread: bool = False, **environment: str
    ) -> Ended:
        """The command with these words, to its end. `unread`: its standard output is a pipe that nobody reads."""
        return Ended(*self._process.ask([words, str(cwd or Path.cwd()), unread, os.environ | environment]))

    def close(self) -> None:
        self._process.close()


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
    serve(_played)


def _played(request: list[Any]) -> list[Any]:
    words, cwd, unread, environment = request
    outputs = _output(unread), os.memfd_create("stderr")
    child = os.fork()
    if not child:
        _become(words, cwd, environment, *outputs)
        sys.exit()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    texts = ["" if fd == outputs[0] and unread else os.pread(fd, 1 << 20, 0).decode() for fd in outputs]
    for fd in outputs:
        os.close(fd)
    return [status, *texts]


if __name__ == "__main__":
    _serve()
