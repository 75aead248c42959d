"""A sweep, or a command's own runs, over runs and a cluster that do what a test says."""

from __future__ import annotations

import asyncio
import contextlib
import io
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.finished_run import finished, plan_in, record_in

from evopolicy_common.console import Terminal
from evopolicy_common.messages.operator import Claim, ClaimState
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.records.run_record import RunRecord
from evopolicy_common.records.suite_folder import Index, SweepRun
from evopolicy_common.wire.credentials import Credentials
from evopolicy_gateway.operator.cluster import ChosenCluster as LocalCluster
from evopolicy_gateway.processes.child_messages import AgentDoing
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.suite import runs, suite_index, sweep
from evopolicy_gateway.suite.claimed import ClaimedSweep
from evopolicy_gateway.suite.decisions import Facts, decide
from evopolicy_gateway.suite.suite_file import SuiteFile, expand, read_suite
from evopolicy_gateway.suite.suite_view import SuiteView

TIMEOUT_S = 30.0
NOBODY = Credentials(cluster="c", role="gateway", endpoints=("tcp/h:1",), user="u", password="p", token="t")
HEAD = 'name = "s"\nenvironments = ["toy/line"]\n'
CODEX = '[[agents]]\nname = "{}"\n[agents.config]\nharness = "codex"\n'
EVOLVE = '[[agents]]\nname = "{}"\nagent = "evolve"\n'
TOKENS = {"input_noncached": 100, "cache_read": 20, "cache_creation": 0, "output": 30}
TOKENS |= {"cost": 0.25, "requests": 7}


class Cluster:
    """The part of `Operations` that a sweep uses itself. `answer`: the reply to a claim; by default it is granted."""

    def __init__(self) -> None:
        self.reports: list[tuple[str, str, dict[str, Any] | None]] = []
        """Run's name, the cluster's id of it, and its result, as claims told them."""
        self.cancelled: list[str] = []
        self.ended: list[str] = []
        """Finished runs of which the cluster was asked to keep nothing open."""
        self.phase: str | None = "open"
        self.answer: Callable[[str], ClaimState | None] = lambda name: None

    async def claim(self, wanted: Claim) -> ClaimState:
        plain = wanted.name.partition("@")[0]
        self.reports.append((plain, wanted.run, wanted.result))
        return self.answer(plain) or ClaimState(granted=True, holder=wanted.holder, run="")

    async def cancel(self, run: str) -> None:
        self.cancelled.append(run)

    async def drop(self, folder: RunFolder) -> None:
        pass

    async def phase_of(self, folder: RunFolder) -> str | None:
        return self.phase

    async def end_lost(self, run: str) -> None:
        self.ended.append(run)


def record_of(plan: Plan) -> RunRecord:
    """Of a completed run."""
    scores: dict[str, Any] = {"final_score": 1.0, "best_submit_index": 0}
    returns: dict[str, Any] = {"heldout_returns": (1.0,), "random_heldout_returns": (0.0,)}
    done = finished(settings=plan.settings, agent={}, submits=(), wall_s={}, **scores, **returns)
    return record_in(plan, done)


def entry_of(plan: Plan, **more: Any) -> SweepRun:
    """In a sweep's index."""
    known = {"name": plan.name, "agent": plan.entry, "env": plan.settings.env, "digest": plan.digest}
    return SweepRun(**{**known, "repeat": 0, **more})


class Lifecycle:
    """In place of `RunLifecycle`: the run is open at once."""

    def __init__(
        self,
        plan: Plan,
        operations: object,
        gateway: object,
        watch: object,
        leaves: str,
        on_agent_gone: Callable[[], None],
    ) -> None:
        self.plan, self.name, self.agent_at_work = plan, plan.name, True
        self.run = f"run of {plan.name}"
        self.leaves, self.on_agent_gone = leaves, on_agent_gone


