"""The processes of a local cluster start, die, refuse and stay: what the command that brought it up makes of it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.local import cluster as local_cluster
from evopolicy_common.processes.child_process import ChildProcess, last_words
from evopolicy_common.records import open_run

SOON_S = 0.2
STUBBORN = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(1000)"  # noqa: E501
SERVES = """
import json, os, sys, time
target = sys.argv[sys.argv.index("--ready-file") + 1]
ready = {"cluster": "c", "endpoints": [], "state": "s", "credentials": {"operator": "of", "worker": "wf"}}
with open(target + ".new", "w") as file:
    json.dump(ready, file)
os.rename(target + ".new", target)
time.sleep(1000)
"""
DIES_FIRST = """
import os, sys
mark = sys.argv[sys.argv.index("--state") + 1] + "/died"
if not os.path.exists(mark):
    open(mark, "w").close()
    sys.exit(1)
"""


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_cluster, "_RESTART_PAUSE_S", 0.0)
    monkeypatch.setattr(local_cluster, "END_GRACE_S", SOON_S)


def programs(monkeypatch: pytest.MonkeyPatch, coordinator: str, worker: str = STUBBORN) -> None:
    """These in place of the coordinator's and the worker's."""
    code = {"evopolicy_coordinator.cli": coordinator, "evopolicy_worker.cli": worker}
    monkeypatch.setattr(
        local_cluster, "_module", lambda name, python=sys.executable: [python, "-c", code[name]]
    )


def noted(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """The arguments of each program that a cluster of obedient programs starts, by the name of its log."""
    programs(monkeypatch, SERVES)
    started: dict[str, list[str]] = {}
    start = ChildProcess.start

    async def start_and_note(program: Sequence[str], log: Path, **more: Any) -> ChildProcess:
        started[log.stem] = list(program[3:])
        return await start(program, log, **more)

    monkeypatch.setattr(ChildProcess, "start", start_and_note)
    return started


def bring_up(state: Path) -> str:
    """The error with which a command over a cluster that cannot be kept up ends."""

    async def main() -> str:
        async with local_cluster.local_cluster("test", state=state) as cluster:
            assert cluster.operator_file == Path("of")
            await cluster.start_workers(["toy/line"], slots=1)
            await local_cluster.unless_failed(asyncio.create_task(asyncio.sleep(1000)), cluster.failed)
        return ""

    with pytest.raises(ConfigError) as raised:
        asyncio.run(main())
    assert [path.name for path in state.glob("*.json")] == []
    return str(raised.value)


def test_a_local_coordinator_that_does_not_start_is_reported_and_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs(monkeypatch, STUBBORN)
    monkeypatch.setattr(local_cluster, "START_TIMEOUT_S", SOON_S)
    started: list[ChildProcess] = []
    start = ChildProcess.start

    async def once_it_is_stubborn(program: Sequence[str], log: Path, **more: Any) -> ChildProcess:
        child = await start(program, log, talks=True, **more)
        assert child._process.stdout is not None
        await child._process.stdout.readline()
        started.append(child)
        return child

    monkeypatch.setattr(ChildProcess, "start", once_it_is_stubborn)
    assert "did not start" in bring_up(tmp_path)
    assert [child.exit_code for child in started] == [-signal.SIGKILL]


def test_a_dead_coordinator_restarts_and_refused_options_end_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuses = "import sys; print('error: --slots 1: what for?', file=sys.stderr); sys.exit(2)"
    programs(monkeypatch, DIES_FIRST + SERVES, refuses)
    assert bring_up(tmp_path) == "--slots 1: what for?"
    assert (tmp_path / "died").exists()


async def test_what_a_killed_command_left_in_the_state_folder_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "test-999999999.json").write_text("{}")
    others = tmp_path / f"test-{os.getppid()}.json"
    others.write_text("{}")
    programs(monkeypatch, SERVES)
    async with local_cluster.local_cluster("test", state=tmp_path):
        pass
    assert list(tmp_path.glob("*.json")) == [others]


async def test_a_worker_holds_its_lock_until_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs(monkeypatch, SERVES)
    workers = tmp_path / "workers"
    async with local_cluster.local_cluster("test", state=tmp_path) as cluster:
        await cluster.start_workers(["toy/line"], slots=1)
        (lock,) = workers.iterdir()
        assert lock.read_text() == str(os.getpid())
        starting: Any = cluster._start_workers
        processes, *_ = starting.args
        holders = [child for child in processes._running if lock in open_files(child.pid)]
        assert [child.log.stem for child in holders] == ["test-worker"]
        assert lock not in open_files(os.getpid())
        assert open_run.is_held(lock)
    assert list(workers.iterdir()) == [lock]
    assert not open_run.is_held(lock)


def open_files(pid: int) -> list[Path]:
    return [fd.resolve() for fd in Path(f"/proc/{pid}/fd").iterdir()]


NO_MODULE = "worker does not start: ModuleNotFoundError: No module named 'no_such_module'; see "


@pytest.mark.parametrize(
    ("worker", "starts", "why"),
    [
        ("raise SystemExit('no room')", local_cluster._MAX_DEATHS, "worker keeps ending: no room"),
        ("import no_such_module", 1, NO_MODULE),
    ],
)
def test_a_worker_that_cannot_be_kept_running_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, worker: str, starts: int, why: str
) -> None:
    mark = tmp_path / "starts"
    programs(monkeypatch, SERVES, f"open({str(mark)!r}, 'a').write('.'); {worker}")
    assert bring_up(tmp_path).startswith(why)
    assert len(mark.read_text()) == starts


async def test_a_worker_that_dies_now_and_then_is_started_again_however_often(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deaths = tmp_path / "deaths"
    programs(monkeypatch, SERVES, f"open({str(deaths)!r}, 'a').write('.'); raise SystemExit(1)")
    monkeypatch.setattr(local_cluster, "_SOON_S", 0.0)

    async with local_cluster.local_cluster("test", state=tmp_path) as cluster:
        await cluster.start_workers(["toy/line"], slots=1)
        while not deaths.exists() or len(deaths.read_text()) <= local_cluster._MAX_DEATHS + 2:
            assert not cluster.failed.done(), cluster.failed.exception()
            await asyncio.sleep(0.02)


async def started(state: Path | None, env_ids: Sequence[str], slots: int, **more: Any) -> None:
    async with local_cluster.local_cluster("test", state=state, **more) as cluster:
        await cluster.start_workers(env_ids, slots=slots)


async def test_a_local_cluster_passes_its_options_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noted_by = noted(monkeypatch)
    monkeypatch.chdir(tmp_path)
    more = {"env_timeout": 2.5, "env_memory": 512}
    given = {"data": Path("d"), "policy_packages": ["scipy"], **more}
    await started(None, ["toy/line", "toy/maze"], 5, **given)
    expected = f"--trust-workers --data {tmp_path}/d --policy-package scipy --local"
    *words, shared = noted_by["test-coordinator"]
    assert " ".join(words).endswith(expected)
    assert json.loads(shared) == {
        "--data": f"{tmp_path}/d",
        "--hidden-isolation": "related",
        "--policy-package": "scipy",
        "env_timeout": "2.5",
        "env_memory": "512",
    }
    own = " ".join(noted_by["test-worker"])
    assert "--policy-package scipy --env-timeout 2.5 --env-memory 512" in own
    assert "--env toy/line --env toy/maze --name " in own
    assert own.endswith(" --slots 5")


async def test_each_virtual_environments_worker_has_all_slots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted_by = noted(monkeypatch)
    other = tmp_path / "toys" / "bin" / "python"
    other.parent.mkdir(parents=True)
    other.symlink_to(sys.executable)
    divided = {sys.executable: ["toy/line"], str(other): ["toy/maze"]}
    monkeypatch.setattr(local_cluster.installs, "divided", lambda env_ids: divided)
    await started(tmp_path, ["toy/line", "toy/maze"], 2)
    plain, toys = noted_by["test-worker"], noted_by["test-worker-toys"]
    assert plain[-6:-3] == ["--env", "toy/line", "--name"]
    assert toys[-6:-3] == ["--env", "toy/maze", "--name"]
    assert plain[-3] != toys[-3]
    assert plain[-2:] == toys[-2:] == ["--slots", "2"]


async def test_workers_are_started_beside_the_coordinator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted_by = noted(monkeypatch)
    workers = local_cluster.Workers(["toy/line"], 2, {"bwrap"})
    async with local_cluster.local_cluster("test", state=tmp_path, workers=workers):
        pass
    coordinator, worker = noted_by["test-coordinator"], noted_by["test-worker"]
    place = coordinator[coordinator.index("--ready-file") + 1]
    assert worker[worker.index("--ready-file") + 1] == place
    assert worker[-8:-3] == ["--env", "toy/line", "--need-tier", "bwrap", "--name"]


def test_a_childs_error_is_told_although_another_process_wrote_later(tmp_path: Path) -> None:
    log = tmp_path / "coordinator.log"
    log.write_text("error: of an earlier start\n")
    start = log.stat().st_size
    with log.open("a") as out:
        out.write('error: the state folder is in use\n{"event": "stopped; everything is on disk"}\n')
    assert last_words(log, since=start) == "the state folder is in use"
    assert last_words(log) == "stopped; everything is on disk"
    log.write_text("error: of an earlier start\nKilled\n")
    assert last_words(log, since=start) == "Killed"
