"""Scale run: the core alone, from 10 to 2,000 workers, with a hundred thousand jobs; prints what a job costs it.

A job's cost is the CPU time of the core and nothing else: the workers here answer at once and the store drops its rows.
It must stay flat, and memory must not grow with finished jobs: it is measured in a second pass, after two fifths of
them (when the core's trace, of fixed size, is full) and at the end.

    python tests/simulation/scale.py [--jobs 1000000] [--workers 10,100,1000,2000] [--slots 2] [--runs N]
        [--episode-s 60] [--no-memory]

`core s/s` is the core's CPU time for a simulated second: at 1 it cannot serve more.
"""

from __future__ import annotations

import argparse
import gc
import resource
import sys
import time
import tracemalloc
from collections import deque
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parents[1] / "support"))

from rigs.asking import asked

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.status import folded
from evopolicy_common.wire import codec
from evopolicy_coordinator.core.contract.effects import Effect, ReadResults, Reply
from evopolicy_coordinator.core.contract.records import Snapshot
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.server.reason_texts import reason_text

ENVS = tuple(f"toy/env{index}" for index in range(16))
DESCRIPTIONS = tuple(
    EnvironmentDescription(
        env=env, env_version="1", obs_space={}, action_space={}, max_episode_steps=9, task_text=""
    )
    for env in ENVS
)
EPISODES = 128
"""In a submit."""
SUBMITS = 4
"""In a run; then it is validated and scored, and another run starts."""
BEAT_S = 2.0
START = 1000.0


