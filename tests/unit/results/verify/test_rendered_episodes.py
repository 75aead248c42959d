"""Episodes that workers rendered, against recordings of the same actions and against feedback files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evopolicy_common.messages.environment import ObsStorage
from evopolicy_common.records.episodes.compare import (
    Rows,
    action_log,
    files_difference,
    first_difference,
)
from evopolicy_common.records.episodes.rendered import OBSERVATIONS, ROWS, Renderer, decode
from evopolicy_common.records.episodes.trajectory import Recorder, Trajectory

KINDS: dict[str, tuple[Any, ObsStorage]] = {
    "state": (np.array([0.1, np.nan, -0.0], dtype=np.float32), "inline"),
    "pictures": (np.full((20, 20, 3), 7, dtype=np.uint8), "npz"),
    "parts": ({"eye": np.full((20, 20), 7, dtype=np.uint8), "n": 3, "text": "go"}, "npz"),
}


def episode(recorder: Recorder, usual: Any, n: int = 4, **changed: Any) -> Trajectory:
    for t in range(n):
        info = {"steps": t} | ({"policy_failed": True} if changed.get("failed") else {})
        if t == 2:
            info |= changed.get("info", {})
        seen = changed.get("obs", usual) if t == 2 else usual
        reward = changed.get("reward", 0.5) if t == 2 else 0.5
        recorder.append(seen, np.array([0.1 * t], dtype=np.float32), reward, t == n - 1, False, info)
    return decode(recorder.finish())


@pytest.mark.parametrize("kind", KINDS)
def test_a_rendered_episode_and_its_replay_are_the_same(kind: str) -> None:
    obs, storage = KINDS[kind]
    recorded = episode(Renderer("arrays", storage), obs)
    replayed = episode(Recorder(), obs, failed=True)  # the mark is the policy's, not the environment's
    assert first_difference(recorded, replayed) is None
    assert first_difference(replayed, recorded) is None
    assert first_difference(recorded, recorded) is None
    assert action_log(recorded.actions) == action_log(replayed.actions)


@pytest.mark.parametrize("kind", KINDS)
def test_each_difference_of_a_replay_is_reported(kind: str) -> None:
    obs, storage = KINDS[kind]
    recorded = episode(Renderer("arrays", storage), obs)
    other = {**obs, "n": 4} if isinstance(obs, dict) else obs + obs.dtype.type(1)
    assert "the observations differ" in (
        first_difference(recorded, episode(Recorder(), obs, obs=other)) or ""
    )
    assert first_difference(recorded, episode(Recorder(), obs, info={"x": 1})) == "step 2: the infos differ"
    assert "step 2: reward" in (first_difference(recorded, episode(Recorder(), obs, reward=0.25)) or "")
    assert first_difference(recorded, episode(Recorder(), obs, n=5)) is not None


def test_a_number_that_is_one_bit_away_is_reported() -> None:
    obs = np.array([0.1, 1.0], dtype=np.float32)
    recorded = episode(Renderer("arrays", "inline"), obs)
    near = np.nextafter(obs, np.float32(2))
    assert first_difference(recorded, episode(Recorder(), obs, obs=near)) == "step 2: the observations differ"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stored", [True, False])
def test_feedback_files_are_held_against_a_rendered_episode_and_a_replay(
    tmp_path: Path, kind: str, stored: bool
) -> None:
    obs, storage = KINDS[kind]
    rendered = episode(Renderer("arrays", storage), obs)
    against = rendered if stored else episode(Recorder(), obs)
    for name, data in rendered.files.items():
        (tmp_path / name).write_bytes(data)
    assert files_difference(tmp_path, Rows(tmp_path), against, actions=True) is None
    if storage == "npz":
        other = {**obs, "n": 4} if isinstance(obs, dict) else obs + obs.dtype.type(1)
        forged = episode(Renderer("arrays", storage), obs, obs=other)
        (tmp_path / OBSERVATIONS).write_bytes(forged.files[OBSERVATIONS])
        assert OBSERVATIONS in (files_difference(tmp_path, Rows(tmp_path), against, actions=True) or "")
        (tmp_path / OBSERVATIONS).unlink()
        assert files_difference(tmp_path, Rows(tmp_path), against, actions=True) is not None
    text = rendered.files[ROWS].replace(b'"reward":0.5', b'"reward":0.25', 1)
    (tmp_path / ROWS).write_bytes(text)
    assert "step 0: reward" in (files_difference(tmp_path, Rows(tmp_path), against, actions=True) or "")
