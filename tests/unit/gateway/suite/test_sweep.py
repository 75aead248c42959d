"""A sweep's own rules: limits, pauses, caps, and what was used; the runs of `evopolicy local` and `run`."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import pytest
from stages.sweep_stage import CODEX, EVOLVE, TIMEOUT_S, TOKENS, Direct, Stage, Staged, entry_of, until

from evopolicy_common.errors import ConfigError, EvopolicyError, StorageError
from evopolicy_common.records.suite_folder import PAUSED, Index
from evopolicy_gateway.suite import runs, suite_index, sweep


def test_limits_per_machine_agent_and_provider_hold(staged: Staged) -> None:
    limits = "[defaults]\nrepeats = 3\n[parallel]\nmachine = 4\nagent = 2\nproviders = { openai = 1 }\n"
    agents = (
        CODEX.format("a") + CODEX.format("b") + EVOLVE.format("c") + EVOLVE.format("d") + "parallel = 1\n"
    )
    stage = staged(limits + agents)
    stage.complete()
    assert len(stage.begun) == len(set(stage.begun)) == 12
    together = [sorted(name[0] for name in names) for names in stage.most]
    assert max(map(len, together)) == 4
    assert max(sum(agent in "ab" for agent in one) for one in together) == 1
    assert max(one.count("c") for one in together) == 2
    assert max(one.count("d") for one in together) == 1


def test_the_next_agent_begins_during_scoring(staged: Staged, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = staged("[defaults]\nrepeats = 3\n[parallel]\nmachine = 1\n" + EVOLVE.format("a"))
    monkeypatch.setattr(sweep, "POLL_S", TIMEOUT_S)

    async def score(name: str) -> None:
        # No run's score comes before the last agent has begun.
        await until(lambda: len(stage.begun) == 3)

    stage.score = score
    stage.complete()
    assert max(map(len, stage.most)) == 1


def test_a_paused_sweep_begins_no_further_run(staged: Staged) -> None:
    stage = staged("[defaults]\nrepeats = 2\n[parallel]\nmachine = 1\n" + EVOLVE.format("a"))
    pause = stage.root / PAUSED
    begun: list[int] = []

    async def act(name: str) -> None:
        if len(stage.begun) == 1:
            pause.touch()

    async def unpause() -> None:
        await until(lambda: any("paused" in line for line in stage.events))
        await asyncio.sleep(0.1)
        begun.append(len(stage.begun))
        pause.unlink()

    stage.act = act
    stage.beside = unpause
    stage.complete()
    assert begun == [1]
    assert len([line for line in stage.events if "paused: no further run begins" in line]) == 1


def test_runs_that_are_scored_are_bounded(staged: Staged, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = staged("[defaults]\nrepeats = 4\n[parallel]\nmachine = 1\n" + EVOLVE.format("a"))
    monkeypatch.setattr(sweep, "MAX_SCORED", 2)
    scored: set[str] = set()
    most: list[int] = []

    async def score(name: str) -> None:
        scored.add(name)
        most.append(len(scored))
        await asyncio.sleep(0.05)
        scored.discard(name)

    stage.score = score
    stage.complete()
    assert max(most) == 2


def test_unrelated_environments_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'name = "s"\nenvironments = ["toy/line", "toy/maze"]\n[parallel]\nmachine = 2\n'
    stage = Stage(tmp_path, text + EVOLVE.format("a") + EVOLVE.format("b"), monkeypatch)
    stage.act = lambda name: until(lambda: len(stage.begun) >= 2)
    stage.play()
    assert stage.begun[:2] == ["a/toy/line/0", "a/toy/maze/0"]


def test_an_unavailable_provider_holds_back_its_further_runs(staged: Staged) -> None:
    agents = CODEX.format("a") + EVOLVE.format("c") + CODEX.format("b")
    stage = staged("[parallel]\nmachine = 2\n" + agents)
    seen: list[list[str]] = []

    async def act(name: str) -> None:
        if name.startswith("a"):
            stage.doing(name, action="paused: usage limit", provider="openai", paused_s=3600.0)
            await until(lambda: "c/toy/line/0" in stage.index.runs and not stage.going - {name})
            await asyncio.sleep(0.1)
            seen.append(list(stage.begun))
            stage.doing(name, action="tries again", provider="openai")
            await until(lambda: len(stage.begun) == 3)

    stage.act = act
    index = stage.play()
    assert seen == [["a/toy/line/0", "c/toy/line/0"]]
    assert index.runs["b/toy/line/0"].state == "completed"
    assert any("paused a/toy/line/0" in line and "'seconds': 3600" in line for line in stage.events)


@pytest.mark.parametrize("cap", ["max_tokens = 149", "max_cost = 0.2", "max_requests = 7"])
def test_a_sweeps_cap_begins_no_further_run(staged: Staged, cap: str) -> None:
    agents = CODEX.format("a") + EVOLVE.format("c") + EVOLVE.format("d")
    stage = staged(f"[parallel]\nmachine = 2\n[caps]\n{cap}\n" + agents)
    ended: list[str] = []

    async def act(name: str) -> None:
        if name.startswith("a"):
            stage.doing(name, action="$ ls", tokens=TOKENS)
            try:
                await asyncio.Event().wait()
            finally:
                # Ending takes its time, and is not broken off by being asked again.
                await asyncio.sleep(0.1)
                ended.append(name)
        else:
            await until(lambda: bool(ended))

    stage.act = act
    index = stage.play()
    assert ended == ["a/toy/line/0"]
    assert stage.begun == ["a/toy/line/0", "c/toy/line/0"]
    assert (index.runs["a/toy/line/0"].state, index.runs["a/toy/line/0"].tokens) == ("running", TOKENS)
    assert index.runs["c/toy/line/0"].state == "completed"
    assert "d/toy/line/0" not in index.runs
    assert len([line for line in stage.events if "interrupted: " in line]) == 1
    assert "2 runs are left as they are" in stage.events[-1]


def test_use_of_an_earlier_attempt_counts_towards_the_cap(staged: Staged) -> None:
    stage = staged("[caps]\nmax_cost = 0.7\n" + CODEX.format("a") + CODEX.format("b"))
    a, b = stage.runs
    for run in (a, b):
        stage.index.runs[run.name] = entry_of(run, state="error", tokens=TOKENS)

    async def act(name: str) -> None:
        if name == a.name:
            stage.doing(name, tokens=TOKENS)
            assert suite_index.used(stage.index)[1] == 0.75

    stage.act = act
    index = stage.play()
    assert index.runs[a.name].earlier == TOKENS
    assert index.runs[a.name].attempt == 2
    assert suite_index.used(index)[0] >= 2 * 150


def test_a_bug_in_one_run_ends_that_run_alone(staged: Staged) -> None:
    stage = staged(CODEX.format("a") + CODEX.format("b"))

    async def stumbles(name: str) -> None:
        if name.startswith("a/"):
            raise LookupError("a bug")

    stage.act = stumbles
    index = stage.play()
    by_agent = {entry.agent: entry for entry in index.runs.values()}
    assert (by_agent["a"].state, by_agent["b"].state) == ("error", "completed")
    assert by_agent["a"].error is not None
    log = Path(by_agent["a"].error.rpartition(" ")[2])
    assert "LookupError: a bug; the traceback is in" in by_agent["a"].error
    assert "Traceback" in log.read_text()


def test_a_run_is_finished_again_after_an_error(staged: Staged, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = staged(CODEX.format("a") + CODEX.format("b"))
    monkeypatch.setattr(sweep, "FINISH_AGAIN_S", (0.0, 0.0))
    failures = {"a/toy/line/0": 2, "b/toy/line/0": 3}

    async def score(name: str) -> None:
        if failures[name]:
            failures[name] -= 1
            raise SystemError("AST constructor recursion depth mismatch")

    stage.score = score
    index = stage.play()
    assert (index.runs["a/toy/line/0"].state, index.runs["b/toy/line/0"].state) == ("completed", "error")
    assert sorted(stage.begun) == ["a/toy/line/0", "b/toy/line/0"]


def test_runs_go_on_while_the_disk_refuses_the_index(staged: Staged, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = staged(EVOLVE.format("a") + EVOLVE.format("b"))
    save = suite_index.save
    refused: list[None] = []

    def full(root: Path, index: Index) -> None:
        if len(refused) < 3:
            refused.append(None)
            raise StorageError("No space left on device")
        save(root, index)

    monkeypatch.setattr(suite_index, "save", full)
    stage.complete()
    assert len(refused) == 3
    assert len([line for line in stage.events if "suite.json is not up to date" in line]) == 1


def test_a_failing_run_stops_no_other_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = Direct(tmp_path, monkeypatch)

    async def act(name: str) -> None:
        if name == "toy/line":
            raise EvopolicyError("the gateway cannot serve")

    direct.act = act
    failed, completed = runs.documents(direct.play())
    assert (failed["status"], failed["error"]) == ("error", "the gateway cannot serve")
    assert (completed["status"], completed["final_score"]) == ("completed", 1.0)
    assert direct.output.getvalue() == "toy/line: failed: the gateway cannot serve\n"
    assert not list(tmp_path.glob("**/suite.json"))


def test_a_wrong_option_of_all_runs_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = Direct(tmp_path, monkeypatch)
    wrong = {"toy/line"}

    async def act(name: str) -> None:
        if name in wrong:
            raise ConfigError(f"{name} has too few cases")

    direct.act = act
    documents = runs.documents(direct.play())
    assert [one["wrong_option"] for one in documents] == [True, False]
    wrong.add("toy/maze")
    with pytest.raises(ConfigError, match="toy/line has too few cases"):
        direct.play()
    assert direct.output.getvalue() == ""


def test_a_commands_own_runs_continue_when_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    direct = Direct(tmp_path, monkeypatch)
    direct.plans[1] = msgspec.structs.replace(direct.plans[1], resume=True)

    async def act(name: str) -> None:
        await until(lambda: len(direct.kinds) == 2)
        if name == "toy/line":
            raise KeyboardInterrupt
        await asyncio.Event().wait()

    direct.act = act
    with pytest.raises(KeyboardInterrupt):
        direct.play(parallel=2)
    assert direct.kinds == ["play", "go_on"]
    assert direct.ended == ["toy/line", "toy/maze"]
