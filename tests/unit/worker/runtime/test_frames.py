"""Frames between the environment's process and the policy's, and the filter: without any process."""

from __future__ import annotations

import contextlib
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from machines.filters import allowed

from evopolicy_common import seccomp as bpf
from evopolicy_common.errors import SandboxError, WorkerError
from evopolicy_common.records.json_text import json_bytes
from evopolicy_common.seccomp import NUMBERS
from evopolicy_worker.episodes import frames
from evopolicy_worker.episodes.monitor import Output
from evopolicy_worker.sandbox import seccomp
from evopolicy_worker.sandbox.inside import policy_server

SPACE: dict[str, Any] = {
    "type": "Dict",
    "spaces": {
        "a": {"type": "Box", "shape": [3], "dtype": "float32"},
        "b": {"type": "Text", "min_length": 0, "max_length": 99},
        "c": {
            "type": "Tuple",
            "spaces": [{"type": "Discrete", "n": 9}, {"type": "MultiBinary", "n": [2, 3]}],
        },
        "d": {"type": "MultiDiscrete", "nvec": [4, 4]},
        "e": {"type": "Text", "min_length": 0, "max_length": 99},
    },
}


@given(st.text(max_size=60), st.text(max_size=2000), st.integers(-(2**63), 2**63 - 1))
def test_observations_arrive_as_they_were_sent(first: str, second: str, number: int) -> None:
    obs = {
        "a": np.array([1.5, -0.0, np.nan], np.float32),
        "b": first,
        "c": (number, np.array([[0, 1, 1], [1, 0, 0]], np.int8)),
        "d": np.array([3, 1]),
        "e": second,
    }
    parts, n = frames.compile_writer(SPACE)(obs)
    request = b"".join(map(bytes, parts))
    head = policy_server.REQUEST_HEADER.size
    payload = request[head:]
    assert (len(request), policy_server.REQUEST_HEADER.unpack(request[:head])) == (
        n,
        (len(payload), policy_server.ACT, 0),
    )
    make_buffer, read = policy_server.observation_reader(SPACE, False)
    buffer = make_buffer()
    if len(buffer) < len(payload):
        buffer = bytearray(len(payload))
    buffer[: len(payload)] = payload
    got = read(buffer, len(payload))
    assert list(got) == list(obs)
    assert got["a"].tobytes() == obs["a"].tobytes()  # type: ignore[attr-defined]
    assert (got["b"], got["e"], got["c"][0]) == (first, second, number)
    np.testing.assert_array_equal(got["c"][1], obs["c"][1])  # type: ignore[index]
    assert (got["d"].tolist(), got["d"].dtype) == ([3, 1], np.int64)


@pytest.mark.parametrize("obs", [np.zeros(4, np.float32), np.zeros(3)])
def test_an_observation_of_another_shape_is_the_environments_fault(obs: Any) -> None:
    with pytest.raises(WorkerError, match="shape"):
        frames.compile_writer({"type": "Box", "shape": [3], "dtype": "float32"})(obs)


@settings(max_examples=400)
@given(st.integers(0, 255), st.binary(max_size=80))
def test_hostile_replies_are_an_action_or_refused_and_nothing_else(tag: int, payload: bytes) -> None:
    for read in (lambda: frames.action(tag, payload), lambda: frames.report(payload)):
        with contextlib.suppress(frames.BadReplyError):
            read()


@pytest.mark.parametrize(
    "payload",
    [
        struct.pack("<4sI", b"|O\0\0", 1) + bytes(8),
        struct.pack("<4sI2I", b"<f8\0", 2, 1 << 31, 1 << 31),
        struct.pack("<4sI", b"<f8\0", 4_000_000_000),
        b"\x91" * 5000 + b"\xc0",
        b"\xdd\xff\xff\xff\xff",
        b"\xc7\x05\x01junk!",
        b"\x92\x01",
        b"\xdc\x08\x00" + b"\x90" * 2048,
        struct.pack("<4sI2I", b"|u1", 2, 2**32 - 1, 0),
        struct.pack("<4sI3I", b"|u1", 3, 2**20, 2**20, 0),
        struct.pack("<4sI17I", b"|u1", 17, *[1] * 17) + b"x",
        struct.pack("<4sII", b"<f2", 1, 2000) + bytes(4000),
        b"\x91\xc7\x10\x01" + struct.pack("<4sI2I", b"|u1", 2, 2**32 - 1, 0),
        b"\x81\xdc\x27\x10" + b"\x01" * 10_001,
        b"\x81\xc0\x01",
        b"\x91\x81\xc4\x01a\x01",
        b"\xd6\xff" + bytes(4),
        b"\x91\xd6\xff" + bytes(4),
        b"\x92" + 2 * (b"\xc8\x02\x64\x01" + struct.pack("<4sII", b"|u1", 1, 600) + bytes(600)),
    ],
)
def test_impossible_arrays_nests_keys_and_timestamps_are_refused(payload: bytes) -> None:
    for tag in (policy_server.ARRAY, policy_server.GENERIC):
        with pytest.raises(frames.BadReplyError):
            frames.action(tag, payload)


