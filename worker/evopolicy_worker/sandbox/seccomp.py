"""Seccomp filters, assembled by hand: the system calls that a policy may make, and those that an environment process
may not.

Rules of the policy's filter, which this module owns:
- Unlisted calls are refused with EPERM; with ENOSYS for numbers newer than the lists, so that a C library falls back.
- New processes are impossible: `fork` and the like fail with EAGAIN, as at a process limit. Threads are allowed.
- Signals to other processes are refused. So are those to itself that could not be told from signals from outside:
  SIGKILL and the stop signals, also by a timer or a limit of its own. `endings` depends on this.
- No sockets, mounts, namespaces, keyrings, shared memory, `memfd` (not counted against any limit) or CPU affinity.
- No `epoll`: its watches are kernel memory that no limit counts. Python's `selectors` uses `poll`.
- No `membarrier`: it interrupts other cores, and takes longer if they run a process that asked for it.
- No call may change or show a machine-wide number: pipes and shared memory without a file (inode numbers), free blocks
  and huge pages, and mount ids, which `statx` always shows. `sync` calls do nothing, because the time that they take
  depends on other processes' writes.
- All sandboxes show the same read-only files, which must not carry messages: no locks, no futex on a shared mapped page
  (one that is not private to the process), and no view of or change to which pages are in memory. The machine's memory
  and load are hidden too.
- The filter is for one process: its pid replaces `PID_MARK` when it seals itself.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import platform
import signal
import termios
from collections.abc import Iterable

from evopolicy_common.errors import SandboxError
from evopolicy_common.seccomp import (
    ALLOWED,
    AND,
    JUMP_AT_LEAST,
    JUMP_EQUAL,
    KILLED,
    LOAD,
    NUMBERS,
    REACHING_OUT,
    REFUSED,
    SOCKET,
    Instruction,
    argument,
    one_of,
    program,
    refuse,
)

PID_MARK = 0x7FFFABCD
"""Placeholder in the filter for the pid of the process that installs it. It is the last word of an 8-byte
instruction."""

_FCNTL = (
    *(fcntl.F_DUPFD, fcntl.F_GETFD, fcntl.F_SETFD, fcntl.F_GETFL, fcntl.F_SETFL),
    *(fcntl.F_DUPFD_CLOEXEC, fcntl.F_GETPIPE_SZ),
)
_IOCTL = (
    *(termios.TCGETS, termios.TIOCGWINSZ, termios.FIONREAD),
    *(termios.FIONBIO, termios.FIONCLEX, termios.FIOCLEX),
)
_MADVISE = (
    *(mmap.MADV_NORMAL, mmap.MADV_RANDOM, mmap.MADV_SEQUENTIAL, mmap.MADV_WILLNEED, mmap.MADV_DONTNEED),
    *(mmap.MADV_FREE, mmap.MADV_HUGEPAGE, mmap.MADV_NOHUGEPAGE, mmap.MADV_DONTDUMP, mmap.MADV_DODUMP),
)
_FUTEX_PRIVATE = 128
_FUTEX_WAIT, _FUTEX_WAIT_BITSET = 0, 9
_MAP_HUGETLB = 0x40000
_PRCTL = (3, 15, 16)  # PR_GET_DUMPABLE, PR_SET_NAME, PR_GET_NAME
_MODES_AND_TIMES = ("chmod", "fchmod", "fchmodat", "utime", "utimes", "utimensat", "futimesat")
_NOT_TO_ITSELF = (signal.SIGKILL, signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
_EXTENDED_ATTRIBUTES = ("listxattr", "llistxattr", "flistxattr", "getxattr", "lgetxattr", "fgetxattr")
_CLONE_THREAD = 0x00010000
_CLONE_NAMESPACES = 0x7E020000
_HIGHEST_LISTED = 450
"""The highest system call number that the lists know; later calls do not exist for a sandboxed process (ENOSYS)."""

Interval = tuple[int, list[Instruction]]
"""The first system call number of an interval, and the instructions that decide on its calls."""


def supported() -> bool:
    """Whether the lists cover this machine's processor."""
    return platform.machine() in NUMBERS


