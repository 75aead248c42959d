"""A sweep on several hosts: what it tells the cluster of its runs, and whose run each is."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from rigs.finished_run import mark_opened
from stages.sweep_stage import CODEX, EVOLVE, TOKENS, Staged, entry_of, never, until

from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.operator import ClaimState
from evopolicy_gateway.suite import claimed, sweep
from evopolicy_gateway.suite.decisions import Decision, Facts, decide


def test_an_open_run_is_announced_to_the_cluster(staged: Staged) -> None:
    stage = staged("[parallel]\nclaim_ttl_s = 3600.0\n" + EVOLVE.format("a"))
    name = stage.runs[0].name

    async def act(_: str) -> None:
        # A host that dies before it has told cannot have its run ended by those that take over.
        await until(lambda: (name, f"run of {name}", None) in stage.cluster.reports)

    stage.act = act
    index = stage.play()
    result = stage.cluster.reports[-1][2]
    assert result is not None
    assert (result["run"], result["state"]) == (f"run of {name}", "completed")
    assert index.runs[name].settings["settings"]["env"] == "toy/line"


def test_a_dead_hosts_run_is_ended_and_attempted_anew(staged: Staged) -> None:
    stage = staged(EVOLVE.format("a"))
    run = stage.runs[0]
    left = run.folder.workspace
    left.mkdir(parents=True)
    answers = [ClaimState(granted=True, holder="me", run="r-7", previous="other:1")]
    stage.cluster.answer = lambda _: answers.pop() if answers else None
    index = stage.play()
    assert stage.cluster.cancelled == ["r-7"]
    assert stage.attempts == {run.name: 2}
    assert index.runs[run.name].attempt == 2
    assert (stage.root / ".attempts" / "a" / "toy_line" / "s-0.1" / "workspace").is_dir()
    assert any("taken over from other" in line for line in stage.events)


def test_a_claim_lost_to_another_host_ends_the_run_here(staged: Staged) -> None:
    stage = staged("[parallel]\nclaim_ttl_s = 1.0\n" + EVOLVE.format("a"))
    run = stage.runs[0]
    theirs = entry_of(run, state="completed", directory="a/toy_line/s-0", host="other", score=3.0)
    asked: list[str] = []

    def answer(name: str) -> ClaimState | None:
        asked.append(name)
        if len(asked) == 1:
            return None
        result = msgspec.to_builtins(theirs) if len(asked) >= 6 else None
        return ClaimState(granted=False, holder="other:1", run="r-8", result=result)

    stage.cluster.answer, stage.act = answer, never
    index = stage.play()
    assert stage.begun == [run.name]
    entry = index.runs[run.name]
    assert (entry.state, entry.score, entry.host, entry.directory) == ("completed", 3.0, "other", "")
    # Started again, with the folder of the run that was ended here still open: nothing is left to do.
    facts = Facts(entry=entry, opened=True, phase="finished")
    assert decide(run, facts) == Decision(run=run, kind="keep", attempt=1)


def test_a_finished_run_that_another_host_took_meanwhile_is_not_written_here(
    staged: Staged, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = staged("[parallel]\nclaim_ttl_s = 3600.0\n" + EVOLVE.format("a"))
    monkeypatch.setattr(sweep, "FINISH_AGAIN_S", (0.01, 0.01))
    run = stage.runs[0]
    theirs = entry_of(run, state="completed", directory="", host="other", score=3.0)
    written: list[str] = []

    async def refused(name: str) -> None:
        written.append(name)
        stage.cluster.answer = lambda _: ClaimState(granted=False, holder="other:1", run="r-8")
        raise OSError(28, "No space left on device")

    stage.score = refused

    async def answers() -> None:
        await until(lambda: any("not written here" in line for line in stage.events))
        result = msgspec.to_builtins(theirs)
        stage.cluster.answer = lambda _: ClaimState(granted=False, holder="other:1", run="r-8", result=result)

    stage.beside = answers
    index = stage.play()
    assert written == [run.name]
    entry = index.runs[run.name]
    assert (entry.state, entry.score, entry.host) == ("completed", 3.0, "other")


@pytest.mark.parametrize("ours", [False, True])
def test_a_claim_that_was_given_back_ends_the_earlier_hosts_run(staged: Staged, ours: bool) -> None:
    stage = staged(EVOLVE.format("a"))
    if ours:
        folder = stage.runs[0].folder
        folder.state.mkdir(parents=True)
        mark_opened(folder, "r-7")
    stage.cluster.answer = lambda _: ClaimState(granted=True, holder="me", run="r-7")
    stage.play()
    assert stage.cluster.cancelled == ([] if ours else ["r-7"])


def test_our_own_failure_gives_the_claim_back_and_is_reported(staged: Staged) -> None:
    stage = staged(CODEX.format("a"))

    async def fails(name: str) -> None:
        stage.doing(name, tokens=TOKENS)
        raise EvopolicyError("the gateway cannot serve")

    stage.act = fails
    index = stage.play()
    (entry,) = index.runs.values()
    assert (entry.state, entry.error, entry.tokens) == ("error", "the gateway cannot serve", TOKENS)
    assert stage.cluster.reports[-1][2] is None


def test_a_sweep_that_renews_no_claims_ends_with_the_reason(staged: Staged) -> None:
    stage = staged(CODEX.format("a"))
    asked: list[str] = []

    def answer(name: str) -> ClaimState | None:
        asked.append(name)
        if len(asked) > 1:
            raise LookupError("a bug")
        return None

    stage.cluster.answer, stage.act = answer, never
    with pytest.raises(LookupError, match="a bug"):
        stage.play()
    assert not stage.going


def test_an_open_run_that_the_cluster_cannot_open_again_is_attempted_anew(staged: Staged) -> None:
    for phase, attempt in (("open", 1), (None, 2)):
        stage = staged(EVOLVE.format("a"))
        run = stage.runs[0]
        run.folder.state.mkdir(parents=True, exist_ok=True)
        mark_opened(run.folder, "r-7")
        stage.cluster.phase = phase
        stage.facts = Facts(opened=True, phase=None, closing=True)
        stage.play()
        assert stage.attempts == {run.name: attempt}


def test_a_claim_that_this_host_kept_is_no_reason_to_begin_anew(staged: Staged) -> None:
    stage = staged(EVOLVE.format("a"))
    run = stage.runs[0]
    run.folder.state.mkdir(parents=True)
    mark_opened(run.folder, "r-8")
    # As of a backup from before the run's second attempt.
    stage.cluster.answer = lambda _: ClaimState(granted=True, holder="me", run="r-7", kept=True)
    stage.facts = Facts(opened=True, phase="open", closing=True)
    stage.play()
    assert stage.cluster.cancelled == ["r-7"]
    assert stage.attempts == {run.name: 1}


def test_results_are_told_again_to_another_coordinator_process(staged: Staged) -> None:
    stage = staged("[parallel]\nmachine = 1\n" + EVOLVE.format("a") + EVOLVE.format("b"))
    first, second = (run.name for run in stage.runs)
    process = ["one"]
    stage.cluster.answer = lambda _: ClaimState(
        granted=True, holder="me", run="", coordinator=process[0], kept=True
    )

    async def act(name: str) -> None:
        if name == second:
            told = len([one for one in stage.cluster.reports if one[0] == first and one[2]])
            process[0] = "two"
            await until(lambda: len([o for o in stage.cluster.reports if o[0] == first and o[2]]) > told)

    stage.act = act
    index = stage.play()
    assert stage.cluster.ended == [index.runs[first].run]


def test_folders_of_one_path_on_machines_of_one_name_are_two_hosts(tmp_path: Path) -> None:
    names = []
    for machine in ("one", "other"):
        root = tmp_path / machine
        names.append(claimed._id_of(root))
        assert claimed._id_of(root) == names[-1]
    assert len(set(names)) == 2
