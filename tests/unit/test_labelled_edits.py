"""The labelled edits of the smoke report: the classifier finds in them what their names say."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from evopolicy_common import catalogue
from evopolicy_gateway.agents.replay import folder_for, policies_in
from evopolicy_results.code.sources import reachable_modules, source_digest
from evopolicy_results.code.topology import describe

SCRIPT = Path(__file__).parents[2] / "examples/smoke-report/labelled_edits.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("labelled_edits", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def written(script: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("edits")
    script.write(out)
    return out


@pytest.mark.parametrize("env", catalogue.suites()["core16"].environments)
def test_every_edit_is_of_the_type_that_its_name_says(written: Path, env: str) -> None:
    seen: list[tuple[str, str]] = []
    found = []
    for folder in policies_in(folder_for(written, env)):
        files = {path.name: path.read_bytes() for path in folder.glob("*.py")}
        modules = reachable_modules(files)
        now = (source_digest(modules), describe(modules)[0])
        if not seen:
            edit = "first"
        elif now[0] == seen[-1][0]:
            edit = "retest"
        elif now[1] == seen[-1][1]:
            edit = "parametric"
        else:
            edit = "rollback" if now[1] in {topology for _, topology in seen} else "synthesis"
        found.append(f"{len(seen):02d}-{edit}")
        seen.append(now)
    assert found == [folder.name for folder in policies_in(folder_for(written, env))]
    assert {label[3:] for label in found} == {"first", "synthesis", "parametric", "retest", "rollback"}


@pytest.mark.parametrize(
    ("env", "names"),
    [
        ("gym/racing", ["", "gym_racing"]),
        ("my_env:Glider-v0", ["", "my_env:Glider-v0", "my_env_Glider-v0"]),
        ("gym/acrobot@w2", ["", "gym_acrobot", "gym_acrobot@w2"]),
        ("gymnasium/MiniGrid-Empty-v0", ["", "gymnasium_MiniGrid", "gymnasium_MiniGrid-Empty-v0"]),
    ],
)
def test_an_environment_is_played_by_the_policies_in_its_nearest_folder(
    env: str, names: list[str], tmp_path: Path
) -> None:
    for name in names:  # each is preferred to the ones before it
        (tmp_path / name).mkdir(exist_ok=True)
        assert folder_for(tmp_path, env) == tmp_path / name
