"""Frames between the environment's process and the policy's, and the filter: without any process."""

from __future__ import annotations

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
from evopolicy_common.seccomp.numbers import NUMBERS
from evopolicy_worker.episodes import frames
from evopolicy_worker.episodes.monitor import Output
from evopolicy_worker.sandbox import seccomp
from evopolicy_worker.sandbox.inside import player

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
    payload = b"".join(bytes(part) for part in frames.compile_writer(SPACE)(obs))
    make_buffer, read = player.observation_reader(SPACE, False)
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


def test_an_observation_of_another_shape_is_the_environments_fault() -> None:
    with pytest.raises(WorkerError, match="shape"):
        frames.compile_writer({"type": "Box", "shape": [3], "dtype": "float32"})(np.zeros(4, np.float32))


@settings(max_examples=400)
@given(st.integers(0, 255), st.binary(max_size=80))
def test_hostile_replies_are_an_action_or_refused_and_nothing_else(tag: int, payload: bytes) -> None:
    try:
        frames.action(tag, payload)
    except frames.BadReplyError:
        pass
    try:
        frames.report(payload)
    except frames.BadReplyError:
        pass


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
    for tag in (player.ARRAY, player.GENERIC):
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
        frame = player.encoded(action)
    except player.TooLargeError:
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
        *(
            endless,
            1 << 5000,
            np.zeros(1 << 20),
            ["x" * (1 << 20)] * 3,
            [1.0] * 4000,
            [1.0] * 1025,
            [[]] * 2000,
        ),
        *(np.empty((2**32 - 1, 0)), [np.empty((2**32 - 1, 0))], np.empty((2**40, 0)), np.zeros((1,) * 17)),
        *(np.zeros(1025, np.float16), [np.zeros(600, np.bool_)] * 2, {"a": np.empty((1025, 0))}),
    ):
        with pytest.raises(ValueError, match="the action"):
            player.encoded(action)


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


def test_the_filter_lets_threads_be_made_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "x86_64")
    program = seccomp.policy_filter()
    clone, fork, kill, prctl, mount = 56, 57, 62, 157, 165
    assert allowed(program, clone, 0x3D0F00) == bpf.ALLOW  # what pthread_create asks for
    assert allowed(program, clone, 0x1200011) & 0xFFFF == 11  # fork()
    assert allowed(program, clone, 0x10010F00) & 0xFFFF == 11  # a thread in a new namespace
    assert allowed(program, fork) & 0xFFFF == 11
    assert allowed(program, kill, seccomp.PID_MARK, 15) == bpf.ALLOW
    assert allowed(program, kill, 1, 15) & 0xFFFF == 1
    assert allowed(program, prctl, 4, 1) & 0xFFFF == 1
    assert allowed(program, mount) & 0xFFFF == 1
    assert allowed(program, 0x40000000) == bpf.KILL_PROCESS


def test_the_filter_refuses_signals_that_look_like_anothers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "x86_64")
    program = seccomp.policy_filter()
    own, kill, tgkill, prlimit = seccomp.PID_MARK, 62, 234, 302
    for number in range(65):
        allows = number not in (9, 19, 20, 21, 22)
        assert (allowed(program, kill, own, number) == bpf.ALLOW) == allows
        assert (allowed(program, tgkill, own, 5, number) == bpf.ALLOW) == allows
        assert allowed(program, tgkill, 1, 1, number) & 0xFFFF == 1
    assert allowed(program, prlimit, 0, 0, 0, 0x7F00DEADBEEF) == bpf.ALLOW
    for new in (0x7F00DEADBEEF, 0x10000000000, 0x1000):
        assert allowed(program, prlimit, 0, 0, new) & 0xFFFF == 1
        assert allowed(program, prlimit, own, 0, new) & 0xFFFF == 1
    for other in (160, 222, 200, 129, 297, 424, 101, 317):  # setrlimit, timer_create, tkill, … seccomp
        assert allowed(program, other) & 0xFFFF == 1


