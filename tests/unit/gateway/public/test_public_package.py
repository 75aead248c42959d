"""The public package `evopolicy`: its names, its records, and what it takes from files that agents may have written."""

from __future__ import annotations

import asyncio
import inspect
import os
import shutil
import sys
import threading
import time
import typing
from collections.abc import Callable
from pathlib import Path

import cloudpickle
import msgspec
import pytest
from program_runs import run_program, run_python

import evopolicy as evp
from evopolicy import _functions, _loop
from evopolicy_common.records.policies import bundles

GOLDEN_RUN = Path(__file__).parents[3] / "conformance" / "protocol" / "golden_run" / "run"


def test_every_public_name_is_documented_and_typed() -> None:
    for name in evp.__all__:
        one = getattr(evp, name)
        if name == "__version__":
            continue
        assert inspect.getdoc(one), name
        members = vars(one).items() if inspect.isclass(one) else [("", one)]
        for member, function in members:
            function = getattr(function, "__func__", getattr(function, "fget", function))
            if not inspect.isfunction(function) or member.startswith("_"):
                continue
            assert inspect.getdoc(function), f"{name}.{member}"
            hints = typing.get_type_hints(function)
            missing = set(inspect.signature(function).parameters) - set(hints) - {"self", "cls"}
            assert not missing, f"{name}.{member}: {missing}"
            assert "return" in hints, f"{name}.{member}"


def test_importing_it_starts_nothing() -> None:
    asked = "import evopolicy, threading; print(threading.active_count())"
    assert run_python(asked).stdout == "1\n"


def test_finished_runs_are_read_as_records(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN_RUN, tmp_path / "runs" / "a")
    runs = evp.load_runs(tmp_path / "runs")
    assert len(runs) == 1
    assert runs.left_out == ()
    (summary,) = runs.summaries()
    assert (summary.env, summary.status) == ("toy/line", "completed")
    assert [one.status for one in runs.submits()] == ["ok", "ok", "import_error", "ok"]
    assert [one.submit for one in runs.submits() if one.selected] == [summary.best_submit]
    episodes = runs.episodes()
    assert [(one.split, one.submit) for one in episodes[:2]] == [("train", 0), ("train", 0)]
    heldout = [one.episode_return for one in episodes if one.split == "heldout"]
    assert sum(heldout) / len(heldout) == pytest.approx(summary.score)
    frame = episodes.to_pandas()
    assert list(frame.columns) == list(episodes.columns)
    assert len(frame) == len(episodes)
    for shown in (runs, runs[0], episodes):
        assert "<table>" in shown._repr_html_()


def test_unreadable_runs_are_left_out_with_the_reason(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN_RUN, tmp_path / "runs" / "a")
    (tmp_path / "runs" / "b").mkdir()
    (tmp_path / "runs" / "b" / "run.json").write_text("{}")
    runs = evp.load_runs(tmp_path / "runs")
    assert len(runs) == 1
    ((folder, why),) = runs.left_out
    assert folder.name == "b"
    assert "run record" in why
    with pytest.raises(evp.ConfigError, match="no run directory"):
        evp.load_runs(tmp_path / "none")
    with pytest.raises(evp.ConfigError, match="needs a folder"):
        evp.load_runs()


def test_a_text_in_a_table_is_no_markup() -> None:
    odd = msgspec.defstruct("Odd", [("text", str)])
    assert "<script>" not in evp.Records(odd, [odd("<script>alert(1)</script>")])._repr_html_()


@pytest.fixture
def run(tmp_path: Path) -> evp.Run:
    shutil.copytree(GOLDEN_RUN, tmp_path / "run")
    (run,) = evp.load_runs(tmp_path / "run")
    return typing.cast(evp.Run, run)


def test_a_functions_value_is_read_as_json_and_nothing_else(run: evp.Run, tmp_path: Path) -> None:
    file = run.folder / "workspace" / "result.json"
    assert run.value is None
    file.write_text('{"gain": [1, 2.5, null]}')
    assert run.value == {"gain": [1, 2.5, None]}

    class Bomb:
        def __reduce__(self) -> tuple[object, ...]:
            return os.mkdir, (str(tmp_path / "unpickled"),)

    for content in (cloudpickle.dumps(Bomb()), b"[" * 100_000, b"\xff", b'"' + b"x" * (1 << 20) + b'"'):
        file.write_bytes(content)
        with pytest.raises(evp.ConfigError, match=r"result\.json"):
            _ = run.value
    assert not (tmp_path / "unpickled").exists()