class Load:
    """A core under load: workers poll, send heartbeats and report, and gateways submit again as soon as they may."""

    def __init__(
        self, workers: int, jobs: int, slots: int, runs: int, episode_s: float, *, memory: bool
    ) -> None:
        """`runs` at once; 0: twice as many as keep all slots busy. `episode_s`: simulated; from a second on leases are
        granted one by one, the most expensive case."""
        self.now = START
        self.core, _ = Core.load(CoreSettings(), Snapshot(incarnation=1), self.now)
        self.jobs, self.done, self.handled = jobs, 0, 0
        self.cpu_s = self.longest_s = 0.0
        self.memory: list[int] = []
        self._measure = memory
        self._requests = 0
        self._heap: list[tuple[float, int, int, wire.Lease]] = []
        self._sessions = [f"session-{index}" for index in range(workers)]
        self._names = [f"worker-{index}" for index in range(workers)]
        self._held: list[dict[str, wire.HeldLease]] = [{} for _ in range(workers)]
        self._polls: dict[int, int] = {}
        self._ready: deque[tuple[int, tuple[wire.Lease, ...]]] = deque()
        self._accepted: dict[int, int] = {}
        self._slots, self._episode_s = slots, episode_s
        self._runs = runs or max(2, min(2 * workers * slots // EPISODES + 16, jobs // EPISODES))
        self._created = 0
        self._submitted: dict[str, int] = {}
        """Number of submits so far of each open run."""
        self._seq = 0

    def tell(self, event: Any) -> None:
        began = time.process_time()
        effects = self.core.handle(event, self.now)
        took = time.process_time() - began
        self.cpu_s += took
        self.longest_s = max(self.longest_s, took)
        self.handled += 1
        self._take(effects)

    def _take(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Reply) and isinstance(effect.message, wire.Leases):
                worker = self._polls.pop(int(effect.request))
                self._ready.append((worker, effect.message.leases))
            elif isinstance(effect, ReadResults):
                self._accepted[int(effect.request)] = 1

    def _ask(self, kind: type[wire.Message], **fields: Any) -> int:
        self._requests += 1
        self.tell(asked(kind, request=self._requests, **fields))
        return self._requests

    def _ask_as(self, worker: int, kind: type[wire.Message], **fields: Any) -> None:
        self._ask(kind, worker=self._names[worker], session=self._sessions[worker], **fields)

    # ---- clients ----

    def register(self) -> float:
        """All workers join; returns the CPU time."""
        before = self.cpu_s
        fingerprint = wire.Fingerprint(code_version="1", python="3", packages={}, cpu="")
        for index, name in enumerate(self._names):
            offered = {"tiers": ("bwrap",), "environments": DESCRIPTIONS, "undescribed": ("toy/rare",)}
            itself = {
                "boot_id": f"kernel-of-{name}",
                "machine": f"machine-of-{name}",
                "fingerprint": fingerprint,
            }
            self._ask_as(index, wire.Register, slots=self._slots, **itself, **offered)
        return self.cpu_s - before

    def start(self) -> None:
        self.register()
        for _ in range(self._runs):
            self._create()
        for index in range(len(self._names)):
            self._poll(index)
        self.cpu_s, self.longest_s, self.handled = 0.0, 0.0, 0

    def _create(self) -> None:
        self._created += 1
        run = f"run-{self._created}"
        # The first runs are staggered, so that at any time about as many runs train as are scored.
        self._submitted[run] = self._created % SUBMITS if self._created <= self._runs else 0
        self._ask(
            operator.CreateRun,
            run=run,
            key=f"key-{run}",
            capability="c",
            secret=b"s" * 32,
            settings=RunSettings(env=ENVS[self._created % len(ENVS)], entry="e", model="m", exp_id="x"),
            budget=SUBMITS * EPISODES,
            min_episodes_per_submit=1,
            max_episodes_per_submit=EPISODES,
            train=tuple(Case(seed=seed) for seed in range(EPISODES)),
            validation=tuple(Case(seed=900 + seed) for seed in range(16)),
            heldout=tuple(Case(seed=950 + seed) for seed in range(32)),
            split_hashes={},
            cases_secret=True,
            policy_seeds="",
            epoch="",
            salt=b"",
            max_steps=0,
            allowed_imports=(),
            denied_imports=(),
        )
        self._ask(gateway.RequestPermit, run=run, boot_id=f"agent-of-{run}")
        self._submit(run)

    def _submit(self, run: str) -> None:
        index = self._submitted[run]
        self._submitted[run] = index + 1
        played = {"env_instances": tuple(range(EPISODES)), "bundle": f"{run}-{index}"}
        self._ask(gateway.Submit, run=run, key=f"submit-{index}", **played)

    def _poll(self, worker: int) -> None:
        self._polls[self._requests + 1] = worker
        self._ask_as(worker, wire.LeaseRequest, n=self._slots, wait_s=30.0)

    def _beat(self, worker: int) -> None:
        self._ask_as(worker, wire.Heartbeat, held=tuple(self._held[worker].values()))

    def _report_results(self, worker: int, lease: wire.Lease) -> None:
        self._held[worker].pop(lease.lease_id, None)
        ended = {
            "episode_return": 1.0,
            "length": 1,
            "terminated": True,
            "truncated": False,
            "wall_s": self._episode_s,
        }
        outcomes = tuple(EpisodeOutcome(index=spec.index, **ended) for spec in lease.job.episodes)
        named = {"lease_id": lease.lease_id, "job_id": lease.job.job_id, "attempt": lease.attempt}
        result = wire.JobResult(kind="done", episodes=outcomes, **named)
        self._ask_as(worker, wire.ReportResults, results=(result,))
        self.done += 1
        run, _, rest = lease.job.job_id.partition("/")
        group = f"{run}/{rest.rpartition('/')[0]}"
        if "/train" in group and group not in self.core.state.groups:
            self._go_on(run)
        if run in self._submitted and run not in self.core.state.runs:
            del self._submitted[run]
            self._create()

    def _go_on(self, run: str) -> None:
        """A submit has ended: send the next one, or close the run; when the run is scored, a new one starts."""
        if self._submitted[run] < SUBMITS:
            self._submit(run)
        else:
            self._ask(gateway.CloseRun, run=run, reason="budget_spent")

    def run(self) -> None:
        """Run until `jobs` jobs are done, train and hidden; each worker sends a heartbeat every `BEAT_S`
        simulated seconds, in turn."""
        workers = len(self._names)
        playing: deque[tuple[float, int, wire.Lease]] = deque()
        next_beat, beating = self.now, 0
        if self._measure:
            tracemalloc.start()
        marks = [2 * self.jobs // 5, self.jobs]
        while self.done < self.jobs:
            while self._ready:
                worker, leases = self._ready.popleft()
                for lease in leases:
                    held = wire.HeldLease(
                        lease_id=lease.lease_id, job_id=lease.job.job_id, attempt=lease.attempt, running=True
                    )
                    self._held[worker][lease.lease_id] = held
                    playing.append((self.now + self._episode_s, worker, lease))
                self._poll(worker)
            while next_beat <= self.now:
                self._beat(beating)
                beating = (beating + 1) % workers
                next_beat += BEAT_S / workers
            due = self.core.next_deadline()
            if due is not None and due <= self.now:
                began = time.process_time()
                effects = self.core.handle_deadline(self.now)
                self.cpu_s += time.process_time() - began
                self._take(effects)
            if playing and playing[0][0] <= self.now:
                _, worker, lease = playing.popleft()
                self._report_results(worker, lease)
                if self._measure and marks and self.done >= marks[0]:
                    marks.pop(0)
                    gc.collect()
                    self.memory.append(tracemalloc.get_traced_memory()[0])
            elif not self._ready:
                times = (next_beat, playing[0][0] if playing else None, self.core.next_deadline())
                self.now = max(self.now, min(at for at in times if at is not None))
        if self._measure:
            tracemalloc.stop()

    def simulated_s(self) -> float:
        return self.now - START

    def status(self) -> tuple[float, int]:
        """CPU time of an operator's status, and its size as a message."""
        began = time.process_time()
        size = len(codec.encode(folded(self.core.status(self.now, reason_text))))
        return time.process_time() - began, size


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--jobs", type=int, default=100_000, help="jobs in all (100000)")
    parser.add_argument("--workers", default="10,100,1000,2000", help="fleets to try (10,100,1000,2000)")
    parser.add_argument("--slots", type=int, default=2, help="of each worker (2)")
    parser.add_argument("--runs", type=int, default=0, help="at once (twice as many as keep all slots busy)")
    parser.add_argument("--episode-s", type=float, default=2.0, help="simulated seconds of an episode (2)")
    parser.add_argument("--no-memory", action="store_true", help="leave out the pass that traces memory")
    options = parser.parse_args()
    print(
        "workers    jobs  core µs/job  events/job  core s/s  longest event ms  status ms      KiB  all rejoin ms"
        "  memory early KiB  late KiB"
    )
    costs = []
    for workers in [int(each) for each in options.workers.split(",")]:
        # CPU time in one pass, memory in another, since tracing memory is slow.
        passes = [
            Load(workers, options.jobs, options.slots, options.runs, options.episode_s, memory=memory)
            for memory in (False, True)[: 1 if options.no_memory else 2]
        ]
        for each in passes:
            each.start()
            gc.collect()
            each.run()
        load = passes[0]
        costs.append(1e6 * load.cpu_s / load.done)
        status_s, status_bytes = load.status()
        rejoin_s = load.register()
        early, late = (size / 1024 for size in passes[-1].memory or (0, 0))
        print(
            f"{workers:7d} {load.done:7d} {costs[-1]:12.1f} {load.handled / load.done:11.2f} "
            f"{load.cpu_s / load.simulated_s():9.3f} {1e3 * load.longest_s:17.2f} "
            f"{1e3 * status_s:10.0f} {status_bytes / 1024:8.0f} "
            f"{1e3 * rejoin_s:14.0f} {early:17.0f} {late:9.0f}",
            flush=True,
        )
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak of the process, with its clients: {peak_mib:.0f} MiB")
    print(f"dearest / cheapest per job: {max(costs) / min(costs):.2f} (wanted: at most 1.5)")
    return 0 if max(costs) <= 1.5 * min(costs) else 1


if __name__ == "__main__":
    sys.exit(main())
