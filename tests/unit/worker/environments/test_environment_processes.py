"""What a process that plays environments is started with, imports and prints."""

from __future__ import annotations

import os

import pytest
from program_runs import run_python

from evopolicy_worker.environments import process_environment
from evopolicy_worker.environments.interface import settings


def run(program: str, **extra: str) -> str:
    result = run_python(program, env={"PATH": os.environ["PATH"], **extra})
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout.strip()


LOADED = """
import sys
from evopolicy_worker.environments import make, offered
{}
simulators = {{"gymnasium", "mujoco", "pygame", "Box2D", "minigrid", "highway_env", "gymnasium_robotics", "pandas"}}
print(*sorted({{name.split(".")[0] for name in sys.modules}} & simulators))
"""


@pytest.mark.parametrize(
    ("made", "loaded"),
    [
        pytest.param("offered(); make('toy/line'); make('toy/maze')", "", id="toys"),
        pytest.param("make('gym/acrobot')", "gymnasium", id="acrobot"),
    ],
)
def test_no_simulator_but_an_environments_own_is_imported(made: str, loaded: str) -> None:
    assert run(LOADED.format(made)) == loaded


@pytest.mark.parametrize("env_id", ["gymnasium/FetchPush-v4", "gymnasium/roundabout-v0", "gym/racing"])
def test_libraries_print_and_warn_nothing(env_id: str) -> None:
    program = f"""
from evopolicy_worker.environments import make
from evopolicy_common.messages.environment import Case
environment = make({env_id!r}); environment.reset(Case(seed=1)); environment.close(); print('quiet')
"""
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
