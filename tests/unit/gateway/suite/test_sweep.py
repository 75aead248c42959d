"""A sweep's own rules, with runs and a cluster that are played here: limits, pauses, caps, claims, what was used."""

from __future__ import annotations

import asyncio
import contextlib
import io
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from evopolicy_common.console import Terminal
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.messages.operator import ClaimState, RunFinished, RunSettings
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import PAUSED
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.operator.child_messages import AgentDoing
from evopolicy_gateway.operator.cluster import Cluster as LocalCluster
from evopolicy_gateway.run.layout import RunFolder
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.record import run_record
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.suite import claimed, runs, suite_index, sweep
from evopolicy_gateway.suite.claimed import ClaimedSweep
from evopolicy_gateway.suite.decisions import Decision, Found, decide
from evopolicy_gateway.suite.suite_file import SuiteFile, expand, read
from evopolicy_gateway.suite.suite_index import Entry, Index
from evopolicy_gateway.suite.suite_view import SuiteView

TIMEOUT_S = 30.0
HEAD = 'name = "s"\nenvironments = ["toy/line"]\n'
CODEX = '[[agents]]\nname = "{}"\n[agents.config]\nharness = "codex"\n'
EVOLVE = '[[agents]]\nname = "{}"\nagent = "evolve"\n'
TOKENS = {"input_noncached": 100, "cache_read": 20, "cache_creation": 0, "output": 30, "cost": 0.25}