@given(
    st.recursive(
        st.none()
        | st.floats()
        | hnp.arrays(
            st.sampled_from([np.float16, np.uint8, np.bool_]),
            hnp.array_shapes(min_dims=0, min_side=0, max_side=40),
        ),
        lambda v: st.lists(v, max_size=20) | st.dictionaries(st.text(max_size=2), v, max_size=4),
        max_leaves=40,
    )
)
def test_both_ends_count_an_action_alike(action: Any) -> None:
    try:
        frame = policy_server.encoded(action)
    except policy_server.TooLargeError:
        return
    got = frames.action(frame[4], frame[8:])
    assert len(json_bytes(got)) <= 8 * len(frame) + 100


def test_report_with_a_text_that_is_none_is_refused() -> None:
    packed = b'{"stage": "act", "kind": null, "message": "\xd6 ", "traceback": ""}'
    with pytest.raises(frames.BadReplyError, match="utf-8"):
        frames.report(packed)


def test_an_action_that_cannot_be_sent_is_reported() -> None:
    endless: list[Any] = []
    endless.append(endless)
    for action in (
        *(endless, 1 << 5000, np.zeros(1 << 20), ["x" * (1 << 20)] * 3),
        *([1.0] * 4000, [1.0] * 1025, [[]] * 2000),
        *(np.empty((2**32 - 1, 0)), [np.empty((2**32 - 1, 0))], np.empty((2**40, 0)), np.zeros((1,) * 17)),
        *(np.zeros(1025, np.float16), [np.zeros(600, np.bool_)] * 2, {"a": np.empty((1025, 0))}),
    ):
        with pytest.raises(ValueError, match="the action"):
            policy_server.encoded(action)


CHECKED = {
    *("ioctl", "fcntl", "prctl", "prlimit64", "clone", "clone3", "fork", "vfork", "kill", "tgkill"),
    *("futex", "madvise", "fadvise64", "readahead", "preadv2", "pwritev2"),
    *("pipe", "pipe2", "statfs", "fstatfs", "statx", "fsync", "fdatasync", "msync"),
    *("listxattr", "llistxattr", "flistxattr", "getxattr", "lgetxattr", "fgetxattr"),
}
"""Calls that depend on their arguments, or are refused in a way of their own."""


@pytest.mark.parametrize("machine", sorted(NUMBERS))
def test_the_filter_ends_for_every_number_and_allows_what_is_listed(
    machine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: machine)
    program = seccomp.policy_filter()
    assert len(program) // 8 < 4096
    numbers = {number: name for name, number in NUMBERS[machine].items()}
    for number in range(600):
        verdict = allowed(program, number, machine=machine)
        if number not in numbers:
            assert verdict & 0x7FFF0000 == bpf.ERRNO, number
        elif numbers[number] not in CHECKED:
            assert verdict == bpf.ALLOW, numbers[number]


