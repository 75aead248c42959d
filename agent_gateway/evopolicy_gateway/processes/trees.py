"""Process trees: no process that an agent started may outlive it, even outside its process group or orphaned."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import time
from collections.abc import Collection

from evopolicy_common.processes import proc

_PR_SET_CHILD_SUBREAPER = 36
_KEYCTL_JOIN_SESSION_KEYRING = 1
_PAUSE_S = 0.01
_KILLS = 100
"""How often children are killed between two listings of all processes."""
KILL_TIMEOUT_S = 10.0


_reaps = False


def become_subreaper() -> None:
    """Makes descendants whose parent dies become children of this process, so that none escapes.

    Only for processes all of whose children are ours: `end_orphans` and `end_descendants` treat all others as orphans.
    """
    global _reaps
    _reaps = True
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def leave_session_keyring() -> None:
    """Gives this process and its children an empty session keyring; a login's keyring holds its keys.

    Namespaces do not separate keyrings. Does nothing when the kernel has no keyrings.
    """
    number = {"x86_64": 250, "aarch64": 219}.get(os.uname().machine)
    if number is not None:
        ctypes.CDLL(None, use_errno=True).syscall(number, _KEYCTL_JOIN_SESSION_KEYRING, None)


def cpu_below() -> float:
    """CPU seconds of all processes below this one, and of the dead children that these have waited for."""
    return sum(each.cpu_s for each in proc.family(os.getpid())[1:])


def end_descendants(
    grace_s: float, *, spare: Collection[int] = (), waited: Collection[int] = ()
) -> list[int]:
    """Ends everything below this process: SIGTERM, then SIGKILL after `grace_s` seconds until no process remains.

    Blocks. `spare`: process ids that stay alive with everything below them. `waited`: ids whose exit status other code
    collects. Returns the ids that survive `KILL_TIMEOUT_S` seconds of killing: none, unless the kernel holds them.
    """
    kept = {*spare, *waited}
    _signal_all(_alive(spare, kept), signal.SIGTERM)
    deadline = time.monotonic() + grace_s
    while _alive(spare, kept) and time.monotonic() < deadline:
        _reap(kept)
        time.sleep(_PAUSE_S)
    deadline = time.monotonic() + KILL_TIMEOUT_S
    while (survivors := _alive(spare, kept)) and time.monotonic() < deadline:
        # Stopped first: a process that forks faster than it is listed must not outrun the killing.
        _signal_all(survivors, signal.SIGSTOP)
        _signal_all(_alive(spare, kept), signal.SIGKILL)
        # This process's children are killed repeatedly: it has to be faster than such a chain forks.
        me = os.getpid()
        with (
            contextlib.suppress(OSError, ValueError),
            open(f"/proc/{me}/task/{me}/children", "rb", 0) as file,
        ):
            for _ in range(_KILLS):
                file.seek(0)
                _signal_all([pid for pid in map(int, file.read().split()) if pid not in kept], signal.SIGKILL)
        _reap(kept)
        time.sleep(_PAUSE_S)
    _reap(kept)
    return _alive(spare, kept)


def end_orphans(known: Collection[int]) -> list[int]:
    """Ends processes that became this one's children by their parent's death: all but `known` and those below them.

    Returns the ids that survive. Does nothing unless this process is a subreaper: its other children are not ours to
    end.
    """
    return end_descendants(0.0, spare=known) if _reaps else []


def _alive(spare: Collection[int], kept: Collection[int]) -> list[int]:
    """All processes below this one but the dead among `kept`.

    The other dead count: in a chain of processes, each of which forks once and ends, all listed processes may be dead
    when they are examined, while the living one was started after the listing.
    """
    family = proc.family(os.getpid(), spare=spare)[1:]
    return [each.pid for each in family if not (each.dead and each.pid in kept)]


def _signal_all(pids: list[int], number: signal.Signals) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def _reap(kept: Collection[int]) -> None:
    me = os.getpid()
    for each in proc.table():
        if each.parent == me and each.dead and each.pid not in kept:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(each.pid, os.WNOHANG)
