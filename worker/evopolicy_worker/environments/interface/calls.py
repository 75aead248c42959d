"""The current call into an environment, so that a hang or an error can name it; and the end of forks that return.

The thread that plays sets `current`, which takes a few dozen nanoseconds a step. The monitor's thread reads it
(`LimitGuard`).
"""

from __future__ import annotations

import os
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterable
from importlib.util import find_spec
from typing import Literal

import msgspec

from evopolicy_common.errors import EvopolicyError, SandboxError, SlotDiedError
from evopolicy_common.processes import proc
from evopolicy_common.terminal import one_line

Kind = Literal["", "make", "reset", "step", "render", "close"]

NOTE = "note: "
"""Prefix of a line on the process's standard error that an operator should see."""
CLOSE_S = 30.0
"""Longest that `close` may take, seconds: nothing is computed in it, and a worker does not register meanwhile."""
_LONGEST_CHECK_S = 1.0
"""More time between two checks does not count: this process was not let run."""
_MEMORY_CHECK_S = 0.5
_NOT_THEIRS = tuple(
    os.path.join(folder, "")
    for name in ("evopolicy_worker", "gymnasium")
    if (spec := find_spec(name)) is not None
    for folder in spec.submodule_search_locations or ()
)
_LIBRARIES = tuple(os.path.join(sysconfig.get_path(name), "") for name in ("stdlib", "purelib", "platlib"))
_STACK_LINE = re.compile(r'\s+File "([^"]+)", line \d+ in ')
"""Of a stack that `faulthandler` writes, the innermost first."""
_SHOWN_LINES, _LONGEST_LINE = 3, 240
"""Of a traceback: its last lines, and characters of each."""


class RunningCall:
    """The running call. `what` is empty while none runs."""

    def __init__(self) -> None:
        self.env = ""
        self.what: Kind = ""
        self.step = 0
        """Steps of the episode so far."""
        self.process = 0
        """The process that plays; 0: forks may play, too."""

    def begin(self, env: str, what: Kind) -> None:
        """A call other than a step begins. `env`: the environment's id."""
        self.env, self.step = env, 0
        self.what = what

    def done(self) -> None:
        """The call has returned. A fork of the environment's that returns from it ends here: it would play on, with the
        pipes of this process."""
        self.what = ""
        if self.process and os.getpid() != self.process:
            os._exit(0)

    def __str__(self) -> str:
        what = f"step {self.step}" if self.what == "step" else self.what
        return f"environment {self.env}, {what}" if what else f"environment {self.env}"


current = RunningCall()


class EnvironmentLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Resources of the slot that an environment may use. Exceeding a limit is never the policy's failure."""

    call_s: float = 300.0
    """Longest that one call of the environment may take, seconds."""
    memory_bytes: int = 4 << 30
    """Most resident memory of the environment's process, bytes."""


USUAL = EnvironmentLimits()


class LimitGuard:
    """Checks from another thread whether the environment keeps its limits."""

    def __init__(self, limits: EnvironmentLimits) -> None:
        self._limits = limits
        self._call: tuple[str, Kind, int] = ("", "", 0)
        self._spent_s = self._checked = self._weighed = 0.0

    def check(self, now: float) -> str:
        """Which limit was passed, with the remedy; empty when none was. `now`: monotonic seconds."""
        call = current.env, current.what, current.step
        since = min(now - self._checked, _LONGEST_CHECK_S)
        self._spent_s = self._spent_s + since if call == self._call and call[1] else 0.0
        self._checked, self._call = now, call
        most_s = min(self._limits.call_s, CLOSE_S) if call[1] == "close" else self._limits.call_s
        if self._spent_s > most_s:
            return hung(str(current), most_s)
        if now - self._weighed >= _MEMORY_CHECK_S:
            self._weighed = now
            used = resident_bytes()
            if used > self._limits.memory_bytes:
                return (
                    f"{current}: its process has {used >> 20:,} MiB of memory, and {self._limits.memory_bytes >> 20:,}"
                    " MiB are the limit; mend what it keeps from episode to episode, or raise the worker's"
                    " --env-memory"
                )
        return ""


