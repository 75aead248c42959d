"""A simulated sweep with agents on other hosts that think for minutes: its time, and that of each run's end.

    python tests/simulation/sweep.py --episode-s 2 --slots 8

Each of 4 agents plays 4 environments twice, one run after another; as in a suite, the next begins when the last one's
agent has ended. Runs of one environment share their hidden cases. Numbers of cases are the paper's.
"""

from __future__ import annotations

import argparse
import random
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parents[1] / "support"))

import sim_checkers
import sim_worker
from sim_checkers import Checkers
from sim_clients import SimOperator
from sim_coordinator import SimCoordinator
from sim_faults import Faults
from sim_oracle import PlannedRun, PlannedSubmit
from sim_scenario import Simulation
from sim_store import Disk
from sim_truth import Machine, Truth
from sim_worker import SimWorker
from sim_world import World

from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_coordinator.core.contract.settings import CoreSettings

AGENTS, ENVIRONMENTS, REPEATS = 4, 4, 2
SUBMITS, EPISODES, VALIDATION, HELDOUT = 8, 16, 16, 32
WORKERS = 4


class Sweep(Simulation):
    """All runs of the sweep on one cluster, without faults."""

    def __init__(self, think_s: float, episode_s: float, slots: int) -> None:
        self.story = SimpleNamespace(evaluations="", pauses=False)
        self.world, self.disk, self.faults = World(1, Faults()), Disk(), Faults()
        self.harmless = self.crowd = self.hostile = self.near = self.orderly = self.told = False
        self.audit_share, self.slanderer = 0.0, None
        self.thinks_s, self.episode_s = think_s, episode_s
        self.envs = tuple(f"toy/e{index}" for index in range(ENVIRONMENTS))
        self.queues = [
            [_plan(agent, env, repeat) for env in self.envs for repeat in range(REPEATS)]
            for agent in range(AGENTS)
        ]
        self.plans = [plan for queue in self.queues for plan in queue]
        self.truth, self.places = Truth(self), random.Random(1)
        self.machines: list[Machine] = []
        self.workers, self.gateways, self.operators = {}, [], []
        self._of_run, self._older = {}, set()
        self.checkers = Checkers(self)
        self.opened_at: dict[str, float] = {}
        self.closed_at: dict[str, float] = {}
        self.finished_at: dict[str, float] = {}
        self.coordinator = SimCoordinator(self.world, self.disk, self.checkers, CoreSettings())
        for index in range(WORKERS):
            name = f"w{index}"
            here = (slots // WORKERS, self.envs, "1", Machine(f"m-of-{name}"))
            self.workers[name] = SimWorker(self, name, *here, tells_kernel=True)
        for queue in self.queues:
            self._next(queue)

    def machine_of(self, plan: PlannedRun) -> tuple[Machine, bool]:
        return self._of_run.setdefault(plan.name, (Machine(f"m-of-{plan.name}"), True))

    def run_closed(self) -> None:
        pass

    def seconds_of(self, job: Job, spec: EpisodeSpec) -> float:
        return self.episode_s * (0.5 + zlib.crc32(f"{spec.case.seed} {job.bundle}".encode()) % 100 / 100.0)

    def _next(self, queue: list[PlannedRun]) -> None:
        if queue:
            plan = queue.pop(0)
            self.opened_at[plan.name] = self.world.now
            self.operators.append(SimOperator(self, plan, 1.0))
            self._look(plan, queue)

    def _look(self, plan: PlannedRun, queue: list[PlannedRun]) -> None:
        state = self.disk.states.get(plan.name)
        if state is not None and state.phase != "open" and plan.name not in self.closed_at:
            self.closed_at[plan.name] = self.world.now
            self._next(queue)
        if plan.name in self.checkers.finished_runs:
            self.finished_at[plan.name] = self.world.now
        else:
            self.world.after(5.0, self._look, plan, queue)

    def play(self) -> None:
        finished = self.world.run(self.world.now + 1e7, lambda: len(self.finished_at) == len(self.plans))
        assert finished


def _plan(agent: int, env: str, repeat: int) -> PlannedRun:
    name = f"a{agent}-{env.rpartition('/')[2]}-{repeat}"
    submits = tuple(
        PlannedSubmit(tuple(range(EPISODES)), f"good-{name}-{number}") for number in range(SUBMITS)
    )
    budget = SUBMITS * EPISODES
    return PlannedRun(name, env, budget, VALIDATION, HELDOUT, "episode", submits, kin=env)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--think-s", type=float, default=600.0)
    parser.add_argument("--episode-s", type=float, default=2.0)
    parser.add_argument("--slots", type=int, default=8)
    options = parser.parse_args()
    sim_checkers.VALIDATE_EVERY = 1 << 60
    sim_checkers.QUIET_S = 1e9
    # Fewer events: nothing fails here.
    sim_worker.BEAT_S, sim_worker.POLL_S = 6.0, 60.0
    SimWorker._look_at_silence = lambda worker: None  # type: ignore[method-assign]
    sweep = Sweep(options.think_s, options.episode_s, options.slots)
    began = sweep.world.now
    sweep.play()
    names = sweep.finished_at
    end_s = sorted(sweep.finished_at[name] - sweep.closed_at[name] for name in names)
    run_s = [sweep.finished_at[name] - sweep.opened_at[name] for name in names]
    head = f"{options.slots} slots, {options.episode_s:g} s an episode, {options.think_s:g} s a submit"
    print(
        f"{head}: sweep {max(names.values()) - began:.0f} s, a run {sum(run_s) / len(run_s):.0f} s, its end"
        f" {sum(end_s) / len(end_s):.0f} s (median {end_s[len(end_s) // 2]:.0f}, longest {end_s[-1]:.0f})"
    )


if __name__ == "__main__":
    main()
