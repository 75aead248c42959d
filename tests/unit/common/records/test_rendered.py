"""Feedback files that are made where an episode was played: what they hold, and what is believed of them."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.environment import ObservationForm, ObsStorage
from evopolicy_common.records.episodes import columns, rendered, trajectory
from evopolicy_common.records.episodes.npz import NpzWriter, crc_of_both
from evopolicy_common.records.episodes.rendered import (
    LEFT_OUT,
    OBSERVATIONS,
    ROWS,
    Renderer,
    checked_files,
    decode,
    files_of,
)
from evopolicy_common.records.episodes.trajectory import Recorder

odd_actions = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(),
        st.sampled_from(['},{"t":', "null", "NaN", "\ud800"]),
        st.builds(
            lambda values: np.array(values, dtype=np.float32), st.lists(st.floats(width=32), max_size=3)
        ),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(["t", "reward", "null", '},{"t":']), inner, max_size=2),
    ),
    max_leaves=5,
)
observations = st.one_of(
    st.builds(lambda x: np.array([x, 1.5], dtype=np.float32), st.floats(width=32)),
    st.builds(lambda x: {"a": np.full((2, 2), x, dtype=np.uint8), "b": ("go", x)}, st.integers(0, 255)),
    st.integers(-5, 5),
)
steps = st.lists(st.tuples(observations, odd_actions, st.floats(-9, 9)), min_size=1, max_size=6)


def recorded(recorder: Recorder, rows: list[tuple[Any, Any, float]]) -> bytes:
    for t, (obs, action, reward) in enumerate(rows):
        recorder.append(obs, action, reward, t == len(rows) - 1, False, {"steps": t, "note": 'a},{"t":'})
    return recorder.finish()


@settings(max_examples=150, deadline=None)
@given(steps, st.sampled_from(["arrays", "lists"]))
def test_rendered_rows_are_those_of_the_trajectory(
    rows: list[tuple[Any, Any, float]], form: ObservationForm
) -> None:
    then = files_of(trajectory.decode(recorded(Recorder("full", form), rows)), "inline")
    data = recorded(Renderer(form, "inline"), rows)
    assert decode(data).files == then
    assert checked_files(data, len(rows), sum_of(rows)) == then


def sum_of(rows: list[tuple[Any, Any, float]]) -> float:
    total = 0.0
    for _, _, reward in rows:
        total += reward
    return total


@settings(max_examples=50, deadline=None)
@given(steps)
def test_the_log_holds_the_actions_bit_for_bit(rows: list[tuple[Any, Any, float]]) -> None:
    ours = decode(recorded(Renderer("arrays", "inline"), rows))
    theirs = trajectory.decode(recorded(Recorder(), rows))
    assert columns.encode({"": list(ours.actions)}) == columns.encode({"": list(theirs.actions)})
    assert ours.rewards.tobytes() == theirs.rewards.tobytes()
    assert (ours.n, ours.record, ours.terminated.tolist()) == (theirs.n, "full", theirs.terminated.tolist())


@pytest.mark.parametrize("shape", [(20, 20), (20, 20, 1), (96, 96, 3), (4, 20, 20)])
def test_pictures_are_read_with_numpy_alone(shape: tuple[int, ...]) -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (70, *shape)).astype(np.uint8)
    files = decode(recorded(Renderer("arrays", "npz"), [(picture, 0, 1.0) for picture in pictures])).files
    with np.load(io.BytesIO(files[OBSERVATIONS]), allow_pickle=False) as stored:
        assert stored.files == ["observations"]
        np.testing.assert_array_equal(stored["observations"], pictures)
    assert all(json.loads(line)["obs"] is None for line in files[ROWS].splitlines())


@pytest.mark.parametrize("held", [0, 1000, 3000])
def test_the_bytes_do_not_depend_on_how_many_pictures_wait(
    held: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (9, 20, 20)).astype(np.uint8)
    rows = [(picture, 0, 1.0) for picture in pictures]
    at_the_end = recorded(Renderer("arrays", "npz"), rows)
    monkeypatch.setattr(rendered, "HELD_BYTES", held)
    assert recorded(Renderer("arrays", "npz"), rows) == at_the_end


def test_parts_of_an_observation_are_arrays_of_their_own_over_many_blocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(trajectory, "BLOCK_BYTES", 4000)
    rows = [
        ({"eye": np.full((20, 20), t, dtype=np.uint8), "n": t, "text": f"go {t}"}, t, 0.5) for t in range(40)
    ]
    data = recorded(Renderer("arrays", "npz"), rows)
    assert checked_files(data, 40, 20.0) == decode(data).files
    with np.load(io.BytesIO(decode(data).files[OBSERVATIONS])) as stored:
        assert stored["eye"][:, 3, 3].tolist() == list(range(40))
        assert stored["n"].tolist() == list(range(40))
        assert stored["text"].tolist() == [f"go {t}" for t in range(40)]
    assert [json.loads(line)["t"] for line in decode(data).files[ROWS].splitlines()] == list(range(40))


def test_an_archive_is_whole_and_the_same_every_time() -> None:
    def archive() -> bytes:
        writer = NpzWriter()
        for t in range(30):
            writer.add("a/b", np.full((1, 9, 9), t, dtype=np.int16))
            writer.add("text", [f"ä{t}"])
        return b"".join(writer.finish())

    assert archive() == archive()
    assert zipfile.ZipFile(io.BytesIO(archive())).testzip() is None


@given(st.binary(max_size=50), st.binary(max_size=300))
def test_a_checksum_of_two_texts_follows_from_theirs(first: bytes, second: bytes) -> None:
    assert crc_of_both(zlib.crc32(first), zlib.crc32(second), len(second)) == zlib.crc32(first + second)


def episode(n: int = 3) -> bytes:
    return recorded(Renderer("arrays", "inline"), [(np.zeros(3), t, 0.5) for t in range(n)])


@pytest.mark.parametrize(("length", "total"), [(2, 1.5), (3, 1.0), (4, 1.5)])
def test_an_episode_of_another_length_or_return_is_not_believed(length: int, total: float) -> None:
    assert ROWS in checked_files(episode(), 3, 1.5)
    with pytest.raises(ProtocolError, match="were declared"):
        checked_files(episode(), length, total)


@pytest.mark.parametrize(
    "action", [0, {"a": 1, "reward": 9.0}, {"reward": 9.0}, '"reward":9.0,"terminated":', ',"reward":9.0']
)
def test_rewards_inside_an_action_are_none_of_the_row(action: Any) -> None:
    rows = [(np.zeros(2), action if t % 2 else 0, 0.1 * t) for t in range(9)]
    data = recorded(Renderer("arrays", "inline"), rows)
    assert checked_files(data, 9, sum_of(rows)) == decode(data).files
    with pytest.raises(ProtocolError, match="were declared"):
        checked_files(data, 9, sum_of(rows) + 9.0)


def row(t: int, reward: str = "0.5") -> bytes:
    return b'{"t":%d,"obs":null,"action":0,"reward":%s,"terminated":false,"truncated":false,"info":{}}\n' % (
        t,
        reward.encode(),
    )


@given(st.integers(0, 400), st.binary(min_size=1, max_size=3))
def test_damaged_bytes_are_an_error_of_the_protocol(at: int, wrong: bytes) -> None:
    whole = episode()
    for data in (
        whole[: at % len(whole)],
        whole[: at % len(whole)] + wrong + whole[at % len(whole) + len(wrong) :],
    ):
        try:
            checked_files(data, 3, 1.5)
            decode(data)
        except ProtocolError:
            pass


File = tuple[dict[str, Any], bytes]


def file(data: bytes, name: str = ROWS, packed: str = "as it is", size: int | None = None) -> File:
    """A file of a container, which may claim another size."""
    claimed = len(data) if size is None else size
    data = zstandard.ZstdCompressor().compress(data) if packed == "zstd" else data
    return {"name": name, "size": claimed, "packed": packed}, data


def container(*files: File) -> bytes:
    """An episode of three steps with these files."""
    header = {"observations": "arrays", "n": 3, "files": [entry for entry, _ in files]}
    parts = [msgspec.msgpack.encode(header), recorded(Recorder("actions"), [(None, 0, 0.5)] * 3)]
    parts += [data for _, data in files]
    return rendered.MAGIC + b"".join(len(part).to_bytes(4, "little") + part for part in parts)


@pytest.mark.parametrize(
    "files",
    [
        # Not the declared steps.
        [file(row(0) + row(2) + row(1), packed="zstd")],
        [file(row(0) + row(1) + row(1), packed="zstd")],
        [file(row(1) + row(2) + row(3), packed="zstd")],
        [file(row(0) + row(1) + row(2, "5e-1x"), packed="zstd")],
        [file(row(0) + row(1) + row(2, '"0.5"'), packed="zstd")],
        [file(row(0) + row(1) + row(2, "null"), packed="zstd")],
        [file(row(0) + row(1) + row(2) + b"{}\n", packed="zstd")],
        [file(row(0) + row(1) + b"\n", packed="zstd")],
        # Bombs, which are not unpacked.
        *([file(bytes(16 << 20), packed="zstd", size=size)] for size in (10, 1 << 40, -1, 1 << 27)),
        # Not the files of feedback.
        [file(b"x", "../policy.py")],
        [file(b"x"), file(b"x")],
    ],
)
def test_a_container_of_other_files_is_refused(files: list[File]) -> None:
    with pytest.raises(ProtocolError):
        checked_files(container(*files), 3, 1.5)


def test_an_archive_that_unpacks_to_more_than_an_episode_is_refused() -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("a.npy", "b.npy"):
            archive.writestr(name, b"x" * 1000)
    data = out.getvalue()
    member = (1000).to_bytes(4, "little")
    lying = data.replace(member, (0xFFFFFFFF).to_bytes(4, "little"))
    rows = file(decode(episode()).files[ROWS], packed="zstd")
    assert OBSERVATIONS in checked_files(container(rows, file(data, OBSERVATIONS)), 3, 1.5)
    with pytest.raises(ProtocolError):
        checked_files(container(rows, file(lying, OBSERVATIONS)), 3, 1.5)


@pytest.mark.parametrize("storage", ["inline", "npz"])
def test_files_that_cannot_be_made_are_left_out_and_the_log_stays(
    storage: ObsStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendered, "MAX_ROWS_BYTES", 100)
    data = recorded(Renderer("arrays", storage), [(np.zeros(3), t, 0.5) for t in range(3)])
    assert (decode(data).n, decode(data).record, decode(data).files) == (3, "actions", {})
    with pytest.raises(ProtocolError, match="100 are the limit"):
        checked_files(data, 3, 1.5)


def test_pictures_beyond_the_bound_are_left_out_and_the_rows_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendered, "MAX_RECORDED_BYTES", 40_000)
    rng = np.random.default_rng(0)
    for n, kept in ((2, {ROWS, OBSERVATIONS}), (4, {ROWS, LEFT_OUT})):
        steps = [(rng.integers(0, 256, (64, 64, 3), np.uint8), t, 0.5) for t in range(n)]
        data = recorded(Renderer("arrays", "npz"), steps)
        files = checked_files(data, n, n / 2)
        assert set(files) == kept
        assert len(files[ROWS].splitlines()) == n
        assert decode(data).record == "full"
    assert b"observations.npz is left out: observations of more than 40,000 bytes" in files[LEFT_OUT]


def test_blocks_of_large_actions_stay_within_their_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "MAX_BLOCK_BYTES", 1 << 16)
    steps = [(0, np.full(512, t, np.float64), 0.5) for t in range(100)]
    for recorder in (Recorder("actions"), Recorder("full"), Renderer("arrays", "inline")):
        actions = decode(recorded(recorder, steps)).actions
        assert np.array_equal(actions, [action for _, action, _ in steps])
