"""The agent: evaluates populations, then finals, and learns from the feedback."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from evopolicy_gateway.agents.client import Client, ProtocolError, Refusal, Verdict
from evopolicy_gateway.agents.evolve.families import families_for
from evopolicy_gateway.agents.evolve.feedback import Step, episode_folders, novelty, read_steps
from evopolicy_gateway.agents.evolve.lessons import Lessons
from evopolicy_gateway.agents.evolve.search import Candidate, Episode, Search, make_plan
from evopolicy_gateway.agents.evolve.staging import stage_candidates, stage_code

MAX_ROWS_READ = 3000
"""Most rows that the agent reads of one trajectory."""
MAX_REFUSALS = 3


class Agent:
    """One run of the agent in one workspace."""

    def __init__(self, client: Client, workspace: Path, seed: int = 0) -> None:
        self._client = client
        self._workspace = workspace
        self._system = workspace / "system"
        info = client.info()
        meta = info["env_meta"]
        self._env = str(meta["env"])
        self._spaces: tuple[dict[str, Any], dict[str, Any]] = meta["obs_space"], meta["action_space"]
        self._n_cases = int(meta["n_env_instances"])
        self._budget = int(info["state"]["remaining_budget"])
        self._bounds = int(info["min_episodes_per_submit"]), int(info["max_episodes_per_submit"])
        self._search = Search(families_for(*self._spaces), np.random.default_rng(seed))
        self._next_case = 0
        self._lessons = Lessons(*self._spaces)
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
                new = float(novelty(episodes[index])) if index < len(episodes) else 0.0
                candidates[turn].episodes.append(Episode(case=case, episode_return=float(value), novelty=new))
        if episodes:
            for family in self._lessons.learn(episodes):
                self._search.add_family(family)

    def _trajectories(self, verdict: Verdict, n_episodes: int) -> list[list[Step]]:
        """Trajectories of a population's episodes, if they can teach anything; else none."""
        returns = verdict.summary["returns"]
        tells_apart = len(set(returns)) > len(returns) // 2
        if tells_apart and not self._lessons.wanted:
            return []
        first = int(verdict.summary["first_global_episode"])
        folders = episode_folders(self._workspace, verdict.name, n_episodes, first)
        return [read_steps(folder, MAX_ROWS_READ) for folder in folders]

    def _report(self, title: str, verdict: Verdict, candidates: list[Candidate]) -> None:
        """Prints one line: the submit, its result, the leader, the remaining budget."""
        line = f"{verdict.name} {title}: {verdict.status}, {len(candidates)} candidates"
        returns = verdict.summary.get("returns")
        if verdict.status == "ok" and returns:
            line += f", mean {np.mean(returns):.2f}, best {np.max(returns):.2f}"
        else:
            line += f", {verdict.summary.get('n_episodes')} episodes charged for nothing"
        ranked = self._search.ranking()
        if ranked:
            leader = ranked[0]
            values = [episode.episode_return for episode in leader.episodes]
            line += f"; leader {leader.family.name} {np.mean(values):.2f} over {len(values)}"
        print(f"{line}; {self._budget} episodes left", flush=True)


def main() -> int:
    """Runs the agent in the current folder. Returns 0 when the budget is spent, 1 when the gateway is unusable."""
    try:
        Agent(Client.from_environment(), Path.cwd()).run()
    except KeyError as missing:
        print(f"evolve: {missing} is not set; it is started by a gateway", file=sys.stderr)
        return 1
    except ProtocolError as error:
        print(f"evolve: {error}", file=sys.stderr)
        return 1
    return 0
