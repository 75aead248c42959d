"""Seccomp programs: the instructions of classic BPF that filters of system calls are made of, put together by hand.

A filter begins with `program`, which looks at the processor and loads the number of the call; what follows ends in verdicts.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

Instruction = tuple[int, int, int, int]
"""Opcode, how many instructions to skip when it holds and when it does not, and a number."""

LOAD, AND = 0x20, 0x54
JUMP_EQUAL, JUMP_AT_LEAST = 0x15, 0x35
RETURN = 0x06
KILL_PROCESS, ERRNO, ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""The kernel's numbers of the processors, by `platform.machine()`: those that there are tables of calls for."""
_X32_BIT = 0x40000000
_NUMBER, _ARCHITECTURE = 0, 4

ALLOWED: Instruction = (RETURN, 0, 0, ALLOW)
KILLED: Instruction = (RETURN, 0, 0, KILL_PROCESS)


def program(machine: str, otherwise: Instruction, body: Iterable[Instruction]) -> bytes:
    """A whole filter, 8 bytes an instruction: `otherwise` for calls of another processor's kind, `body` for the others.

    `body` begins with the number of the call loaded.
    """
    head = [
        (LOAD, 0, 0, _ARCHITECTURE),
        (JUMP_EQUAL, 1, 0, AUDIT_ARCH[machine]),
        otherwise,
        (LOAD, 0, 0, _NUMBER),
    ]
    if machine == "x86_64":
        head += [(JUMP_AT_LEAST, 0, 1, _X32_BIT), otherwise]
    return b"".join(struct.pack("<HBBI", *instruction) for instruction in (*head, *body))


def argument(index: int) -> int:
    """Offset of the low half of an argument (both architectures are little-endian)."""
    return 16 + 8 * index


def refuse(number: int) -> Instruction:
    """The call fails with this errno; with 0 it is taken and ignored."""
    return (RETURN, 0, 0, ERRNO | number)


def one_of(index: int, allowed: Iterable[int], *otherwise: Instruction) -> list[Instruction]:
    """Allows a call whose argument `index` is one of these numbers; else `otherwise`."""
    block: list[Instruction] = [(LOAD, 0, 0, argument(index))]
    for value in allowed:
        block += [(JUMP_EQUAL, 0, 1, value), ALLOWED]
    return [*block, *otherwise]