class Cluster:
    """The part of `Operations` that a sweep uses itself. `answer`: what a claim is answered; granted as it stands."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str, dict[str, Any] | None]] = []
        """Run's name, the cluster's id of it, and its result, as claims told them."""
        self.cancelled: list[str] = []
        self.answer: Callable[[str], ClaimState | None] = lambda name: None

    async def claim(
        self, suite: str, name: str, holder: str, ttl_s: float, run: str, result: dict[str, Any] | None
    ) -> ClaimState:
        plain = name.partition("@")[0]
        self.told.append((plain, run, result))
        return self.answer(plain) or ClaimState(granted=True, holder=holder, run="")

    async def cancel(self, run: str) -> None:
        self.cancelled.append(run)

    async def drop(self, folder: RunFolder) -> None:
        pass


class Stage:
    """A sweep over runs that do what a test says."""

    def __init__(self, root: Path, text: str, monkeypatch: pytest.MonkeyPatch, index: Index | None = None):
        path = root / "s.toml"
        path.write_text(text)
        self.suite: SuiteFile = read(str(path))
        self.root = root / "runs"
        self.runs: list[Plan] = expand(self.suite, self.root, root)
        self.index = index or Index(suite="s")
        self.cluster = Cluster()
        self.view = SuiteView([run.name for run in self.runs], 2)
        self.said: list[str] = []
        self.view.event = lambda kind, run, **more: self.said.append(f"{kind} {run} {more}")  # type: ignore[method-assign]
        self.begun: list[str] = []
        self.going: set[str] = set()
        self.most: set[frozenset[str]] = set()
        """Every set of runs that went on together."""
        self.attempts: dict[str, int] = {}
        self.act: Callable[[str], Awaitable[None]] = lambda name: asyncio.sleep(0.01)
        self.score: Callable[[str], Awaitable[None]] = lambda name: asyncio.sleep(0.0)
        """What a run takes once its agent is gone."""
        self.beside: Callable[[], Awaitable[None]] = lambda: asyncio.sleep(0.0)
        """What happens beside the sweep."""
        stage = self

        class Play:
            """In place of `RunLifecycle`: the run is open at once, and does what the stage says."""

            def __init__(
                self,
                plan: Plan,
                operations: object,
                gateway: object,
                watch: object,
                *,
                stays_open: bool,
                on_agent_gone: Callable[[], None],
            ) -> None:
                self.on_agent_gone = on_agent_gone
                self.plan, self.name, self.agent_at_work = plan, plan.name, True
                self.run = f"run of {plan.name}"
                assert stays_open

            async def play(self) -> RunRecord:
                stage.begun.append(self.name)
                stage.going.add(self.name)
                stage.most.add(frozenset(stage.going))
                stage.attempts[self.name] = self.plan.settings.attempt
                try:
                    await stage.act(self.name)
                finally:
                    stage.going.discard(self.name)
                self.on_agent_gone()
                await stage.score(self.name)
                return run_record(self.plan, finished(self.plan), None, [], Times())

            go_on = play

        monkeypatch.setattr(sweep, "RunLifecycle", Play)

    def doing(self, name: str, **more: Any) -> None:
        self.view.doing(name, AgentDoing(**more))

    def play(self) -> Index:
        """Plays the sweep; the index as it is on disk afterwards."""
        played = ClaimedSweep(
            self.suite,
            self.root,
            self.index,
            self.cluster,  # type: ignore[arg-type]
            Credentials(
                role="gateway", endpoints=("tcp/h:1",), cluster="c", user="u", password="p", token="t"
            ),
            self.view,
        )
        decided = [decide(run, Found(entry=self.index.runs.get(run.name))) for run in self.runs]

        async def main() -> None:
            async with asyncio.timeout(TIMEOUT_S):
                await asyncio.gather(played.play(decided), self.beside())

        asyncio.run(main())
        return suite_index.load(self.root, "s")


def finished(plan: Plan) -> RunFinished:
    return RunFinished(
        run="r",
        settings=plan.settings,
        status="completed",
        error=None,
        closed_reason="budget_spent",
        agent={},
        final_score=1.0,
        best_submit_index=0,
        val_scores={0: 1.0},
        heldout_returns=(1.0,),
        validation_ineligible={},
        policy_failures={},
        random_heldout_returns=(0.0,),
        episode_budget=8,
        budget_used=8,
        split_hashes={},
        split_secret=True,
        env_version="1",
        deterministic=True,
        fingerprint=None,
        created_at=1.0,
        closed_at=2.0,
        finished_at=3.0,
        submits=(),
        wall_s={},
    )


async def until(what: Callable[[], bool]) -> None:
    while not what():
        await asyncio.sleep(0.01)


def test_limits_per_machine_agent_and_provider_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = "[defaults]\nrepeats = 3\n[parallel]\nmachine = 4\nagent = 2\nproviders = { openai = 1 }\n"
    agents = (
        CODEX.format("a") + CODEX.format("b") + EVOLVE.format("c") + EVOLVE.format("d") + "parallel = 1\n"
    )
    stage = Stage(tmp_path, HEAD + limits + agents, monkeypatch)
    index = stage.play()
    assert {entry.state for entry in index.runs.values()} == {"completed"}
    assert len(stage.begun) == len(set(stage.begun)) == 12
    together = [sorted(name[0] for name in names) for names in stage.most]
    assert max(map(len, together)) == 4
    assert max(sum(agent in "ab" for agent in one) for one in together) == 1
    assert max(one.count("c") for one in together) == 2
    assert max(one.count("d") for one in together) == 1


def test_next_agent_begins_while_the_run_before_is_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = HEAD + "[defaults]\nrepeats = 3\n[parallel]\nmachine = 1\n" + EVOLVE.format("a")
    stage = Stage(tmp_path, text, monkeypatch)
    monkeypatch.setattr(sweep, "LOOK_S", TIMEOUT_S)

    async def score(name: str) -> None:
        # No run's score comes before the last agent has begun.
        await until(lambda: len(stage.begun) == 3)

    stage.score = score
    index = stage.play()
    assert {entry.state for entry in index.runs.values()} == {"completed"}
    assert max(map(len, stage.most)) == 1


def test_a_paused_sweep_begins_no_further_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = HEAD + "[defaults]\nrepeats = 2\n[parallel]\nmachine = 1\n" + EVOLVE.format("a")
    stage = Stage(tmp_path, text, monkeypatch)
    monkeypatch.setattr(sweep, "LOOK_S", 0.01)
    pause = stage.root / PAUSED
    begun: list[int] = []

    async def act(name: str) -> None:
        if len(stage.begun) == 1:
            pause.touch()

    async def unpause() -> None:
        await until(lambda: any("paused" in said for said in stage.said))
        await asyncio.sleep(0.1)
        begun.append(len(stage.begun))
        pause.unlink()

    stage.act = act
    stage.beside = unpause
    index = stage.play()
    assert begun == [1]
    assert {entry.state for entry in index.runs.values()} == {"completed"}
    assert len([said for said in stage.said if "paused: no further run begins" in said]) == 1


def test_runs_that_are_followed_without_an_agent_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = HEAD + "[defaults]\nrepeats = 4\n[parallel]\nmachine = 1\n" + EVOLVE.format("a")
    stage = Stage(tmp_path, text, monkeypatch)
    monkeypatch.setattr(sweep, "MAX_SCORED", 2)
    scored: set[str] = set()
    most: list[int] = []

    async def score(name: str) -> None:
        scored.add(name)
        most.append(len(scored))
        await asyncio.sleep(0.05)
        scored.discard(name)

    stage.score = score
    index = stage.play()
    assert {entry.state for entry in index.runs.values()} == {"completed"}
    assert max(most) == 2


def test_unrelated_environments_are_played_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'name = "s"\nenvironments = ["toy/line", "toy/maze"]\n[parallel]\nmachine = 2\n'
    stage = Stage(tmp_path, text + EVOLVE.format("a") + EVOLVE.format("b"), monkeypatch)
    stage.act = lambda name: until(lambda: len(stage.begun) >= 2)
    stage.play()
    assert stage.begun[:2] == ["a/toy/line/0", "a/toy/maze/0"]


def test_a_provider_that_is_away_holds_back_further_runs_with_it_until_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agents = CODEX.format("a") + EVOLVE.format("c") + CODEX.format("b")
    stage = Stage(tmp_path, HEAD + "[parallel]\nmachine = 2\n" + agents, monkeypatch)
    monkeypatch.setattr(sweep, "LOOK_S", 0.01)
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
    assert any("paused a/toy/line/0" in said and "'seconds': 3600" in said for said in stage.said)


@pytest.mark.parametrize("cap", ["max_tokens = 149", "max_cost = 0.2"])
def test_a_cap_of_the_sweep_leaves_coding_agents_open_and_begins_no_further_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cap: str
) -> None:
    agents = CODEX.format("a") + EVOLVE.format("c") + EVOLVE.format("d")
    stage = Stage(tmp_path, HEAD + f"[parallel]\nmachine = 2\n[caps]\n{cap}\n" + agents, monkeypatch)
    monkeypatch.setattr(sweep, "LOOK_S", 0.01)
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
    assert len([said for said in stage.said if "interrupted: " in said]) == 1
    assert "2 runs are left as they are" in stage.said[-1]


def test_what_an_earlier_attempt_used_counts_towards_the_cap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = HEAD + "[caps]\nmax_cost = 0.7\n" + CODEX.format("a") + CODEX.format("b")
    stage = Stage(tmp_path, text, monkeypatch)
    a, b = stage.runs
    for run in (a, b):
        stage.index.runs[run.name] = Entry(
            name=run.name,
            agent=run.entry,
            env=run.settings.env,
            repeat=0,
            digest=run.digest,
            state="error",
            tokens=TOKENS,
        )

    async def act(name: str) -> None:
        if name == a.name:
            stage.doing(name, tokens=TOKENS)
            assert suite_index.used(stage.index)[1] == 0.75

    stage.act = act
    index = stage.play()
    assert index.runs[a.name].earlier == TOKENS
    assert index.runs[a.name].attempt == 2
    assert suite_index.used(index)[0] >= 2 * 150


def test_a_run_is_told_to_the_cluster_as_soon_as_it_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = HEAD + "[parallel]\nclaim_ttl_s = 3600.0\n" + EVOLVE.format("a")
    stage = Stage(tmp_path, text, monkeypatch)
    monkeypatch.setattr(sweep, "LOOK_S", 0.01)
    name = stage.runs[0].name

    async def act(_: str) -> None:
        # A host that dies before it has told cannot have its run ended by those that take over.
        await until(lambda: (name, f"run of {name}", None) in stage.cluster.told)

    stage.act = act
    index = stage.play()
    result = stage.cluster.told[-1][2]
    assert result is not None
    assert (result["run"], result["state"]) == (f"run of {name}", "completed")
    assert index.runs[name].settings["settings"]["env"] == "toy/line"


def test_a_dead_hosts_run_is_taken_over_as_a_new_attempt_and_ended_at_the_cluster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, HEAD + EVOLVE.format("a"), monkeypatch)
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
    assert any("taken over from other" in said for said in stage.said)


def test_a_claim_that_another_host_has_meanwhile_ends_the_run_here_and_its_result_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, HEAD + "[parallel]\nclaim_ttl_s = 1.0\n" + EVOLVE.format("a"), monkeypatch)
    monkeypatch.setattr(sweep, "LOOK_S", 0.01)
    monkeypatch.setattr(claimed, "_ASK_AGAIN_S", 0.01)
    run = stage.runs[0]
    theirs = Entry(
        name=run.name,
        agent="a",
        env="toy/line",
        repeat=0,
        digest=run.digest,
        state="completed",
        directory="a/toy_line/s-0",
        host="other",
        score=3.0,
    )
    asked: list[str] = []

    def answer(name: str) -> ClaimState | None:
        asked.append(name)
        if len(asked) == 1:
            return None
        if len(asked) < 6:
            return ClaimState(granted=False, holder="other:1", run="r-8")
        return ClaimState(granted=False, holder="other:1", run="r-8", result=msgspec.to_builtins(theirs))

    async def never(_: str) -> None:
        await asyncio.Event().wait()

    stage.cluster.answer, stage.act = answer, never
    index = stage.play()
    assert stage.begun == [run.name]
    entry = index.runs[run.name]
    assert (entry.state, entry.score, entry.host, entry.directory) == ("completed", 3.0, "other", "")
    # Started again, with the folder of the run that was ended here still open: nothing is left to do.
    found = Found(entry=entry, opened=True, phase="finished")
    assert decide(run, found) == Decision(run=run, kind="keep", attempt=1)


def test_our_own_failure_gives_the_claim_back_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, HEAD + CODEX.format("a"), monkeypatch)

    async def fails(name: str) -> None:
        stage.doing(name, tokens=TOKENS)
        raise EvopolicyError("the gateway cannot serve")

    stage.act = fails
    index = stage.play()
    (entry,) = index.runs.values()
    assert (entry.state, entry.error, entry.tokens) == ("error", "the gateway cannot serve", TOKENS)
    assert stage.cluster.told[-1][2] is None


def test_a_bug_in_one_run_ends_that_run_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(tmp_path, HEAD + CODEX.format("a") + CODEX.format("b"), monkeypatch)

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


def test_a_sweep_that_renews_no_claims_ends_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, HEAD + CODEX.format("a"), monkeypatch)
    asked: list[str] = []

    def answer(name: str) -> ClaimState | None:
        asked.append(name)
        if len(asked) > 1:
            raise LookupError("a bug")
        return None

    async def never(_: str) -> None:
        await asyncio.Event().wait()

    stage.cluster.answer, stage.act = answer, never
    with pytest.raises(LookupError, match="a bug"):
        stage.play()
    assert not stage.going


class Direct:
    """The runs of `evopolicy local`, which do what a test says by their environments."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.act: Callable[[str], Awaitable[None]] = lambda name: asyncio.sleep(0.01)
        self.said = io.StringIO()
        self.ended: list[str] = []
        self.kinds: list[str] = []
        stage = self
        self.plans = [
            Plan(
                name=env,
                settings=RunSettings(env=env, entry="a", model="a", exp_id="t"),
                agent="evolve",
                runs=root,
                started_in=root,
                wall_limit_s=60.0,
            )
            for env in ("toy/line", "toy/maze")
        ]

        class Play:
            """In place of `RunLifecycle`."""

            def __init__(
                self,
                plan: Plan,
                operations: object,
                gateway: object,
                watch: object,
                *,
                stays_open: bool,
                on_agent_gone: Callable[[], None],
            ) -> None:
                self.plan = plan
                assert not stays_open

            async def play(self, kind: str = "play") -> RunRecord:
                stage.kinds.append(kind)
                try:
                    await stage.act(self.plan.name)
                finally:
                    stage.ended.append(self.plan.name)
                return run_record(self.plan, finished(self.plan), None, [], Times())

            async def go_on(self) -> RunRecord:
                return await self.play("go_on")

        @contextlib.asynccontextmanager
        async def connected(*_: object) -> AsyncIterator[tuple[object, object, None]]:
            yield None, None, None

        monkeypatch.setattr(sweep, "RunLifecycle", Play)
        monkeypatch.setattr(runs, "connected", connected)

    def play(self, parallel: int = 1) -> runs.Played:
        async def main() -> runs.Played:
            async with asyncio.timeout(TIMEOUT_S):
                return await runs.play(
                    self.plans, LocalCluster(), parallel, Terminal(file=self.said, width=200)
                )

        return asyncio.run(main())