@pytest.mark.parametrize(
    "make", [os.mkfifo, os.mkdir, lambda file: file.symlink_to(file.parents[1] / "run.json")]
)
@pytest.mark.timeout(60)
def test_a_functions_value_is_read_from_a_regular_file_only(
    run: evp.Run, make: Callable[[Path], None]
) -> None:
    make(run.folder / "workspace" / "result.json")
    with pytest.raises(evp.ConfigError, match="no regular file"):
        _ = run.value


def helper() -> int:
    return 41


def test_a_functions_own_module_goes_with_it_to_the_jail(tmp_path: Path) -> None:
    def agent(workspace: evp.Workspace) -> int:
        return helper() + 1

    words = _functions.agent_of(agent, tmp_path / "function.pickle")
    assert words.endswith(str(tmp_path / "function.pickle"))
    # Where the module of this test cannot be imported; the type that is only named must not be needed.
    asked = "import cloudpickle, pathlib, sys; print(cloudpickle.loads(pathlib.Path(sys.argv[1]).read_bytes())(None))"
    done = run_python(asked, tmp_path / "function.pickle", cwd=tmp_path)
    assert done.stdout == "42\n", done.stderr


@pytest.mark.parametrize("version", [sys.version_info[:2], (2, 7)])
def test_a_function_is_a_policy_where_only_the_standard_library_is(
    version: tuple[int, int], tmp_path: Path
) -> None:
    gain = 2
    made = _functions.policy_of(lambda observation: gain * observation + helper())
    bundles.unpack(made, tmp_path / "policy")
    code = tmp_path / "policy" / "policy.py"
    code.write_text(code.read_text().replace(str(sys.version_info[:2]), str(version)))
    asked = f"import sys; sys.path.append({str(code.parent)!r}); import policy; print(policy.Policy(0, 0, 0).act(3))"
    done = run_program(sys.executable, "-ISc", asked)
    assert done.stdout == ("47\n" if version == sys.version_info[:2] else ""), done.stderr
    assert ("evaluate a folder with a policy.py" in done.stderr) == (version == (2, 7))


def test_a_function_that_cannot_be_sent_is_reported(tmp_path: Path) -> None:
    lock = threading.Lock()

    def agent(workspace: evp.Workspace) -> None:
        lock.acquire()

    with pytest.raises(evp.ConfigError, match="agent agent cannot be sent to its jail"):
        _functions.agent_of(agent, tmp_path / "function.pickle")
    with pytest.raises(evp.ConfigError, match="policy agent cannot be sent to the sandbox"):
        _functions.policy_of(agent)
    weights = os.urandom(bundles.MAX_BYTES)
    with pytest.raises(evp.ConfigError, match="with the values that it uses: bundle holds"):
        _functions.policy_of(lambda observation: weights[0])


def test_wrong_arguments_are_reported_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(evp.ConfigError, match="slots is 0"):
        evp.Cluster.local(slots=0)
    with pytest.raises(evp.ConfigError, match="give only one"):
        evp.Cluster.local(fresh=True, state=tmp_path)
    policy = Path(__file__).parents[4] / "examples/policies/gym_acrobot"
    with pytest.raises(evp.ConfigError, match="not open"):
        evp.Cluster.local().evaluate(policy, env="gym/acrobot")


def test_ctrl_c_waits_until_everything_is_in_order() -> None:
    program = """
import asyncio, os, signal, threading
from evopolicy._loop import call

async def work():
    try:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
        await asyncio.sleep(60)
    finally:
        await asyncio.sleep(0.2)
        print("in order", flush=True)

try:
    call(work())
except KeyboardInterrupt:
    print("interrupted")
"""
    done = run_python(program)
    assert done.stdout == "in order\ninterrupted\n", done.stderr


async def test_a_cancelled_await_cancels_the_work_and_waits_for_it() -> None:
    ended: list[float] = []

    async def work() -> None:
        try:
            await asyncio.sleep(60)
        finally:
            await asyncio.sleep(0.1)
            ended.append(time.monotonic())

    task = asyncio.create_task(_loop.awaited(work()))
    await asyncio.sleep(0.1)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended
