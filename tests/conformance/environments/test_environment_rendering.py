"""Every environment renders without a display, and rendering changes nothing of the episode."""

from __future__ import annotations

import ctypes.util
import json

import pytest
from environment_checks import FRAMES, IDS, elsewhere, play

from evopolicy_common.errors import WorkerError
from evopolicy_worker.environments import make, process_environment
from evopolicy_worker.environments.families import mujoco

DRAWS_WITH_EGL = [env_id for env_id in IDS if env_id.endswith("5") or "Fetch" in env_id]
DRAWABLE = [env_id for env_id in IDS if env_id not in DRAWS_WITH_EGL or ctypes.util.find_library("EGL")]


@pytest.fixture(scope="session")
def rendered() -> dict[str, list[str]]:
    """Episodes of all ids with a frame per step. In a process of its own: the driver is chosen at its start."""
    return elsewhere("render", *DRAWABLE)


@pytest.mark.parametrize("env_id", DRAWABLE)
def test_rendering_changes_nothing_of_the_episode(env_id: str, rendered: dict[str, list[str]]) -> None:
    environment = make(env_id)
    assert play(environment, steps=FRAMES) == rendered[env_id]
    environment.close()


@pytest.mark.parametrize("env_id", DRAWABLE)
def test_a_frame_is_a_picture(env_id: str, rendered: dict[str, list[str]]) -> None:
    height, width, channels, darkest, brightest = json.loads(rendered[f"{env_id} frame"][0])
    assert min(height, width) >= 32
    assert channels == 3
    assert brightest - darkest > 50, "nothing is drawn"


@pytest.mark.parametrize("env_id", DRAWS_WITH_EGL)
def test_without_egl_a_rendering_environment_says_what_to_install(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mujoco, "find_library", lambda name: None)
    for name, value in process_environment(render=True).items():
        monkeypatch.setenv(name, value)  # so that what the attempt sets is taken back
    with pytest.raises(WorkerError, match="libegl1"):
        make(env_id, render=True)


@pytest.mark.parametrize("env_id", ["gym/acrobot", "toy/line", "gymnasium/FetchPush-v4"])
def test_an_environment_not_made_to_render_refuses_to(env_id: str) -> None:
    environment = make(env_id)
    with pytest.raises(WorkerError, match="render=True"):
        environment.render()
    environment.close()
