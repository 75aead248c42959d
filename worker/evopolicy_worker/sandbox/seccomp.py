"""The system calls that a policy may make, and those that an environment process may not: seccomp filters by hand.

Rules of the policy's filter, which this module owns:
- What is not listed is refused (EPERM; ENOSYS for numbers younger than the lists, so that a C library falls back).
- No process is ever made: `fork` and the like answer EAGAIN, as at a process limit. Threads are allowed.
- No signals to anyone else, and none to itself that nobody can tell from one of outside: SIGKILL and the stops, also by a timer
  or a limit of its own. `endings` rests on this.
- No sockets, no mounts, namespaces, keyrings, shared memory, `memfd` (not counted against any
  limit) or CPU affinity.
- Nothing that moves or shows a number of the whole machine: pipes and shared memory without a file (inode numbers), free
  blocks and huge pages, mount ids, which `statx` shows whatever it is asked for. Nor does a `sync` reach a disk: how long it
  takes depends on what others write.
- Sandboxes show the same read-only files, and nothing of them may carry a message: no locks, no waiting for each other on a
  mapped page (a futex that is not private to the process), no looking at or changing what of them is in memory. Nor is
  there a view of the machine's memory and load.
- The filter is for one process: its own pid is put in place of `PID_MARK` when it seals itself.
"""

from __future__ import annotations

import errno
import os
import platform

from evopolicy_common.errors import SandboxError
from evopolicy_common.seccomp import (
    ALLOWED,
    AND,
    JUMP_AT_LEAST,
    JUMP_EQUAL,
    KILLED,
    LOAD,
    Instruction,
    argument,
    one_of,
    program,
    refuse,
)
from evopolicy_common.seccomp.numbers import NUMBERS, REACHING_OUT, REFUSED, SOCKET

PID_MARK = 0x7FFFABCD
"""Stands in the filter for the pid of the process that installs it; instructions are 8 bytes, this is their last word."""

_FCNTL = (
    0,
    1,
    2,
    3,
    4,
    1030,
    1032,
)  # F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_SETFL, F_DUPFD_CLOEXEC, F_GETPIPE_SZ
_IOCTL = (
    0x5401,
    0x5413,
    0x541B,
    0x5421,
    0x5450,
    0x5451,
)  # TCGETS, TIOCGWINSZ, FIONREAD, FIONBIO, FIONCLEX, FIOCLEX
_MADVISE = (
    0,
    1,
    2,
    3,
    4,
    8,
    14,
    15,
    16,
    17,
)  # MADV_NORMAL, _RANDOM, _SEQUENTIAL, _WILLNEED, _DONTNEED, _FREE, _HUGEPAGE, _NOHUGEPAGE, _DONTDUMP, _DODUMP
_FUTEX_PRIVATE = 128
_FUTEX_WAIT, _FUTEX_WAIT_BITSET = 0, 9
_MAP_SHARED, _MAP_ANONYMOUS, _MAP_HUGETLB = 0x01, 0x20, 0x40000
_PRCTL = (3, 15, 16)  # PR_GET_DUMPABLE, PR_SET_NAME, PR_GET_NAME
_MODES_AND_TIMES = ("chmod", "fchmod", "fchmodat", "utime", "utimes", "utimensat", "futimesat")
_NOT_TO_ITSELF = (9, 19, 20, 21, 22)  # SIGKILL, SIGSTOP, SIGTSTP, SIGTTIN, SIGTTOU
_EXTENDED_ATTRIBUTES = ("listxattr", "llistxattr", "flistxattr", "getxattr", "lgetxattr", "fgetxattr")
_CLONE_THREAD = 0x00010000
_CLONE_NAMESPACES = 0x7E020000
_YOUNGEST = 450

Interval = tuple[int, list[Instruction]]
"""The first number, and what to do with it: instructions that end in a verdict."""


def supported() -> bool:
    """Whether there are lists for this machine's processor."""
    return platform.machine() in NUMBERS


