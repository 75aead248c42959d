"""A few bytes that claim to be a trajectory of gigabytes are refused before memory is taken for them."""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from program_runs import run_python

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records.episodes import columns, trajectory

HEADER = {"record": "full", "observations": "arrays"}
ROW: dict[str, Any] = {
    **{name: ["values", [None]] for name in ("obs", "actions")},
    "rewards": bytes(8),
    "flags": bytes(1),
    "infos": 1,
}
pack = msgspec.msgpack.encode


def framed(*frames: bytes) -> bytes:
    return b"".join(
        [trajectory.MAGIC, *(struct.pack("<I", len(f)) + f for f in (pack(HEADER), *frames)), bytes(4)]
    )


def block(**changes: Any) -> bytes:
    return zstandard.ZstdCompressor().compress(pack(ROW | changes))


def claim(size: int) -> bytes:
    """A zstd frame that claims `size` bytes and holds one."""
    return bytes.fromhex("28b52ffd") + b"\xa0" + struct.pack("<I", size) + bytes.fromhex("0b000000")


def nested(kind: bytes, depth: int) -> bytes:
    return kind * depth + b"\xc0"


def raw_block(field: str, value: bytes) -> bytes:
    marker = b"\xa7MARKED!"
    packed = pack(ROW | {field: "MARKED!"})
    assert packed.count(marker) == 1
    return zstandard.ZstdCompressor().compress(packed.replace(marker, value))


def listed(n: int, item: bytes) -> bytes:
    return b"\x92\xa6values\xdd" + struct.pack(">I", n) + item * n


HOSTILE = {
    "rows without infos that nobody sent": lambda: [block(infos=1 << 28)],
    "a block that claims a gigabyte": lambda: [claim(1 << 28)],
    "pictures that claim a gigabyte": lambda: [block(obs=["pictures", 1, "|u1", [1 << 28], claim(1 << 28)])],
    "pictures in each of many parts": lambda: [
        block(obs=["tuple", 1, [["pictures", 1, "|u1", [1 << 20], claim(1 << 20)]] * 999])
    ],
    "an array of four billion empty lists": lambda: [block(obs=["array", 1, "|u1", [2**32 - 1, 0], b""])],
    "an array of rows that are empty": lambda: [block(actions=["array", 2**40, "|u1", [0], b""])],
    "a negative shape": lambda: [block(obs=["pictures", -1, "|u1", [-(1 << 28)], claim(1 << 28)])],
    "an array of a thousand axes": lambda: [block(obs=["array", 1, "|u1", [1] * 1000, b"x"])],
    "a dtype of its own": lambda: [block(obs=["array", 1, "(999999999,)u1", [1], b"x"])],
    "millions of empty lists": lambda: [raw_block("actions", listed(60_000_000, b"\x90"))],
    "millions of empty lists in many blocks": lambda: [
        raw_block("actions", listed(3_000_000, b"\x90")) for _ in range(40)
    ],
    "millions of numbers": lambda: [
        raw_block("infos", b"\xdd" + struct.pack(">I", 60_000_000) + b"\xc0" * 60_000_000)
    ],
    "more rows than a block has": lambda: [
        block(rewards=bytes(8 << 20), flags=bytes(1 << 20), infos=1 << 20)
    ],
    "lists without end": lambda: [raw_block("actions", b"\x92\xa6values" + nested(b"\x91", 10_000_000))],
    "maps without end": lambda: [raw_block("infos", nested(b"\x81\xa0", 1_000_000))],
    "columns without end": lambda: [raw_block("obs", nested(b"\x93\xa5tuple\x01\x91", 100_000))],
}


DECODES = """
import os, resource, sys
from evopolicy_common import errors
from evopolicy_common.records.episodes import trajectory

trajectory.decode(trajectory.Recorder().finish())
for path in sys.argv[1:]:
    if child := os.fork():
        os.waitpid(child, 0)
        continue
    resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))
    data = open(path, "rb").read()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        trajectory.decode(data)
        verdict = "read"
    except errors.ProtocolError as error:
        verdict = type(error.__cause__).__name__
    print(os.path.basename(path), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, verdict)
    sys.stdout.flush()
    os._exit(0)
"""


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """By number: the KiB that a process took to decode it, and the cause of its refusal."""
    folder = tmp_path_factory.mktemp("hostile")
    for number, made in enumerate(HOSTILE.values()):
        data = framed(*made())
        assert len(data) < 200_000
        (folder / str(number)).write_bytes(data)
    ran = run_python(DECODES, *(folder / str(number) for number in range(len(HOSTILE))), timeout=570)
    assert ran.stderr == ""
    lines = [line.split() for line in ran.stdout.splitlines()]
    return {number: (int(grown), verdict) for number, grown, verdict in lines}


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("number", "name"), list(enumerate(HOSTILE)))
def test_a_few_hostile_bytes_take_no_memory(
    number: int, name: str, verdicts: dict[str, tuple[int, str]]
) -> None:
    grown, verdict = verdicts[str(number)]  # missing: its process was killed
    assert verdict not in ("MemoryError", "read")
    assert grown < 800_000, f"{grown} KiB"


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(sorted(ROW)),
    st.recursive(
        st.none()
        | st.integers(-(2**63), 2**64 - 1)
        | st.binary(max_size=20)
        | st.sampled_from(
            ["array", "pictures", "scalar", "text", "dict", "tuple", "values", "|u1", "<f8", "<u4"]
        ),
        lambda v: st.lists(v, max_size=5),
        max_leaves=12,
    ),
)
def test_whatever_a_block_says_is_read_or_refused(field: str, value: Any) -> None:
    try:
        found = trajectory.decode(framed(block(**{field: value})))
    except ProtocolError:
        return
    assert len(list(found.rows())) == found.n <= 1


@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.integers(-(2**63), 2**64 - 1)
        | st.floats()
        | st.text(max_size=300)
        | st.binary(max_size=300)
        | st.builds(lambda n: np.zeros(n), st.integers(0, 40)),
        lambda v: st.lists(v, max_size=20) | st.dictionaries(st.text(max_size=3), v, max_size=20),
        max_leaves=30,
    )
)
def test_values_are_counted_as_they_are_packed(value: Any) -> None:
    def count(item: Any) -> int:
        if isinstance(item, dict):
            return 1 + sum(map(count, item.keys())) + sum(map(count, item.values()))
        return 1 + sum(map(count, item)) if isinstance(item, list) else 1

    assert columns.count_values(columns.encoder.encode(value), 1 << 20) == count(value)


def test_what_could_not_be_read_back_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "MAX_ROWS", 100)
    recorder = trajectory.Recorder()
    for t in range(101):
        recorder.append(t, 0, 0.0, False, False, {})
    with pytest.raises(ProtocolError, match="101 steps"):
        recorder.finish()
    for shape in ((2**32 - 1, 0), (1,) * 33):
        with pytest.raises(ValueError, match="an array of shape"):
            columns.pack([np.empty(shape)])