def test_the_filter_lets_nothing_of_a_shared_file_carry_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "x86_64")
    program = seccomp.policy_filter()
    futex, madvise, fadvise, preadv2, flock, sysinfo = 202, 28, 221, 327, 73, 99
    private, realtime = 128, 256
    for command in (0, 1, 9, 10, 13):  # wait, wake, wait and wake by bits, wait for a PI lock and requeue
        assert allowed(program, futex, 0, command | private) == bpf.ALLOW
        assert allowed(program, futex, 0, command | private | realtime) == bpf.ALLOW
    for wait in (0, 9, 9 | realtime):
        assert allowed(program, futex, 0, wait) & 0xFFFF == 11  # look again: what a join of a thread does
    for wake in (1, 3, 4, 5, 10, 13):
        assert allowed(program, futex, 0, wake) & 0xFFFF == 22
    assert allowed(program, madvise, 0, 0, 4) == bpf.ALLOW  # given back by an allocator
    assert allowed(program, madvise, 0, 0, 21) & 0xFFFF == 22  # out of memory for everybody
    assert allowed(program, fadvise) == bpf.ERRNO  # taken, and ignored
    assert allowed(program, preadv2) & 0xFFFF == 38
    for number in (flock, sysinfo):
        assert allowed(program, number) & 0xFFFF == 1


def test_the_filter_bars_what_is_counted_for_the_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "x86_64")
    program = seccomp.policy_filter()
    mmap, fsync, statx, statfs, pipe2, getxattr = 9, 74, 332, 137, 293, 191
    shared, private, anonymous, huge = 0x01, 0x02, 0x20, 0x40000
    for flags in (private, private | anonymous, shared, 0x03, private | anonymous | 0x20000):
        assert allowed(program, mmap, 0, 4096, 3, flags) == bpf.ALLOW
    for flags in (shared | anonymous, 0x03 | anonymous):
        assert allowed(program, mmap, 0, 4096, 3, flags) & 0xFFFF == 1
    assert allowed(program, mmap, 0, 1 << 21, 3, private | anonymous | huge) & 0xFFFF == 12
    assert allowed(program, statx) & 0xFFFF == allowed(program, statfs) & 0xFFFF == 38
    assert allowed(program, pipe2) & 0xFFFF == 11
    assert allowed(program, getxattr) & 0xFFFF == 95
    assert allowed(program, fsync) == bpf.ERRNO  # said to be done


def test_where_the_machines_files_are_seen_none_is_changed_or_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "x86_64")
    own, seen = seccomp.policy_filter(), seccomp.policy_filter(sees_the_machines_files=True)
    truncate, chmod, utimensat, open_, openat, openat2 = 76, 90, 280, 2, 257, 437
    for number in (truncate, chmod, utimensat, openat2):
        assert allowed(own, number) == bpf.ALLOW
    assert allowed(seen, truncate) & 0xFFFF == 1
    assert allowed(seen, chmod) == allowed(seen, utimensat) == bpf.ERRNO
    assert allowed(seen, openat2) & 0xFFFF == 38
    reading, writing, cutting = 0, 1, 0o1000
    for arguments in ((open_, 0), (openat, 0, 0)):
        assert allowed(seen, *arguments, reading) == bpf.ALLOW
        assert allowed(seen, *arguments, writing | cutting) == bpf.ALLOW  # where it may write at all
        assert allowed(seen, *arguments, reading | cutting) & 0xFFFF == 1


def test_on_an_unknown_processor_there_is_no_filter_and_no_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seccomp.platform, "machine", lambda: "riscv64")
    assert not seccomp.supported()
    with pytest.raises(SandboxError, match="riscv64"):
        seccomp.policy_filter()


def test_output_beyond_its_limit_is_read_and_dropped() -> None:
    import os

    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    output = Output(10)
    os.write(writing, b"12345678")
    output.drain(reading)
    os.write(writing, b"90abc")
    output.drain(reading)
    assert output.open
    os.close(writing)
    output.drain(reading)
    assert not output.open
    assert output.take() == b"1234567890"
    os.close(reading)
