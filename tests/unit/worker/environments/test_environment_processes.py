"""What a process that plays environments is started with, imports and prints."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from evopolicy_worker.environments import process_environment
from evopolicy_worker.environments.interface import settings


def run(program: str, **extra: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", program],
        env={"PATH": os.environ["PATH"], **extra},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert result.stderr == ""
    return result.stdout.strip()


def test_offering_and_playing_a_toy_import_no_simulator() -> None:
    program = (
        "import sys\n"
        "from evopolicy_worker.environments import make, offered\n"
        "offered(); make('toy/line'); make('toy/maze')\n"
        "print(sorted({name.split('.')[0] for name in sys.modules} & "
        "{'gymnasium', 'mujoco', 'pygame', 'Box2D', 'minigrid', 'highway_env', 'gymnasium_robotics', 'pandas'}))"
    )
    assert run(program) == "[]"


def test_a_family_imports_no_simulator_but_its_own() -> None:
    program = (
        "import sys\n"
        "from evopolicy_worker.environments import make\n"
        "make('gym/acrobot')\n"
        "print(sorted({name.split('.')[0] for name in sys.modules} & "
        "{'gymnasium', 'mujoco', 'Box2D', 'minigrid', 'highway_env', 'gymnasium_robotics', 'pandas'}))"
    )
    assert run(program) == "['gymnasium']"


@pytest.mark.parametrize("env_id", ["gymnasium/FetchPush-v4", "gymnasium/roundabout-v0", "gym/racing"])
def test_libraries_print_and_warn_nothing(env_id: str) -> None:
    program = (
        "from evopolicy_worker.environments import make\n"
        "from evopolicy_common.messages.environment import Case\n"
        f"environment = make({env_id!r}); environment.reset(Case(seed=1)); environment.close(); print('quiet')"
    )
    assert run(program) == "quiet"


def test_the_renderer_is_chosen_only_for_processes_that_render() -> None:
    assert "MUJOCO_GL" not in process_environment()
    assert process_environment(render=True)["MUJOCO_GL"] == "egl"
    assert process_environment()["SDL_VIDEODRIVER"] == "offscreen"
    assert process_environment()["OMP_NUM_THREADS"] == "1"


def test_settings_fill_in_only_what_is_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "environ", {"OMP_NUM_THREADS": "2"})
    settings.apply()
    assert os.environ["OMP_NUM_THREADS"] == "2"
    assert os.environ["SDL_VIDEODRIVER"] == "offscreen"
    assert "PYTHONHASHSEED" not in os.environ