def policy_filter(*, sees_the_machines_files: bool = False) -> bytes:
    """The policy's filter program, 8 bytes per instruction, for seccomp(2) once `PID_MARK` is replaced.

    `sees_the_machines_files`: only Landlock protects these, which lets an owner change modes and times, and on older
    kernels truncate files. These calls are then blocked; those for modes and times report success, because
    `shutil.copy` makes them. Raises SandboxError on a processor that the lists do not cover.
    """
    machine = _machine()
    numbers = NUMBERS[machine]
    blocks = {
        # A wait on a futex that is not private returns EAGAIN, so its caller polls. The C library joins threads with
        # such a wait, and so uses CPU while it waits.
        "futex": [
            (LOAD, 0, 0, argument(1)),
            (AND, 0, 0, _FUTEX_PRIVATE),
            (JUMP_EQUAL, 0, 1, _FUTEX_PRIVATE),
            ALLOWED,
            (LOAD, 0, 0, argument(1)),
            (AND, 0, 0, 0x7F),
            (JUMP_EQUAL, 1, 0, _FUTEX_WAIT),
            (JUMP_EQUAL, 0, 1, _FUTEX_WAIT_BITSET),
            refuse(errno.EAGAIN),
            refuse(errno.EINVAL),
        ],
        # Advice, which may be ignored: success without effect.
        "fadvise64": [refuse(0)],
        "readahead": [refuse(0)],
        "madvise": one_of(2, _MADVISE, refuse(errno.EINVAL)),
        "fsync": [refuse(0)],
        "fdatasync": [refuse(0)],
        "msync": [refuse(0)],
        # Pipes serve child processes, which are refused anyway: `subprocess` fails here as it would at `fork`.
        "pipe": [refuse(errno.EAGAIN)],
        "pipe2": [refuse(errno.EAGAIN)],
        "statfs": [refuse(errno.ENOSYS)],
        "fstatfs": [refuse(errno.ENOSYS)],
        # Callers fall back to `newfstatat`, which shows no mount ids.
        "statx": [refuse(errno.ENOSYS)],
        "mmap": [
            (LOAD, 0, 0, argument(3)),
            (AND, 0, 0, mmap.MAP_SHARED | mmap.MAP_ANONYMOUS),
            (JUMP_EQUAL, 0, 1, mmap.MAP_SHARED | mmap.MAP_ANONYMOUS),
            refuse(errno.EPERM),
            (LOAD, 0, 0, argument(3)),
            (AND, 0, 0, _MAP_HUGETLB),
            (JUMP_EQUAL, 0, 1, _MAP_HUGETLB),
            refuse(errno.ENOMEM),
            ALLOWED,
        ],
        # Without flags, the C library falls back to `preadv` and `pwritev`.
        "preadv2": [refuse(errno.ENOSYS)],
        "pwritev2": [refuse(errno.ENOSYS)],
        "ioctl": one_of(1, _IOCTL, refuse(errno.ENOTTY)),
        "fcntl": one_of(1, _FCNTL, refuse(errno.EPERM)),
        "prctl": one_of(0, _PRCTL, refuse(errno.EPERM)),
        "kill": _own_signals(1),
        "tgkill": _own_signals(2),
        # A process may read its own limits. With a CPU limit of its own it could be killed as if from outside.
        "prlimit64": [
            (LOAD, 0, 0, argument(2)),
            (JUMP_EQUAL, 1, 0, 0),
            refuse(errno.EPERM),
            (LOAD, 0, 0, argument(2) + 4),
            (JUMP_EQUAL, 1, 0, 0),
            refuse(errno.EPERM),
            *one_of(0, (0, PID_MARK), refuse(errno.EPERM)),
        ],
        # As on a file system without them: `shutil.copytree` ignores this error, and no other.
        **{name: [refuse(errno.ENOTSUP)] for name in _EXTENDED_ATTRIBUTES},
        "clone": [
            (LOAD, 0, 0, argument(0)),
            (AND, 0, 0, _CLONE_THREAD | _CLONE_NAMESPACES),
            (JUMP_EQUAL, 0, 1, _CLONE_THREAD),
            ALLOWED,
            refuse(errno.EAGAIN),
        ],
        "fork": [refuse(errno.EAGAIN)],
        "vfork": [refuse(errno.EAGAIN)],
        # Its flags are in memory, which a filter cannot read. The C library falls back to `clone`.
        "clone3": [refuse(errno.ENOSYS)],
    }
    if sees_the_machines_files:
        blocks |= {name: [refuse(0)] for name in _MODES_AND_TIMES}
        blocks |= {"truncate": [refuse(errno.EPERM)], "open": _no_cutting(1), "openat": _no_cutting(2)}
        # Its flags are in memory, which a filter cannot read.
        blocks["openat2"] = [refuse(errno.ENOSYS)]
    by_number = {number: blocks.get(name, [ALLOWED]) for name, number in numbers.items()}
    refused = [[refuse(errno.EPERM)]] * _HIGHEST_LISTED + [[refuse(errno.ENOSYS)]]
    return _assembled(machine, (by_number.get(number, code) for number, code in enumerate(refused)))


