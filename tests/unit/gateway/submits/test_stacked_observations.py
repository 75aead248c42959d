"""Observations by the size of an episode's stacked ones, as in the published software v0.1.0."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest

from evopolicy_common.records.episodes.npz import NpzWriter
from evopolicy_gateway.submits.episode_files import as_published


def rows(obs: list[Any]) -> bytes:
    lines = (
        json.dumps({"t": t, "obs": each, "action": 0.1, "reward": -1.0, "info": {}})
        for t, each in enumerate(obs)
    )
    return "".join(f"{line}\n" for line in lines).encode()


def shown(files: dict[str, bytes]) -> list[Any]:
    return [json.loads(line)["obs"] for line in files["trajectory.jsonl"].splitlines()]


@pytest.mark.parametrize(
    ("obs", "inline", "dtype"),
    [
        ([[0.5, 1.5]] * 256, True, None),
        ([[0.5, 1.5]] * 257, False, "float64"),
        ([[0, 255]] * 2048, True, None),
        ([[0, 255]] * 2049, False, "uint8"),
        ([[0, 256]] * 256, True, None),
        ([[-1, 0]] * 257, False, "int64"),
        ([7] * 4096, True, None),
        ([7] * 4097, False, "uint8"),
        ([[1.0], [1.0, 2.0]] * 3000, True, None),
        (["words"] * 3000, True, None),
        ([{"a": {"b": [0.5] * 600}}] * 2, True, None),
        (["NaN", 1.0] * 600, True, None),
    ],
)
def test_the_threshold_counts_the_whole_stacked_episode(
    obs: list[Any], inline: bool, dtype: str | None
) -> None:
    files = as_published({"trajectory.jsonl": rows(obs), "video.mp4": b"v"})
    assert files["video.mp4"] == b"v"
    if inline:
        assert shown(files) == obs
        assert sorted(files) == ["trajectory.jsonl", "video.mp4"]
        return
    assert shown(files) == [None] * len(obs)
    stacked = np.load(io.BytesIO(files["observations.npy"]))
    assert (stacked.dtype.name, stacked.tolist()) == (dtype, obs)
    assert json.loads(files["trajectory.jsonl"].splitlines()[0])["action"] == 0.1


def test_flat_dictionaries_are_summed_and_stored_by_name() -> None:
    obs = [{"goal": [0.5] * 8, "n": 3}] * 63
    assert shown(as_published({"trajectory.jsonl": rows(obs)})) == obs
    files = as_published({"trajectory.jsonl": rows(obs + obs[:1])})
    arrays = np.load(io.BytesIO(files["observations.npz"]))
    assert (arrays["goal"].shape, arrays["n"].dtype.name) == ((64, 8), "uint8")
    assert shown(files) == [None] * 64


@pytest.mark.parametrize(("n", "inline"), [(2, False), (1, True)])
def test_pictures_beside_the_rows_are_stacked_too(n: int, inline: bool) -> None:
    pictures = np.arange(n * 48 * 48, dtype=np.uint8).reshape(n, 48, 48)
    writer = NpzWriter()
    writer.add("observations", pictures)
    files = as_published(
        {"trajectory.jsonl": rows([None] * n), "observations.npz": b"".join(writer.finish())}
    )
    if inline:
        assert shown(files) == pictures.tolist()
        assert sorted(files) == ["trajectory.jsonl"]
    else:
        assert np.array_equal(np.load(io.BytesIO(files["observations.npy"])), pictures)
        assert sorted(files) == ["observations.npy", "trajectory.jsonl"]


def test_an_episode_without_steps_keeps_its_empty_rows() -> None:
    assert as_published({"trajectory.jsonl": b""}) == {"trajectory.jsonl": b""}