class Stage:
    """A sweep over runs that do what a test says."""

    def __init__(self, root: Path, text: str, monkeypatch: pytest.MonkeyPatch, index: Index | None = None):
        path = root / "s.toml"
        path.write_text(text)
        self.suite: SuiteFile = read_suite(str(path))
        self.root = root / "runs"
        self.runs: list[Plan] = expand(self.suite, self.root, root)
        self.index = index or Index(suite="s")
        self.cluster = Cluster()
        self.view = SuiteView([run.name for run in self.runs], 2)
        self.events: list[str] = []
        self.view.event = lambda kind, run, **more: self.events.append(f"{kind} {run} {more}")  # type: ignore[method-assign]
        self.facts: Facts | None = None
        self.begun: list[str] = []
        self.going: set[str] = set()
        self.most: set[frozenset[str]] = set()
        """Every set of runs that went on together."""
        self.attempts: dict[str, int] = {}
        self.act: Callable[[str], Awaitable[None]] = lambda name: asyncio.sleep(0.01)
        self.score: Callable[[str], Awaitable[None]] = lambda name: asyncio.sleep(0.0)
        """The work on a run once its agent is gone."""
        self.beside: Callable[[], Awaitable[None]] = lambda: asyncio.sleep(0.0)
        """Other work, beside the sweep."""
        stage = self

        class Play(Lifecycle):
            async def play_run(self, put_aside: Callable[[], None] | None = None) -> RunRecord:
                assert self.leaves == "all"
                if put_aside is not None:
                    put_aside()
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
                return record_of(self.plan)

            async def go_on(self) -> RunRecord:
                if self.name not in stage.attempts:
                    return await self.play_run()
                await stage.score(self.name)
                return record_of(self.plan)

        monkeypatch.setattr(sweep, "RunLifecycle", Play)

    def doing(self, name: str, **more: Any) -> None:
        self.view.doing(name, AgentDoing(**more))

    def play(self) -> Index:
        """Plays the sweep; the index as it is on disk afterwards."""
        played = ClaimedSweep(self.suite, self.root, self.index, self.cluster, NOBODY, self.view)
        facts = self.facts or Facts()
        known = [msgspec.structs.replace(facts, entry=self.index.runs.get(run.name)) for run in self.runs]
        decided = [decide(run, each) for run, each in zip(self.runs, known, strict=True)]

        async def main() -> None:
            async with asyncio.timeout(TIMEOUT_S):
                await asyncio.gather(played.play_runs(decided), self.beside())

        asyncio.run(main())
        return suite_index.load(self.root, "s")

    def complete(self) -> Index:
        """The same of a sweep whose runs all complete."""
        index = self.play()
        assert {entry.state for entry in index.runs.values()} == {"completed"}
        return index


Staged = Callable[..., Stage]


async def never(_: str) -> None:
    await asyncio.Event().wait()


class Direct:
    """The runs of `evopolicy local`, which do what a test says by their environments."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.act: Callable[[str], Awaitable[None]] = lambda name: asyncio.sleep(0.01)
        self.output = io.StringIO()
        self.ended: list[str] = []
        self.kinds: list[str] = []
        stage = self
        names = {"entry": "a", "model": "a", "exp_id": "t"}
        self.plans = [plan_in(root, RunSettings(env=env, **names)) for env in ("toy/line", "toy/maze")]

        class Play(Lifecycle):
            async def play_run(self, put_aside: object = None, kind: str = "play") -> RunRecord:
                assert self.leaves == "ended"
                assert put_aside is None
                stage.kinds.append(kind)
                try:
                    await stage.act(self.plan.name)
                finally:
                    stage.ended.append(self.plan.name)
                return record_of(self.plan)

            async def go_on(self) -> RunRecord:
                return await self.play_run(kind="go_on")

        @contextlib.asynccontextmanager
        async def connected(*_: object) -> AsyncIterator[tuple[object, object, None]]:
            yield None, None, None

        monkeypatch.setattr(sweep, "RunLifecycle", Play)
        monkeypatch.setattr(runs, "connected", connected)

    def play(self, parallel: int = 1) -> runs.PlayedRuns:
        async def main() -> runs.PlayedRuns:
            async with asyncio.timeout(TIMEOUT_S):
                return await runs.play_plans(
                    self.plans, LocalCluster(), parallel, Terminal(file=self.output, width=200)
                )

        return asyncio.run(main())


async def until(what: Callable[[], bool]) -> None:
    while not what():
        await asyncio.sleep(0.01)