PID, OPEN = seccomp.PID_MARK, {"sees_the_machines_files": True}
ALLOWED, IGNORED = bpf.ALLOW, bpf.ERRNO
"""`IGNORED`: it says that it has been done."""
EPERM, EAGAIN, ENOMEM, EINVAL, ENOSYS, ENOTSUP = (bpf.ERRNO | number for number in (1, 11, 12, 22, 38, 95))
SHARED, PRIVATE, ANONYMOUS, HUGE = 0x01, 0x02, 0x20, 0x40000
BARRED = (9, 19, 20, 21, 22)
"""Signals that a process may not send itself either: they could be another's."""
FILTERED: list[tuple[Any, list[tuple[Any, ...]], int]] = [
    # Threads may be made (what pthread_create asks for), and nothing else.
    ("clone", [(0x3D0F00,)], ALLOWED),
    # fork(), and a thread in a new namespace
    ("clone", [(0x1200011,), (0x10010F00,)], EAGAIN),
    ("fork", [()], EAGAIN),
    ("prctl", [(4, 1)], EPERM),
    (165, [()], EPERM),  # mount
    (0x40000000, [()], bpf.KILL_PROCESS),
    # Signals to itself, but for those that could be another's.
    ("kill", [(PID, number) for number in range(65) if number not in BARRED], ALLOWED),
    ("tgkill", [(PID, 5, number) for number in range(65) if number not in BARRED], ALLOWED),
    ("kill", [(1, 15), *((PID, number) for number in BARRED)], EPERM),
    (
        "tgkill",
        [*((1, 1, number) for number in range(65)), *((PID, 5, number) for number in BARRED)],
        EPERM,
    ),
    ("prlimit64", [(0, 0, 0, 0x7F00DEADBEEF)], ALLOWED),
    ("prlimit64", [(who, 0, new) for new in (0x7F00DEADBEEF, 1 << 40, 0x1000) for who in (0, PID)], EPERM),
    # setrlimit, timer_create, tkill, … seccomp
    *((number, [()], EPERM) for number in (160, 222, 200, 129, 297, 424, 101, 317)),
    # Of a shared file nothing carries a message: private waits and wakes; others are polled or refused.
    ("futex", [(0, number | more) for number in (0, 1, 9, 10, 13) for more in (128, 128 | 256)], ALLOWED),
    ("futex", [(0, 0), (0, 9), (0, 9 | 256)], EAGAIN),
    ("futex", [(0, wake) for wake in (1, 3, 4, 5, 10, 13)], EINVAL),
    ("madvise", [(0, 0, 4)], ALLOWED),  # given back by an allocator
    ("madvise", [(0, 0, 21)], EINVAL),  # out of memory for everybody
    ("fadvise64", [()], IGNORED),
    ("preadv2", [()], ENOSYS),
    *((number, [()], EPERM) for number in (73, 99)),  # flock, sysinfo
    # What is counted for the machine.
    ("mmap", [(0, 4096, 3, flags) for flags in (PRIVATE, PRIVATE | ANONYMOUS, SHARED, 0x03)], ALLOWED),
    ("mmap", [(0, 4096, 3, PRIVATE | ANONYMOUS | 0x20000)], ALLOWED),
    ("mmap", [(0, 4096, 3, flags) for flags in (SHARED | ANONYMOUS, 0x03 | ANONYMOUS)], EPERM),
    ("mmap", [(0, 1 << 21, 3, PRIVATE | ANONYMOUS | HUGE)], ENOMEM),
    *((name, [()], ENOSYS) for name in ("statx", "statfs")),
    ("pipe2", [()], EAGAIN),
    ("getxattr", [()], ENOTSUP),
    ("fsync", [()], IGNORED),
]
SEEING: list[tuple[Any, list[tuple[Any, ...]], int]] = [
    ("truncate", [()], EPERM),
    *((name, [()], IGNORED) for name in ("chmod", "utimensat")),
    ("openat2", [()], ENOSYS),
    # Reading, and writing where it may write at all; no cutting of what it reads.
    ("open", [(0, 0), (0, 1 | 0o1000)], ALLOWED),
    ("openat", [(0, 0, 0), (0, 0, 1 | 0o1000)], ALLOWED),
    ("open", [(0, 0o1000)], EPERM),
    ("openat", [(0, 0, 0o1000)], EPERM),
]
"""Where the machine's files are seen."""


@pytest.mark.parametrize(
    ("call", "arguments", "verdict", "options"),
    [
        *((*row, {}) for row in FILTERED),
        *((*row, OPEN) for row in SEEING),
        *((name, [()], ALLOWED, {}) for name in ("truncate", "chmod", "utimensat", "openat2")),
    ],
)
def test_the_filter_decides_by_call_and_arguments(
    call: Any,
    arguments: list[tuple[int, ...]],
    verdict: int,
    options: dict[str, bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "x86_64")
    program = seccomp.policy_filter(**options)
    number = NUMBERS["x86_64"].get(call, call)
    assert {allowed(program, number, *each) for each in arguments} == {verdict}


def test_on_an_unknown_processor_there_is_no_filter_and_no_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "riscv64")
    assert not seccomp.supported()
    with pytest.raises(SandboxError, match="riscv64"):
        seccomp.policy_filter()


def test_output_beyond_its_limit_is_read_and_dropped() -> None:
    import os

    reading, writing = os.pipe()
    output = Output(reading, 10)
    os.write(writing, b"12345678")
    output.drain()
    os.write(writing, b"90abc")
    output.drain()
    assert output.open
    os.close(writing)
    output.drain()
    assert not output.open
    assert output.take_output() == b"1234567890"
    os.close(reading)