def policy_filter(*, sees_the_machines_files: bool = False) -> bytes:
    """The program: 8 bytes an instruction, to be given to seccomp(2) with `PID_MARK` replaced.

    `sees_the_machines_files`: where only Landlock stands before them, which lets an owner change modes and times, and on
    older kernels cut a file off. Those calls are then refused, modes and times without a word, as `shutil.copy` sets them.
    Raises SandboxError on a processor that the lists do not cover.
    """
    machine = _machine()
    numbers = NUMBERS[machine]
    blocks = {
        # Its caller looks at the word again, as after any other wake, and again: the C library's join of a thread asks
        # so, and computes while it waits.
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
        # Advice, which may be ignored.
        "fadvise64": [refuse(0)],
        "readahead": [refuse(0)],
        "madvise": one_of(2, _MADVISE, refuse(errno.EINVAL)),
        "fsync": [refuse(0)],
        "fdatasync": [refuse(0)],
        "msync": [refuse(0)],
        # Pipes are for processes, of which there are no more: `subprocess` fails here as it would at `fork`.
        "pipe": [refuse(errno.EAGAIN)],
        "pipe2": [refuse(errno.EAGAIN)],
        "statfs": [refuse(errno.ENOSYS)],
        "fstatfs": [refuse(errno.ENOSYS)],
        # Who asks so falls back to `newfstatat`, which shows no mount.
        "statx": [refuse(errno.ENOSYS)],
        "mmap": [
            (LOAD, 0, 0, argument(3)),
            (AND, 0, 0, _MAP_SHARED | _MAP_ANONYMOUS),
            (JUMP_EQUAL, 0, 1, _MAP_SHARED | _MAP_ANONYMOUS),
            refuse(errno.EPERM),
            (LOAD, 0, 0, argument(3)),
            (AND, 0, 0, _MAP_HUGETLB),
            (JUMP_EQUAL, 0, 1, _MAP_HUGETLB),
            refuse(errno.ENOMEM),
            ALLOWED,
        ],
        # The C library uses `preadv` where no flag is asked for.
        "preadv2": [refuse(errno.ENOSYS)],
        "pwritev2": [refuse(errno.ENOSYS)],
        "ioctl": one_of(1, _IOCTL, refuse(errno.ENOTTY)),
        "fcntl": one_of(1, _FCNTL, refuse(errno.EPERM)),
        "prctl": one_of(0, _PRCTL, refuse(errno.EPERM)),
        "kill": _own_signals(1),
        "tgkill": _own_signals(2),
        # Its limits may be looked at. Of another CPU limit it could be killed as if from outside.
        "prlimit64": [
            (LOAD, 0, 0, argument(2)),
            (JUMP_EQUAL, 1, 0, 0),
            refuse(errno.EPERM),
            (LOAD, 0, 0, argument(2) + 4),
            (JUMP_EQUAL, 1, 0, 0),
            refuse(errno.EPERM),
            *one_of(0, (0, PID_MARK), refuse(errno.EPERM)),
        ],
        # As on a file system without them: `shutil.copytree` goes on then, and with no other answer.
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
        # Its flags lie in memory, where a filter cannot look: without it the C library uses clone.
        "clone3": [refuse(errno.ENOSYS)],
    }
    if sees_the_machines_files:
        blocks |= {name: [refuse(0)] for name in _MODES_AND_TIMES}
        blocks |= {"truncate": [refuse(errno.EPERM)], "open": _no_cutting(1), "openat": _no_cutting(2)}
        # Its flags lie in memory.
        blocks["openat2"] = [refuse(errno.ENOSYS)]
    return _assembled(machine, _intervals(numbers, blocks))


def environment_filter(*, namespaces: bool, signals: bool) -> bytes:
    """The program for an environment process, which lists what is refused: simulators start processes and open devices.

    `namespaces`: those that it is in keep other processes and the network from it; else sockets are refused, and other
    processes' limits. `signals`: it may send some, as they reach nobody outside. Raises SandboxError on a processor that
    the lists do not cover.
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
    # Its flags lie in memory, where a filter cannot look: without it the C library uses clone.
    blocks[numbers["clone3"]] = [refuse(errno.ENOSYS)]
    intervals: list[Interval] = []
    for number in range(max(blocks) + 2):
        code = blocks.get(number, [ALLOWED])
        if not intervals or intervals[-1][1] != code:
            intervals.append((number, code))
    return _assembled(machine, intervals)


def _machine() -> str:
    machine = platform.machine()
    if machine not in NUMBERS:
        raise SandboxError(
            f"no seccomp filter for {machine}; the sandbox runs on {' and '.join(NUMBERS)} (or ask for tier none)"
        )
    return machine


def _assembled(machine: str, intervals: list[Interval]) -> bytes:
    """The whole program: another architecture's calls end the process, the others are looked up."""
    return program(machine, KILLED, _search(intervals))


def _intervals(numbers: dict[str, int], blocks: dict[str, list[Instruction]]) -> list[Interval]:
    """What happens to every number, as intervals in ascending order; each lasts to where the next begins."""
    by_number = {number: blocks.get(name, [ALLOWED]) for name, number in numbers.items()}
    found: list[Interval] = []
    for number in range(_YOUNGEST + 1):
        code = by_number.get(number, [refuse(errno.EPERM if number < _YOUNGEST else errno.ENOSYS)])
        if not found or found[-1][1] != code:
            found.append((number, code))
    return found


def _search(intervals: list[Interval]) -> list[Instruction]:
    """A binary search for the number: the kernel runs the filter for each number when it is installed."""
    if len(intervals) == 1:
        return intervals[0][1]
    half = len(intervals) // 2
    below, above = _search(intervals[:half]), _search(intervals[half:])
    return [(JUMP_AT_LEAST, len(below), 0, intervals[half][0]), *below, *above]


def _no_cutting(index: int) -> list[Instruction]:
    """Allows opening a file unless it is opened for reading and cut off all the same."""
    return [
        (LOAD, 0, 0, argument(index)),
        (AND, 0, 0, os.O_TRUNC | os.O_ACCMODE),
        (JUMP_EQUAL, 0, 1, os.O_TRUNC),
        refuse(errno.EPERM),
        ALLOWED,
    ]


def _own_signals(index: int) -> list[Instruction]:
    """Allows a signal to itself, in that argument, unless it is one of `_NOT_TO_ITSELF`."""
    block: list[Instruction] = [(LOAD, 0, 0, argument(index))]
    for number in _NOT_TO_ITSELF:
        block += [(JUMP_EQUAL, 0, 1, number), refuse(errno.EPERM)]
    return [*block, *one_of(0, (PID_MARK,), refuse(errno.EPERM))]
