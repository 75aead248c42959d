"""Videos of episodes: a frame a row, and nothing of the episode is another for them."""

from __future__ import annotations

import ctypes.util
import io

import av
import msgspec
import pytest
from slots import HONEST, Slots

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_worker import environments
from evopolicy_worker.episodes.video import MAX_FAILURES, VideoRecorder

ENVIRONMENTS = ["toy/line", "gymnasium/MiniGrid-FourRooms-v0"]
if ctypes.util.find_library("EGL"):
    ENVIRONMENTS.append("gymnasium/FetchPickAndPlace-v4")


def n_frames(outcome: EpisodeOutcome) -> int:
    assert outcome.video is not None
    assert outcome.video.inline is not None
    with av.open(io.BytesIO(outcome.video.inline)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        return sum(1 for _ in container.decode(video=0))


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_a_video_has_a_frame_a_row_and_changes_nothing(slots: Slots, env: str) -> None:
    plain = slots.play(None, env=env)
    filmed = slots.play(None, env=env, video=True)
    assert plain.video is None
    assert n_frames(filmed) == filmed.length > 0
    same = {"video": None, "wall_s": 0.0}
    assert msgspec.structs.replace(filmed, **same) == msgspec.structs.replace(plain, **same)


def test_only_as_many_of_a_jobs_episodes_as_asked_have_a_video(slots: Slots) -> None:
    outcomes = slots.play_all(HONEST, n=3, policy_scope="submit", video=True, video_episodes=1)
    assert [outcome.video is not None for outcome in outcomes] == [True, False, False]


def test_a_runs_own_limit_of_steps_leaves_the_video(slots: Slots) -> None:
    outcome = slots.play(None, video=True, max_steps=7)
    assert (outcome.truncated, outcome.length, n_frames(outcome)) == (True, 7, 7)


def test_what_cannot_be_drawn_has_no_video_and_a_note(capfd: pytest.CaptureFixture[str]) -> None:
    description = environments.describe("toy/line")
    case = Case(seed=1)
    recorder = VideoRecorder()
    for _ in range(MAX_FAILURES + 1):
        assert recorder.record(description, case, b"no trajectory", 1, lambda: False) is None
    undrawn = msgspec.structs.replace(description, renders=False)
    assert recorder.record(undrawn, case, b"", 1, lambda: False) is None
    recorder.close()
    printed = capfd.readouterr().err
    assert "note: no video of an episode of toy/line" in printed
    assert "note: no video: toy/line does not render" in printed
