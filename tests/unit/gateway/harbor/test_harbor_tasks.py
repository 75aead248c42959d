"""Harbor tasks of open runs, and the scores that their verifiers get."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import tomllib
from pathlib import Path

import pytest
from invented.policies import Version
from invented.run_dirs import write_run
from program_runs import put_program
from starlette.testclient import TestClient

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_gateway.harbor import scores
from evopolicy_gateway.harbor.scores import make_app, tasks_in, token_of, write_task
from evopolicy_gateway.run_folder.layout import RunFolder, save
from evopolicy_gateway.run_folder.listener import Listener, finish

URL = "http://10.0.0.5:8090"


def bearer(tasks: Path, task: str = "t") -> dict[str, str]:
    """The header with a task's token."""
    return {"Authorization": f"Bearer {token_of(tasks, task)}"}


def open_run(tmp_path: Path, entry: str = "GPT 5.5 (Codex)") -> RunFolder:
    """A run of a remote agent, as `evopolicy run` leaves it while the agent plays."""
    folder = RunFolder(tmp_path / "runs" / entry / "gym_acrobot" / "first")
    folder.state.mkdir(parents=True)
    save(folder.listener, Listener(host="10.0.0.5", port=0))
    save(
        folder.intended,
        CreateRun(key="k", settings=RunSettings(env="gym/acrobot", entry="e", model="m", exp_id="first")),
    )
    folder.bearer.write_text("b" * 64 + "\n")
    return folder


def test_a_task_is_private_and_its_agent_cannot_ask_for_the_score(tmp_path: Path) -> None:
    tasks = tmp_path / "tasks"
    folder = open_run(tmp_path)
    place = write_task(tasks, folder.root, URL, 60.0)
    assert place == tasks / "gpt-5.5-codex-gym_acrobot-first"
    files = [path for path in place.rglob("*") if path.is_file()]
    assert {stat.S_IMODE(path.stat().st_mode) & 0o077 for path in files} == {0}
    token = token_of(tasks, place.name)
    assert [path.name for path in files if token in path.read_text()] == ["test.sh"]
    assert f"{URL}/{place.name}" in (place / "tests/test.sh").read_text()
    assert subprocess.run(["sh", "-n", place / "tests/test.sh"], check=False).returncode == 0
    task = tomllib.loads((place / "task.toml").read_text())
    assert task["environment"]["env"] == {"EVOPOLICYGYM_TOKEN": "b" * 64}
    # Harbor stops the agent's container before it starts another for the verifier.
    assert task["verifier"]["environment_mode"] == "separate"
    services = json.loads((place / "environment/docker-compose.yaml").read_text())["services"]
    volumes = services["main"]["volumes"]
    assert [(each["source"], each["target"], each["read_only"]) for each in volumes] == [
        (str(folder.workspace), "/work", False),
        (str(folder.workspace / "feedback"), "/work/feedback", True),
        (str(folder.workspace / "AGENTS.md"), "/work/AGENTS.md", True),
    ]


def test_tasks_are_served_again_with_the_same_token(tmp_path: Path) -> None:
    tasks = tmp_path / "tasks"
    folder = open_run(tmp_path)
    place = write_task(tasks, folder.root, URL, 60.0)
    before = (place / "tests/test.sh").read_text()
    write_task(tasks, folder.root, URL, 60.0)
    assert (place / "tests/test.sh").read_text() == before
    assert tasks_in(tasks) == {place.name: folder}
    (tasks / "other").mkdir()
    (tasks / "other/task.toml").write_text("[task]\n")
    with pytest.raises(ConfigError, match="not a task of"):
        tasks_in(tasks)


def test_two_runs_never_share_a_task(tmp_path: Path) -> None:
    tasks = tmp_path / "tasks"
    first, second = open_run(tmp_path), open_run(tmp_path, "GPT-5.5-Codex")
    place = write_task(tasks, first.root, URL, 60.0)
    with pytest.raises(ConfigError, match="already the task of"):
        write_task(tasks, second.root, URL, 60.0)
    assert tasks_in(tasks) == {place.name: first}


def test_any_path_of_a_run_is_read_from_its_task_again(tmp_path: Path) -> None:
    folder = open_run(tmp_path / 'a "b" \\ ä 🚀 \x7f \n $', "(+)")
    place = write_task(tmp_path / "tasks", folder.root, URL, 60.0)
    assert place.name == "gym_acrobot-first"
    assert tasks_in(tmp_path / "tasks") == {place.name: folder}


def test_a_verifier_waits_for_a_service_that_is_busy(tmp_path: Path) -> None:
    test = write_task(tmp_path / "tasks", open_run(tmp_path).root, URL, 60.0) / "tests" / "test.sh"
    programs = tmp_path / "programs"
    answers = tmp_path / "answers"
    answers.write_text("000\n503\n202\n409\n")
    for name, text in {"curl": f"sed -n 1p {answers}; sed -i 1d {answers}", "sleep": ":", "cat": ":"}.items():
        put_program(programs / name, text)
    path = f"{programs}:{os.environ['PATH']}"
    done = subprocess.run(["sh", test], env={"PATH": path}, timeout=60, check=False)
    assert (done.returncode, answers.read_text()) == (1, "")


def test_a_run_ending_in_a_request_keeps_its_score(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = RunFolder(write_run(tmp_path, [Version({"policy.py": "x = 1"}, (1.0, 2.0), 0.5)]))
    record = folder.run_json.read_bytes()
    folder.run_json.unlink()

    def end(folder: RunFolder) -> None:
        # The gateway's files are gone already, as a run's end removes them.
        folder.run_json.write_bytes(record)
        finish(folder)

    monkeypatch.setattr(scores, "finish", end)
    client = TestClient(make_app({"t": folder}, tmp_path))
    assert [client.post("/t", headers=bearer(tmp_path)).status_code for _ in range(2)] == [202, 200]


def test_a_run_that_no_remote_agent_plays_has_no_task(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no open run of a remote agent"):
        write_task(tmp_path / "tasks", tmp_path, URL, 60.0)
    assert not (tmp_path / "tasks").exists()


def test_a_verifier_ends_its_own_run_and_gets_its_score(tmp_path: Path) -> None:
    """The tasks of a folder shared one token: whoever had one task's could end every other run."""
    folder = open_run(tmp_path)
    client = TestClient(make_app({"t": folder, "other": folder}, tmp_path))
    wrong = ({}, {"Authorization": "Bearer u"}, {b"Authorization": b"Bearer \xe9"}, bearer(tmp_path, "other"))
    for headers in wrong:
        assert client.post("/t", headers=headers).status_code == 401
    assert not folder.finish.exists()
    assert client.post("/missing", headers=bearer(tmp_path, "missing")).status_code == 404
    assert client.get("/t", headers=bearer(tmp_path)).status_code == 405
    assert client.post("/t", headers=bearer(tmp_path)).status_code == 202
