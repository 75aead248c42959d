"""The agent: evaluates populations, then finals, and learns from the feedback."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from evopolicy_gateway.agents.client import Client, ProtocolError, Refusal, Verdict
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
        self._bounds = int(info["min_episodes_per_submit"]), int(info["max_episodes_per_submit"])
        self._search = Search(families_for(*spaces), np.random.default_rng(seed))
        self._next_case = 0
        self._lessons = Lessons(*spaces)
        self._n_refusals = 0

    def run(self) -> None:
        """Spends the budget. Raises ProtocolError when the gateway stays unreachable or keeps refusing."""
        self._system.mkdir(exist_ok=True)
        stage_code(self._system)
        plan = make_plan(max(self._budget, 1), *self._bounds)
        print(f"{self._env}: {self._budget} episodes, {plan}", flush=True)
        if plan.opening:
            self._play_population("opening", self._search.opening(plan.opening))
        for number, size in enumerate(plan.rounds, start=1):
            if self._budget < size + plan.episodes_per_final:
                break
            candidates = self._search.round(max(1, size // self._search.repeats))
            self._play_population(f"round {number}", candidates, n_episodes=size)
        self._play_finals(plan.finals, plan.episodes_per_final)

    def _play_finals(self, n: int, n_episodes: int) -> None:
        """Submits single candidates on the same fresh cases, until no budget is left for a submit."""
        first_case = self._next_case
        least = max(n_episodes, self._bounds[0])
        number = 0
        while self._budget >= self._bounds[0] and self._budget > 0:
            number += 1
            spend = min(least, self._budget)
            if number >= n or self._budget - spend < least:
                spend = min(self._budget, self._bounds[1])
            self._next_case = first_case
            self._play_population(f"final {number}", [self._search.finalist()], n_episodes=spend)

    def _play_population(
        self, title: str, candidates: list[Candidate], n_episodes: int | None = None
    ) -> None:
        """Submits the candidates in turns: all of them on one case, then all on the next."""
        total = max(n_episodes or len(candidates), self._bounds[0])
        total = min(total, self._bounds[1], self._budget)
        if total < self._bounds[0] or not candidates:
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
        self._budget = int(verdict.summary["remaining_budget"])
        self._learn(verdict, candidates, schedule, cases)
        self._report(title, verdict, candidates)

    def _learn(
        self, verdict: Verdict, candidates: list[Candidate], schedule: list[int], cases: list[int]
    ) -> None:
        returns = verdict.summary.get("returns")
        if verdict.status != "ok" or not returns:
            return
        failed = set(verdict.summary.get("errors") or ()) | set(verdict.summary.get("timeouts") or ())
        episodes = self._trajectories(verdict, len(schedule)) if len(candidates) > 1 else []
        for index, (turn, case, value) in enumerate(zip(schedule, cases, returns, strict=True)):
            if index not in failed and value is not None and np.isfinite(value):
                new = novelty(episodes[index]) if episodes else 0
                candidates[turn].episodes.append(Episode(case=case, episode_return=float(value), novelty=new))
        for family in self._lessons.learn(episodes):
            self._search.add_family(family)

    def _trajectories(self, verdict: Verdict, n_episodes: int) -> list[list[Step]]:
        """Trajectories of a population's episodes, if they can teach anything; else none."""
        returns = verdict.summary["returns"]
        if len(set(returns)) > len(returns) // 2 and not self._lessons.wanted:
            return []
        first = int(verdict.summary["first_global_episode"])
        return read_episodes(self._feedback / verdict.name, range(first, first + n_episodes))

    def _report(self, title: str, verdict: Verdict, candidates: list[Candidate]) -> None:
        """Prints one line: the submit, its result, the leader, the remaining budget."""
        line = f"{verdict.name} {title}: {verdict.status}, {len(candidates)} candidates"
        returns = verdict.summary.get("returns")
        if verdict.status == "ok" and returns:
            line += f", mean {np.mean(returns):.2f}, best {np.max(returns):.2f}"
        else:
            line += f", {verdict.summary.get('n_episodes')} episodes charged for nothing"
        for leader in self._search.ranking()[:1]:
            values = [episode.episode_return for episode in leader.episodes]
            line += f"; leader {leader.family.name} {np.mean(values):.2f} over {len(values)}"
        print(f"{line}; {self._budget} episodes left", flush=True)


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
    for item in (resources.files("evopolicy_gateway.agents.evolve") / PACKAGE).iterdir():
        if item.name.endswith(".py"):
            with resources.as_file(item) as path:
                shutil.copyfile(path, target / item.name)
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


def main() -> int:
    """Runs the agent in the current folder. Returns 0 when the budget is spent, 1 when the gateway is unusable."""
    try:
        Agent(Client.from_environment(), Path.cwd()).run()
    except (KeyError, ProtocolError) as error:
        why = f"{error} is not set; it is started by a gateway" if isinstance(error, KeyError) else error
        print(f"evolve: {why}", file=sys.stderr)
        return 1
    return 0
