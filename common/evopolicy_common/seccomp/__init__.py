"""Seccomp programs: assembles filters of system calls from classic BPF instructions.

A filter starts with `program`, which checks the architecture and loads the call's number; the body returns the
verdicts.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

Instruction = tuple[int, int, int, int]
"""Opcode, number of instructions to skip when the condition holds and when it does not, and an operand."""

LOAD, AND = 0x20, 0x54
JUMP_EQUAL, JUMP_AT_LEAST, JUMP_ANY_BIT = 0x15, 0x35, 0x45
RETURN = 0x06
KILL_PROCESS, ERRNO, ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""The kernel's architecture numbers by `platform.machine()`, for the architectures with tables of calls."""
_X32_BIT = 0x40000000
_NUMBER, _ARCHITECTURE = 0, 4

ALLOWED: Instruction = (RETURN, 0, 0, ALLOW)
KILLED: Instruction = (RETURN, 0, 0, KILL_PROCESS)


def program(machine: str, otherwise: Instruction, body: Iterable[Instruction]) -> bytes:
    """A complete filter, 8 bytes an instruction: `otherwise` applies to calls of another architecture,
    `body`, which begins with the call's number loaded, to the rest."""
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
    """Makes the call fail with this errno; with 0 the call is accepted and ignored."""
    return (RETURN, 0, 0, ERRNO | number)


def one_of(index: int, allowed: Iterable[int], *otherwise: Instruction) -> list[Instruction]:
    """Allows a call whose argument `index` is one of `allowed`; runs `otherwise` for other values."""
    block: list[Instruction] = [(LOAD, 0, 0, argument(index))]
    for value in allowed:
        block += [(JUMP_EQUAL, 0, 1, value), ALLOWED]
    return [*block, *otherwise]