def test_of_a_commands_own_runs_one_that_fails_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    direct = Direct(tmp_path, monkeypatch)

    async def act(name: str) -> None:
        if name == "toy/line":
            raise EvopolicyError("the gateway cannot serve")

    direct.act = act
    failed, completed = runs.documents(direct.play())
    assert (failed["status"], failed["error"]) == ("error", "the gateway cannot serve")
    assert (completed["status"], completed["final_score"]) == ("completed", 1.0)
    assert direct.said.getvalue() == "toy/line: failed: the gateway cannot serve\n"
    assert not list(tmp_path.glob("**/suite.json"))


def test_a_wrong_option_of_each_run_is_the_commands_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    direct = Direct(tmp_path, monkeypatch)
    wrong = {"toy/line"}

    async def act(name: str) -> None:
        if name in wrong:
            raise ConfigError(f"{name} has too few cases")

    direct.act = act
    told = runs.documents(direct.play())
    assert [one["wrong_option"] for one in told] == [True, False]
    wrong.add("toy/maze")
    with pytest.raises(ConfigError, match="toy/line has too few cases"):
        direct.play()
    assert direct.said.getvalue() == ""


def test_a_commands_own_runs_go_on_where_they_are_resumed_and_end_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_paused_sweep_begins_nothing_and_goes_on_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Stage(tmp_path, HEAD + EVOLVE.format("a") + EVOLVE.format("b"), monkeypatch)
    stage.root.mkdir(parents=True, exist_ok=True)
    paused = stage.root / "paused"
    paused.touch()

    async def resume() -> None:
        await until(lambda: any("paused: no further run begins" in line for line in stage.said))
        assert stage.begun == []
        paused.unlink()

    stage.beside = resume
    index = stage.play()
    assert sorted(stage.begun) == sorted(index.runs)
    assert len(index.runs) == 2
    assert sum("paused" in line for line in stage.said) == 1
