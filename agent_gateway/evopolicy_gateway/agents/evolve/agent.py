"""The agent: evaluates populations, then finals, and learns from the feedback."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from evopolicy_gateway.agents.client import Client, ProtocolError, Refusal, Verdict, exit_after
from evopolicy_gateway.agents.evolve.evolved.grids import find_grid
from evopolicy_gateway.agents.evolve.evolved.policy import CANDIDATES_FILE
from evopolicy_gateway.agents.evolve.evolved.spaces import Schema, goal_keys
from evopolicy_gateway.agents.evolve.families import Family, families_for, moving_families, seeking_family
from evopolicy_gateway.agents.evolve.feedback import Step, novelty, read_episodes
from evopolicy_gateway.agents.evolve.plant import find_plant
from evopolicy_gateway.agents.evolve.search import Candidate, Episode, Search, make_plan
from evopolicy_gateway.agents.evolve.views import ViewLog, find_views, view_logs

MAX_REFUSALS = 3
MAX_VIEW_LOGS = 96
PACKAGE = "evolved"


class Agent:
    """One run of the agent in one workspace."""

    def __init__(self, client: Client, workspace: Path, seed: int = 0) -> None:
        self._client = client
        self._feedback, self._system = workspace / "feedback", workspace / "system"
        info = client.info()
        meta = info["env_meta"]
        self._env = str(meta["env"])
        spaces = meta["obs_space"], meta["action_space"]
        self._n_cases = int(meta["n_env_instances"])
        self._budget = int(info["state"]["remaining_budget"])
        self._least, self._most = (int(info[f"{bound}_episodes_per_submit"]) for bound in ("min", "max"))
        self._search = Search(families_for(*spaces), np.random.default_rng(seed))
        self._next_case = 0
        self._lessons = Lessons(*spaces)
        self._n_refusals = 0

    def run(self) -> bool:
        """Spends the budget, and returns True. Raises ProtocolError when the gateway stays unreachable or keeps
        refusing."""
        self._system.mkdir(exist_ok=True)
        stage_code(self._system)
        plan = make_plan(max(self._budget, 1), self._least, self._most)
        print(f"{self._env}: {self._budget} episodes, {plan}", flush=True)
        if plan.opening:
            self._play_population("opening", self._search.opening(plan.opening))
        for number, size in enumerate(plan.rounds, start=1):
            if self._budget < size + plan.episodes_per_final:
                break
            candidates = self._search.round(max(1, size // self._search.repeats))
            self._play_population(f"round {number}", candidates, n_episodes=size)
        self._play_finals(plan.finals, plan.episodes_per_final)
        return True

    def _play_finals(self, n: int, n_episodes: int) -> None:
        """Submits single candidates on the same fresh cases, until no budget is left for a submit."""
        first_case = self._next_case
        least = max(n_episodes, self._least)
        for number in itertools.count(1):
            if self._budget < max(self._least, 1):
                return
            spend = min(least, self._budget)
            if number >= n or self._budget - spend < least:
                spend = min(self._budget, self._most)
            self._next_case = first_case
            self._play_population(f"final {number}", [self._search.finalist()], n_episodes=spend)

    def _play_population(
        self, title: str, candidates: list[Candidate], n_episodes: int | None = None
    ) -> None:
        """Submits the candidates in turns: all of them on one case, then all on the next."""
        total = min(max(n_episodes or len(candidates), self._least), self._most, self._budget)
        if total < self._least or not candidates:
            return
        schedule = [i % len(candidates) for i in range(total)]
        turns = [i // len(candidates) for i in range(total)]
        # One case for all compares them best; but where reward is rare, each case is another chance to meet it.
        spread = self._search.is_sparse and len(candidates) > 1
        offsets = range(total) if spread else turns
        cases = [(self._next_case + offset) % self._n_cases for offset in offsets]
        self._next_case += offsets[-1] + 1
        stage_candidates(self._system, candidates, schedule if len(candidates) > 1 else [0])
        verdict = self._client.submit(cases)
        if isinstance(verdict, Refusal):
            self._n_refusals += 1
            print(f"{title}: refused, {verdict.status}: {verdict.message}", flush=True)
            if self._n_refusals >= MAX_REFUSALS:
                raise ProtocolError(f"refused {self._n_refusals} times, last: {verdict.message}")
            self._budget = int(self._client.info()["state"]["remaining_budget"])
            return
        summary = verdict.summary
        self._budget = int(summary["remaining_budget"])
        returns = summary.get("returns") if verdict.status == "ok" else None
        result = f"{summary.get('n_episodes')} episodes charged for nothing"
        if returns:
            result = f"mean {np.mean(returns):.2f}, best {np.max(returns):.2f}"
            self._learn(verdict, candidates, schedule, cases)
        line = f"{verdict.name} {title}: {verdict.status}, {len(candidates)} candidates, {result}"
        for leader in self._search.ranking()[:1]:
            values = [episode.episode_return for episode in leader.episodes]
            line += f"; leader {leader.family.name} {np.mean(values):.2f} over {len(values)}"
        print(f"{line}; {self._budget} episodes left", flush=True)

    def _learn(
        self, verdict: Verdict, candidates: list[Candidate], schedule: list[int], cases: list[int]
    ) -> None:
        summary, returns = verdict.summary, verdict.summary["returns"]
        failed = set(summary.get("errors") or ()) | set(summary.get("timeouts") or ())
        # Trajectories of equal returns still tell how far each episode came.
        taught = self._lessons.wanted or len(set(returns)) <= len(returns) // 2
        episodes: list[list[Step]] = []
        if taught and len(candidates) > 1:
            first = int(summary["first_global_episode"])
            episodes = read_episodes(self._feedback / verdict.name, range(first, first + len(schedule)))
        for index, (turn, case, value) in enumerate(zip(schedule, cases, returns, strict=True)):
            if index not in failed and value is not None and np.isfinite(value):
                new = novelty(episodes[index]) if episodes else 0
                candidates[turn].episodes.append(Episode(case=case, episode_return=float(value), novelty=new))
        for family in self._lessons.learn(episodes):
            self._search.add_family(family)


class Lessons:
    """Learns from trajectories more than returns: families of controllers that need a model of the environment."""

    def __init__(self, obs_space: Schema, action_space: Schema) -> None:
        self._spaces = obs_space, action_space
        self._wants_plant = goal_keys(obs_space)
        self._wants_views = find_grid(obs_space)[0] and action_space["type"] == "Discrete"
        self._logs: list[ViewLog] = []

    @property
    def wanted(self) -> bool:
        """Whether more trajectories can teach anything."""
        return self._wants_plant or self._wants_views

    def learn(self, episodes: list[list[Step]]) -> list[Family]:
        """Families that these and the earlier trajectories make possible; a known family may have newer settings."""
        if self._wants_plant and (plant := find_plant(*self._spaces, episodes)) is not None:
            self._wants_plant = False
            return moving_families(plant, *self._spaces)
        if self._wants_views and episodes:
            self._logs = (self._logs + view_logs(*self._spaces, episodes))[-MAX_VIEW_LOGS:]
            views = find_views(*self._spaces, self._logs)
            return [] if views is None else [seeking_family(views)]
        return []


def stage_code(system: Path) -> None:
    """Copies the policy's code into `system`, and replaces its `policy.py`."""
    target = system / PACKAGE
    target.mkdir(parents=True, exist_ok=True)
    for path in (Path(__file__).parent / PACKAGE).glob("*.py"):
        shutil.copyfile(path, target / path.name)
    does = f'"""Plays the candidates listed in `{CANDIDATES_FILE}`."""'
    _replace(system / "policy.py", f"{does}\n\nfrom {PACKAGE}.policy import Policy as Policy\n")


def stage_candidates(system: Path, candidates: Sequence[Candidate], schedule: Sequence[int]) -> None:
    """Writes `candidates`, and which of them plays each episode of the next submit."""
    plan = {"candidates": [c.as_json() for c in candidates], "schedule": list(schedule)}
    _replace(system / CANDIDATES_FILE, json.dumps(plan))


def _replace(path: Path, text: str) -> None:
    """Replaces the file atomically: a snapshot may be taken at any moment."""
    temporary = path.with_name(path.name + ".new")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def main() -> NoReturn:
    """Runs the agent in the current folder."""
    exit_after("evolve", lambda client: Agent(client, Path.cwd()).run())