def environment_filter(*, namespaces: bool, signals: bool) -> bytes:
    """The filter program of an environment process. It lists refused calls only, as simulators start processes and open
    devices.

    `namespaces`: whether namespaces isolate it from other processes and the network. If not, the filter refuses sockets
    and access to other processes' limits. `signals`: whether it may send signals, which then cannot reach processes
    outside. Raises SandboxError on a processor that the lists do not cover.
    """
    machine = _machine()
    blocks = {number: [refuse(errno.EPERM)] for number in REFUSED[machine].values()}
    numbers = NUMBERS[machine]
    if not namespaces:
        blocks[SOCKET[machine]] = [refuse(errno.EACCES)]
        blocks[numbers["prlimit64"]] = one_of(0, (0, PID_MARK), refuse(errno.EPERM))
    if not signals:
        blocks |= {number: [refuse(errno.EPERM)] for number in REACHING_OUT[machine].values()}
        blocks[numbers["tgkill"]] = one_of(0, (PID_MARK,), refuse(errno.EPERM))
    blocks[numbers["clone"]] = [
        (LOAD, 0, 0, argument(0)),
        (AND, 0, 0, _CLONE_NAMESPACES),
        (JUMP_EQUAL, 0, 1, 0),
        ALLOWED,
        refuse(errno.EPERM),
    ]
    # Its flags are in memory, which a filter cannot read. The C library falls back to `clone`.
    blocks[numbers["clone3"]] = [refuse(errno.ENOSYS)]
    return _assembled(machine, (blocks.get(number, [ALLOWED]) for number in range(max(blocks) + 2)))


def _machine() -> str:
    machine = platform.machine()
    if machine not in NUMBERS:
        raise SandboxError(
            f"no seccomp filter for {machine}; the sandbox runs on {' and '.join(NUMBERS)} (or ask for tier none)"
        )
    return machine


def _assembled(machine: str, codes: Iterable[list[Instruction]]) -> bytes:
    """The whole program: kills the process on a call of another architecture, and looks up all other calls.
    `codes`: of each call number; the last is that of all higher ones too."""
    intervals: list[Interval] = []
    for number, code in enumerate(codes):
        if not intervals or intervals[-1][1] != code:
            intervals.append((number, code))
    return program(machine, KILLED, _search(intervals))


def _search(intervals: list[Interval]) -> list[Instruction]:
    """A binary search for the call number, because the kernel runs the filter once per number when it is installed."""
    if len(intervals) == 1:
        return intervals[0][1]
    half = len(intervals) // 2
    below, above = _search(intervals[:half]), _search(intervals[half:])
    return [(JUMP_AT_LEAST, len(below), 0, intervals[half][0]), *below, *above]


def _no_cutting(index: int) -> list[Instruction]:
    """Allows opening a file, unless it is opened read-only and truncated."""
    return [
        (LOAD, 0, 0, argument(index)),
        (AND, 0, 0, os.O_TRUNC | os.O_ACCMODE),
        (JUMP_EQUAL, 0, 1, os.O_TRUNC),
        refuse(errno.EPERM),
        ALLOWED,
    ]


def _own_signals(index: int) -> list[Instruction]:
    """Allows a signal to the process itself unless it is in `_NOT_TO_ITSELF`. `index`: the argument with the signal
    number."""
    block: list[Instruction] = [(LOAD, 0, 0, argument(index))]
    for number in _NOT_TO_ITSELF:
        block += [(JUMP_EQUAL, 0, 1, number), refuse(errno.EPERM)]
    return [*block, *one_of(0, (PID_MARK,), refuse(errno.EPERM))]
