"""The commands of deploy/README.md, in their order, on folders of a test's own: what comes of them fits together."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from documents import blocks_of_commands
from typer.testing import CliRunner

from evopolicy_common.wire import credentials
from evopolicy_coordinator.cli.main import app

DEPLOY = Path(__file__).parents[3] / "deploy"


def run_blocks(wanted: str, places: dict[str, Path]) -> str:
    """Runs the blocks whose certificates are asked for by a command that holds `wanted`, and says what they printed."""
    output = ""
    for block in blocks_of_commands(DEPLOY / "README.md"):
        text = [" ".join(words) for words in block]
        if not any(wanted in line for line in text):
            continue
        for words in block:
            if words[0] != "evopolicy-coordinator":
                continue
            for place, here in places.items():
                words = [word.replace(place, str(here)) for word in words]
            done = CliRunner().invoke(app, words[1:])
            assert done.exit_code == 0, (words, done.output)
            output += done.output
    return output


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made = tmp_path / "state"
    made.mkdir(mode=0o700)
    monkeypatch.setenv("EVOPOLICY_STATE", str(made))
    monkeypatch.chdir(tmp_path)
    return made


def test_the_docker_steps_make_the_folders_that_the_compose_file_mounts(state: Path, tmp_path: Path) -> None:
    machines = tmp_path / "machines"
    machines.mkdir(mode=0o700)
    run_blocks("/machines/router", {"/machines": machines})
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    for name in ("router", "worker"):
        (mount,) = services[name]["volumes"]
        source, target, mode = mount.split(":")
        assert (tmp_path / source).is_dir()
        assert (target, mode) == ("/keys", "ro")
    router = json.loads((machines / "router" / "zenohd.json").read_text())
    assert router["connect"]["endpoints"] == ["tls/coordinator:7447"]
    assert router["listen"]["endpoints"] == ["tls/0.0.0.0:7447"]
    assert router["transport"]["auth"]["usrpwd"]["dictionary_file"] == "/keys/passwords"
    assert "worker/one:" in (machines / "router" / "passwords").read_text()
    found = credentials.find("worker", (), machines / "one")
    assert found.endpoints == ("tls/router:7447",)
    assert services["worker"]["command"][2] == "one"


def test_the_steps_for_a_site_admit_its_worker(state: Path, tmp_path: Path) -> None:
    run_blocks("--host FIRST", {"/var/lib/evopolicy": state, "FIRST": Path("first.lab")})
    output = run_blocks("berlin", {"ROUTER": Path("router.berlin.lab")})
    assert "zenohd --config /etc/evopolicy/router/zenohd.json" in output
    router = json.loads((tmp_path / "router-berlin" / "zenohd.json").read_text())
    assert router["connect"]["endpoints"] == ["tls/first.lab:7447"]
    assert {subject["id"] for subject in router["access_control"]["subjects"]} == {"worker/gpu-8", "uplink"}
    found = credentials.find("worker", (), tmp_path / "worker-gpu-8")
    assert found.endpoints == ("tls/router.berlin.lab:7447",)
    assert (state / "gpu-7" / "worker.json").is_file()