def hung(call: str, most_s: float) -> str:
    """The text for a call that has not returned for so many seconds."""
    return (
        f"{call}: it has not returned for {most_s:g} s, the limit of one call; correct the environment (child processes"
        " ignore SIGTERM here: end them with SIGKILL), or raise the worker's --env-timeout"
    )


def note(text: str) -> None:
    """Tells the operator, by the worker's log."""
    print(f"{NOTE}{text}", file=sys.stderr, flush=True)


own_folders: list[str] = []
"""The operator's folders on this process's module search path, of which only modules and declared data are shown."""


def described(error: BaseException) -> str:
    """Type and text of an exception of third-party code, in one line, with the remedy for a file that is not shown."""
    try:
        text = str(error)
    except Exception:
        text = "its text cannot be made"
    return one_line(f"{type(error).__name__}: {text}{_not_shown(error, text)}")


def traced(error: BaseException | None) -> str:
    """The last lines of the traceback that are the environment's own, to be appended to a text; empty if there are
    none."""
    if error is None:
        return ""
    frames = [
        (each.filename, f'File "{each.filename}", line {each.lineno}, in {each.name}: {each.line}')
        for each in traceback.extract_tb(error.__traceback__)
    ]
    if isinstance(error, SyntaxError) and error.filename is not None:  # in a line that no frame has run
        line = f'File "{error.filename}", line {error.lineno}: {(error.text or "").strip()}'
        frames.append((error.filename, line))
    lines = _own(frames)
    # Without any: raised by Gymnasium for an error of theirs.
    return "".join(f"; {line}" for line in lines) or traced(error.__cause__)


def last_words(stderr: Iterable[str]) -> str:
    """The last lines that a process wrote to its standard error, as one text; of a crash's stack only the environment's
    own."""
    said: list[str] = []
    stack: list[tuple[str, str]] = []
    for line in stderr:
        if match := _STACK_LINE.match(line):
            stack.insert(0, (match[1], line.strip()))
        elif line and not line.startswith(("Stack (most recent", "Extension modules")):
            said.append(line)
    return " | ".join([*said, *_own(stack)])


def _own(frames: Iterable[tuple[str, str]]) -> list[str]:
    """Of pairs of file and text, the innermost last, the last texts that are the environment's own."""
    others = [each for each in frames if not each[0].startswith((*_NOT_THEIRS, "<frozen "))]
    own = [each for each in others if not each[0].startswith(_LIBRARIES)] or others
    return [one_line(text)[:_LONGEST_LINE] for _, text in own[-_SHOWN_LINES:]]


def unreadable(path: str) -> str:
    """The cause and the remedy for a file or folder that this process may not read, to be appended to a text."""
    return f"; environments run as user {os.getuid()}, who has no permission for it: chmod -R a+rX {path}"


def _not_shown(error: BaseException, text: str) -> str:
    if isinstance(error, PermissionError) and isinstance(error.filename, str):
        return "" if os.access(error.filename, os.R_OK) else unreadable(error.filename)
    for folder in own_folders if isinstance(error, OSError | ValueError) else ():
        match = re.search(rf"{re.escape(folder)}/([^'\"\n]+)", text)
        if match is not None and not os.path.exists(match[0]):
            return f"; {match[1]} is not shown to the environment: if it exists, declare it in data of an environment file"  # noqa: E501
    name = getattr(error, "name", None) or getattr(error.__cause__, "name", None)
    if isinstance(error, ModuleNotFoundError) and name and own_folders:
        return f"; if {name} is a folder on PYTHONPATH, it needs an __init__.py to be shown"
    return ""


def raised(error: BaseException, text: str, limits: EnvironmentLimits) -> str:
    """Which call raised the error, with `text` of it and the remedy; empty for an error that is not the
    environment's."""
    if not current.what or isinstance(error, SandboxError | SlotDiedError):
        return ""
    if isinstance(error, MemoryError):
        return (
            f"{current}: there is no memory left for it; mend what it keeps, or raise the worker's --env-memory"
            f" ({limits.memory_bytes >> 20:,} MiB)"
        )
    if isinstance(error, EvopolicyError):
        return text
    return f"{current}: it raised {text}; correct the environment{traced(error)}"


def resident_bytes() -> int:
    """Resident memory of this process, bytes; 0 where the system does not tell."""
    return (proc.sizes(os.getpid()) or (0, 0))[1]
