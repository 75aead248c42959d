"""Runs a filter of system calls, instruction by instruction, for any processor."""

from __future__ import annotations

import struct

from evopolicy_common import seccomp as bpf


def allowed(program: bytes, number: int, *arguments: int, machine: str = "x86_64") -> int:
    """The verdict of the filter on a system call."""
    data = struct.pack(
        "<iIQ6Q", number, bpf.AUDIT_ARCH[machine], 0, *arguments, *([0] * (6 - len(arguments)))
    )
    at, register = 0, 0
    while True:
        code, if_true, if_false, k = struct.unpack_from("<HBBI", program, 8 * at)
        at += 1
        if code == bpf.LOAD:
            (register,) = struct.unpack_from("<I", data, k)
        elif code == bpf.AND:
            register &= k
        elif code == bpf.JUMP_EQUAL:
            at += if_true if register == k else if_false
        elif code == bpf.JUMP_AT_LEAST:
            at += if_true if register >= k else if_false
        elif code == bpf.JUMP_ANY_BIT:
            at += if_true if register & k else if_false
        else:
            assert code == bpf.RETURN
            return int(k)
