"""Commands that cannot start are refused at once with the remedy; longer waits have their reason printed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import SMALL, agent, command, ended, record_in, run_arguments, run_dir
from waiting import wait_until

from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials

pytestmark = pytest.mark.system

POLICY = "class Policy:\n  def __init__(self, *a): pass\n  def reset(self, i): pass\n  def act(self, obs): return [0.0]\n"  # noqa: E501
WORKER_IS_PAUSED = (
    "waiting for a worker that offers toy/line with sandbox tier bwrap: those that do are paused"
)


@pytest.fixture
def without_bubblewrap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine like this one on which nobody has installed bubblewrap."""
    programs = tmp_path / "programs"
    programs.mkdir()
    for folder in os.environ["PATH"].split(":"):
        for program in Path(folder).glob("*"):
            if program.name != "bwrap" and not (programs / program.name).is_symlink():
                (programs / program.name).symlink_to(program)
    monkeypatch.setenv("PATH", str(programs))


@pytest.fixture
def policy(tmp_path: Path) -> str:
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy/policy.py").write_text(POLICY)
    return str(tmp_path / "policy")


@pytest.mark.usefixtures("without_bubblewrap")
@pytest.mark.parametrize("name", ["try", "local", "suite"])
def test_a_command_without_bubblewrap_names_the_remedy(tmp_path: Path, policy: str, name: str) -> None:
    (tmp_path / "t.toml").write_text(
        'name = "t"\nenvironments = ["toy/line"]\n[[agents]]\nname = "e"\nagent = "evolve"\n'
        '[agents.jail]\nmode = "none"\n'
    )
    played = ["--env", "toy/line", "--agent", "evolve", "--jail", "none", *SMALL]
    arguments = {
        "try": ["try", policy, "--env", "toy/line"],
        "local": ["local", *played],
        "suite": ["suite", "t.toml", "--local"],
    }[name]
    with command(tmp_path, *arguments) as running:
        code, _, err = running.finish()
        assert running.alive() == []
    assert code == 2, err
    assert "bubblewrap" in err
    assert "--tier landlock works here" in err or "--tier none" in err
    assert "Traceback" not in err


@pytest.mark.usefixtures("without_bubblewrap")
def test_without_bubblewrap_what_needs_no_sandbox_is_played(tmp_path: Path, policy: str) -> None:
    out, _ = ended(tmp_path, "try", policy, "--env", "toy/line", "--cases", "0-1", "--tier", "none")
    assert "mean return" in out
    # The cluster's state is kept.
    assert "the next call has others" not in out


@pytest.fixture
def paused(operator_file: Path) -> Path:
    """Credentials of the cluster, whose only worker is paused."""
    status = [sys.executable, "-m", "evopolicy_gateway.cli", "status", "--json"]
    words = ("--credentials", str(operator_file))

    def workers() -> list[str]:
        output = subprocess.run([*status, *words], capture_output=True, check=True).stdout
        return [worker["worker"] for worker in json.loads(output)["workers"]]

    wait_until(workers)
    (name,) = workers()
    subprocess.run(
        [sys.executable, "-m", "evopolicy_gateway.cli", "workers", "pause", name, *words], check=True
    )
    return operator_file


def resume(operator_file: Path, cwd: Path) -> None:
    words = ("--credentials", str(operator_file))
    with command(cwd, "status", "--json", *words) as asked:
        (worker,) = json.loads(asked.finish()[1])["workers"]
    ended(cwd, "workers", "resume", worker["worker"], *words)


def test_a_run_whose_workers_are_paused_says_so_and_so_does_status(paused: Path, tmp_path: Path) -> None:
    with command(tmp_path, *run_arguments(paused, agent(tmp_path, "submit([0])"))) as running:
        wait_until(lambda: WORKER_IS_PAUSED in running.text, lambda: running.text)
        with command(tmp_path, "status", "--credentials", str(paused)) as asked:
            assert "those that do are paused" in asked.finish()[1]
        resume(paused, tmp_path)
        code, _, err = running.finish()
    assert code == 0, err
    assert record_in(run_dir(tmp_path)).outcome.status == "completed"


@pytest.mark.parametrize("name", ["status", "run", "try"])
def test_a_command_without_coordinator_says_what_it_awaits(tmp_path: Path, policy: str, name: str) -> None:
    arguments = {
        "status": ["status", "--json"],
        "run": ["run", "--env", "toy/line", "--agent", "random"],
        "try": ["try", policy, "--env", "toy/line"],
    }[name]
    for role in ("operator", "gateway"):
        found = Credentials(
            cluster="c", role=role, endpoints=("tcp/127.0.0.1:9",), user=role, password="p", token="t"
        )
        credentials.write(found, tmp_path / f"{role}.json")
    with command(tmp_path, *arguments, "--credentials", str(tmp_path / "operator.json")) as running:
        wait_until(lambda: "waiting for the coordinator at" in running.err, lambda: running.text)
        code, out, err = running.finish()
    assert code == 1
    assert out == ""
    assert len(err.splitlines()) == 2, err
