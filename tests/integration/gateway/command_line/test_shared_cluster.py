"""Local commands beside each other: they share the cluster of their state folder, and it outlives each of them."""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import MARK, SMALL, STILL, Command, agent, command, ended, record_in, run_dir
from waiting import wait_until

from evopolicy_common.records.open_run import is_held
from evopolicy_coordinator.storage.store import Store

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(900)]

TRY = ("try", STILL, "--env", "toy/line", "--cases", "0-1")
WAITS = """
submit([0])
open("here", "w").close()
while not os.path.exists("go"):
    time.sleep(0.05)
submit([1])
"""


def state(cwd: Path) -> Path:
    return cwd / "xdg" / "evopolicy" / "local"


def local(cwd: Path, exp_id: str, code: str = WAITS) -> list[str]:
    program = agent(cwd, code)
    return ["local", "--env", "toy/line", "--agent", program, "--entry", "e", "--exp-id", exp_id, *SMALL]


@contextlib.contextmanager
def playing(cwd: Path, exp_id: str, *more: str) -> Iterator[Command]:
    """A run whose agent has made a submit, and waits for `go`."""
    with command(cwd, *local(cwd, exp_id), *more) as running:
        here = f"*/*/{exp_id}/workspace/here"
        wait_until(lambda: [*(cwd / "runs").glob(here)], lambda: running.text)
        yield running


def go(cwd: Path, exp_id: str) -> None:
    (found,) = (cwd / "runs").glob(f"*/*/{exp_id}/workspace")
    (found / "go").touch()


def finished(running: Command) -> None:
    code, out, err = running.finish()
    assert code == 0, out + err


def status(cwd: Path) -> dict[str, Any]:
    """What `evopolicy status` finds without credentials."""
    found: dict[str, Any] = json.loads(ended(cwd, "status", "--json")[0])
    return found


def known_workers(cwd: Path) -> set[str]:
    """Workers that the next coordinator expects to play still, until it hears of them."""
    store = Store(state(cwd) / "coordinator.sqlite")
    try:
        return {row.worker for row in store.load().kernels}
    finally:
        store.close()


def test_a_command_joins_the_cluster_that_runs_and_status_finds_it(tmp_path: Path) -> None:
    (tmp_path / "cases").mkdir()
    with playing(tmp_path, "a") as first:
        (run,) = status(tmp_path)["runs"]
        assert run["env"] == "toy/line"
        _, err = ended(tmp_path, *TRY)
        assert "both share it and the slots of both" in err
        for more, said in (
            (("--tier", "none"), "--jail or --tier: not given there, none here"),
            (("--data", "cases"), f"--data: not given there, {tmp_path}/cases here"),
            (("--set", "env_timeout=5"), "env_timeout: not given there, 5.0 here"),
        ):
            _, err = ended(tmp_path, *TRY, *more, ends=2)
            assert said in err
            assert "choose another folder with --state" in err
            assert "another state has other hidden cases" in err
        strict = ["local", "--env", "toy/line", "--agent", "random", "--hidden-isolation", "strict"]
        assert "--hidden-isolation: related there, strict here" in ended(tmp_path, *strict, ends=2)[1]
        assert "the next call has others" in ended(tmp_path, *TRY, "--fresh")[0]
        go(tmp_path, "a")
        finished(first)
    assert "no operator credentials" in ended(tmp_path, "status", ends=2)[1]


def test_the_second_command_goes_on_when_the_first_is_killed(tmp_path: Path) -> None:
    with playing(tmp_path, "a") as first, playing(tmp_path, "b") as second:
        first.kill()
        go(tmp_path, "b")
        # The killed run's agent has ended, and bars the second run's hidden cases no longer.
        finished(second)
    assert record_in(run_dir(tmp_path, exp_id="b")).outcome.budget_used == 2
    go(tmp_path, "a")
    ended(tmp_path, *local(tmp_path, "a"), "--resume")
    assert record_in(run_dir(tmp_path, exp_id="a")).outcome.status == "completed"


def test_two_commands_that_start_at_one_instant_share_a_cluster(tmp_path: Path) -> None:
    with command(tmp_path, *TRY, "--json") as one, command(tmp_path, *TRY, "--json") as other:
        finished(one)
        finished(other)
        (left,), (right,) = json.loads(one.out), json.loads(other.out)
    assert [each["episode_return"] for each in left["episodes"]] == [
        each["episode_return"] for each in right["episodes"]
    ]
    assert len({each["episode_return"] for each in left["episodes"]}) == 2


def test_the_cluster_ends_with_its_last_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="evo") as temporary:
        monkeypatch.setenv("TMPDIR", temporary)
        # Otherwise the first run's hidden episodes would wait for the second one's agent.
        beside = ("--hidden-isolation", "off")
        with playing(tmp_path, "a", *beside) as first, playing(tmp_path, "b", *beside) as second:
            go(tmp_path, "a")
            finished(first)
            assert first.alive() == []
            wait_until(lambda: is_held(state(tmp_path) / "lock"))
            wait_until(lambda: [each["state"] for each in status(tmp_path)["workers"]] == ["active"])
            assert {each["phase"] for each in status(tmp_path)["runs"]} == {"open"}
            second.process.send_signal(signal.SIGINT)
            assert second.wait() == 130, second.text
            assert second.alive() == []
        assert [each.name for each in Path(temporary).iterdir() if "cores" not in each.name] == []
    assert not [*state(tmp_path).glob("*.sock*"), *state(tmp_path).glob("local-*")]
    assert not [*(tmp_path / "xdg/evopolicy/clusters").iterdir()]
    assert (state(tmp_path) / "lock").read_text() == ""


STOPS_ITS_WORKER = f"""
import signal
submit([0])
mark = "{MARK}=" + os.environ["{MARK}"]
found = {{}}
for pid in filter(str.isdecimal, os.listdir("/proc")):
    try:
        words = open(f"/proc/{{pid}}/cmdline").read().split("\\0")
        own = mark in open(f"/proc/{{pid}}/environ").read().split("\\0")
    except OSError:
        continue
    for module in ("evopolicy_worker.cli", "evopolicy_gateway.cli"):
        if own and module in words and "serve" not in words:
            found[module] = int(pid)
os.kill(found["evopolicy_worker.cli"], signal.SIGSTOP)
os.kill(found["evopolicy_gateway.cli"], signal.SIGKILL)
time.sleep(1000)
"""


def test_a_worker_that_an_agent_keeps_alive_is_not_forgotten(tmp_path: Path) -> None:
    """The attack: an agent without a jail stops its command's worker and kills the command. Were the worker taken for
    ended, it could go on with a hidden episode beside an agent of the next command, which watches the kernel."""
    thief = [*local(tmp_path, "thief", STOPS_ITS_WORKER), "--jail", "none"]
    with command(tmp_path, *thief) as first:
        first.wait()
        workers = [lock.name for lock in (state(tmp_path) / "workers").iterdir()]
        assert len(workers) == 1
        wait_until(lambda: not is_held(state(tmp_path) / "lock"))
        ended(tmp_path, *TRY)
        assert known_workers(tmp_path) >= set(workers)
        first.kill_all()
    ended(tmp_path, *TRY)
    assert not known_workers(tmp_path) & set(workers)
