"""From a seed to a scenario (workers, runs, policies and faults) and its run under the checkers."""

from __future__ import annotations

import random
import zlib
from dataclasses import dataclass, replace

from sim_checkers import Checkers, ViolationError
from sim_clients import SimGateway, SimOperator
from sim_coordinator import SimCoordinator
from sim_faults import HARMLESS, LEADER_LOST, RATES, Faults, draw
from sim_oracle import PlannedRun, PlannedSubmit
from sim_store import Disk
from sim_stories import STORIES, SimEvaluator, Story
from sim_strangers import HostileOperator, HostileWorker
from sim_truth import Machine, Truth
from sim_worker import SimWorker
from sim_world import World

from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_common.messages.operator import SetWorker
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.server.reason_texts import reason_text

HORIZON_S = 1500.0
"""Simulated seconds after which an unfinished run counts as stuck."""
HIDDEN_WAIT_S = 20.0
AGENT_WAIT_S = 300.0
"""Longer than any honest agent lives; in a crowd, which has no hostile gateway, much longer."""
PERMIT_S = 400.0
"""Longest time that an agent waits for its permit without faults while no hidden episode is played, seconds."""
ENVS = ("toy/line", "toy/maze")
KINDS = ("good",) * 7 + ("raises", "raises", "none", "late")


@dataclass(frozen=True)
class Size:
    """Upper bounds of a scenario."""

    runs: int = 2
    submits: int = 3
    episodes: int = 4
    hidden: int = 2
    workers: int = 3


class Simulation:
    """The scenario of one seed."""

    def __init__(
        self, seed: int, size: Size = Size(), faults: Faults | None = None, *, trace: bool = False
    ) -> None:
        chance = random.Random(seed * 7919 + 1)
        faults = draw(chance) if faults is None else faults
        self.crowd = seed % 16 == 3
        """Six sibling runs whose agents share one machine and its single slot; every other such seed has no faults."""
        if seed % 32 == 3:
            faults = Faults()
        elif self.crowd:
            # Its hidden episodes are played late, one agent after the other.
            faults = replace(faults, worker_freeze=RATES["worker_freeze"], until_s=400.0)
        self.told = seed % 2 == 0 and seed % 32 < 16
        """Whether it plays a story; every other such seed has no faults."""
        self.story = STORIES[seed % 16 // 2] if self.told else Story(title="")
        if self.told and seed % 64 < 32:
            faults = Faults()
        if seed % 10 == 7 and not self.told and not self.crowd:
            faults = replace(faults, leader_lost=LEADER_LOST)
        self.faults = faults
        self.harmless = faults == Faults() or all(
            getattr(faults, name) == getattr(Faults(), name)
            for name in Faults.__dataclass_fields__
            if name not in HARMLESS
        )
        self.world = World(seed, faults)
        if trace:
            self.world.trace = []
        self.disk = Disk()
        self.plans = [_plan(f"r{index}", size, chance) for index in range(chance.randint(1, size.runs))]
        self.places = random.Random(seed * 6007 + 3)
        """Randomness for the placement on machines and for the machines' fate."""
        self.near = self.told or seed % 2 == 1
        """Agents are on the workers' machines, and runs may have siblings; otherwise each agent has its own machine."""
        if self.crowd:
            env = ENVS[0]
            self.plans = [
                replace(_plan(f"r{index}", size, chance), env=env, cancel_at=None) for index in range(6)
            ]
        if self.told:
            self.harmless = False
            self.plans = [
                replace(_plan(f"r{index}", size, chance), env=ENVS[0], cancel_at=None)
                for index in range(len(self.story.opened_s))
            ]
        self.hostile = seed % 8 == 1
        """A sibling of all runs has a hostile gateway, and a hostile worker joins; in some crowds, the worker alone."""
        if self.hostile:
            self.harmless = False
            cuckoo = replace(self.plans[0], name="cuckoo", submits=(), cancel_at=None, hostile=True)
            self.plans.append(cuckoo)
        if self.near and (self.crowd or self.hostile or self.told or self.places.random() < 0.7):
            self.plans = [replace(plan, kin=f"kin-{seed}") for plan in self.plans]
        self.thinks_s = 12.0 if self.crowd else self.story.thinks_s if self.told else 0.0
        """Shortest time that agents are alive between submits."""
        self.truth = Truth(self)
        self.orderly = (self.crowd or self.story.orderly) and faults == Faults()
        """Whether the rules alone decide who waits and for how long."""
        self.machines = [
            Machine(f"m{index}") for index in range(1 if self.crowd else self.places.randint(1, 3))
        ]
        if self.told:
            self.machines = [Machine(f"m{at}") for at in sorted({at for _, _, at in self.story.workers})]
        self._of_run: dict[str, tuple[Machine, bool]] = {}
        self._older = {
            plan.name
            for plan in self.plans
            if self.near and not self.crowd and not self.told and self.places.random() < 0.12
        }
        # In a crowd one slot plays six runs.
        self._horizon_s = HORIZON_S * max(
            2.0 if self.crowd or self.told else 1.0, size.episodes / Size.episodes
        )
        if self.hostile:
            self._horizon_s += AGENT_WAIT_S
        self.lengths = chance.choice((0.05, 0.4, 2.0, 4.0))
        if self.told:
            self.lengths = self.story.lengths
        self.checkers = Checkers(self)
        self.workers: dict[str, SimWorker] = {}
        self.gateways: list[SimGateway] = []
        self._out_of_service = ("draining", "paused")[seed % 2]
        self.absent = {7: "frozen", 15: "paused"}.get(seed % 16)
        """How all workers become unavailable when the runs are opened."""
        settings = CoreSettings(
            hidden_wait_s=HIDDEN_WAIT_S,
            agent_wait_s=AGENT_WAIT_S * (10.0 if self.crowd else 1.0),
        )
        self.coordinator = SimCoordinator(self.world, self.disk, self.checkers, settings)
        for index, (version, slots, at) in enumerate(self.story.workers if self.told else ()):
            name = f"w{index}"
            self.workers[name] = SimWorker(
                self,
                name,
                slots,
                ENVS,
                version,
                self.machines[at],
                tells_kernel=True,
                mute=name == self.story.mute,
            )
        for index in range(0 if self.told else 1 if self.crowd else chance.randint(1, size.workers)):
            envs = ENVS if index == 0 or chance.random() < 0.6 else ENVS[:1]
            version = "1" if index == 0 or chance.random() < 0.8 else "2"
            name = f"w{index}"
            slots = chance.randint(1, 3)
            machine = self.places.choice(self.machines) if self.near else Machine(f"m-of-{name}")
            # The first worker reports its kernel, so that one exists for hidden episodes.
            tells = not self.near or index == 0 or version != "1" or self.places.random() < 0.8
            self.workers[name] = SimWorker(
                self, name, 1 if self.crowd else slots, envs, version, machine, tells_kernel=tells
            )
        opened_s = 30.0 if self.absent else 0.0
        self.operators = [
            (HostileOperator if plan.hostile else SimOperator)(
                self,
                plan,
                self.story.opened_s[index] + 1.0
                if self.told
                else opened_s + chance.random() * 3.0 + (20.0 * index if self.crowd else 0.0),
            )
            for index, plan in enumerate(self.plans)
        ]
        if self.hostile or seed % 32 == 19:
            HostileWorker(self)
        self.evaluators = [
            SimEvaluator(self, name, self.story.evaluations)
            for name in ("e0", "e1", "e2", "e3")
            if self.story.evaluations
        ]
        self._plan_faults()
        self._plan_story()

    # ---- machines ----

    def machine_of(self, plan: PlannedRun) -> tuple[Machine, bool]:
        """The machine of a run's gateway and agent, and whether the gateway reports it."""
        if self.told:
            machine = Machine(f"m-of-{plan.name}") if self.story.remote else self.machines[0]
            return self._of_run.setdefault(plan.name, (machine, not self.story.anywhere or plan.name != "r0"))
        if plan.name not in self._of_run:
            apart = not self.near or (not self.crowd and self.places.random() < 0.25)
            machine = Machine(f"m-of-{plan.name}") if apart else self.places.choice(self.machines)
            is_known = not self.near or self.crowd or self.places.random() < 0.85
            self._of_run[plan.name] = machine, is_known
        return self._of_run[plan.name]

    def asks_permit(self, plan: PlannedRun) -> bool:
        """Whether its gateway is of a version that requests permits."""
        return plan.name not in self._older

    def _reboot(self) -> None:
        """A machine reboots: its workers, gateways and agents end."""
        machine = self.places.choice(self.machines)
        self.world.note(f"{machine.name} starts anew")
        machine.boots += 1
        for worker in self.workers.values():
            if worker.machine is machine:
                worker.crash()
        for each in self.gateways:
            if each.machine is machine:
                each.machine_starts_anew()

    def _move(self) -> None:
        """A gateway's machine is lost for good."""
        movable = [each for each in self.gateways if each.asks_permit and not each.closed]
        if movable:
            self.places.choice(movable).moves(Machine(f"another-{len(self.machines)}"))

    # ---- play time ----

    def seconds_of(self, job: Job, spec: EpisodeSpec) -> float:
        """An episode's play time: follows from its case and policy, so it is the same in every attempt."""
        part = zlib.crc32(f"{spec.case.seed} {job.bundle}".encode()) % 100 / 100.0
        hidden = 4.0 if "validation" in job.job_id else 1.0
        return self.lengths * (0.5 + part) * hidden

    # ---- scheduled faults ----

    def _plan_faults(self) -> None:
        faults, chance, world = self.faults, self.world.chance, self.world

        def times(per_minute: float) -> list[float]:
            n = int(per_minute * faults.until_s / 60.0 + chance.random())
            return [chance.random() * faults.until_s for _ in range(n)]

        for at in times(faults.worker_crash):
            world.after(at, lambda: self._some_worker().crash())
        for at in times(faults.worker_freeze):
            world.after(at, lambda: self._freeze(chance.random() * 40.0))
        for at in times(faults.partition):
            world.after(at, lambda: world.cut(self._some_endpoint(), chance.random() * 30.0))
        for at in times(faults.gateway_crash):
            world.after(at, self._crash_gateway)
        for at in times(faults.coordinator_stall):
            world.after(at, lambda: self.coordinator.stall(chance.random() * 40.0))
        for at in times(faults.liveness_flap):
            world.after(at, self._flap)
        if self.near and not self.harmless and not self.orderly and not self.told:
            for fault, rate in ((self._reboot, 0.3), (self._move, 0.3)):
                if self.places.random() < rate:
                    world.after(self.places.random() * faults.until_s, fault)
        if not self.harmless and not self.orderly and not self.told and chance.random() < 0.3:
            world.after(chance.random() * faults.until_s, self._drain)
        for worker in self.workers.values():
            if self.absent == "frozen":
                world.after(2.0, lambda worker=worker: worker.freeze(45.0))  # type: ignore[misc]
            elif self.absent == "paused":
                world.after(2.0, lambda name=worker.name: self._take_out(name, "paused", 45.0))  # type: ignore[misc]

    def _plan_story(self) -> None:
        for at in self.story.reboots:
            self.world.after(at, self._reboot)
        for at in self.story.restarts:
            self.world.after(at, self.coordinator.crash, "as the story goes")
        if self.story.lost_s:
            self.world.after(14.0, self._lose_gateways)

    def _lose_gateways(self) -> None:
        for each in self.gateways:
            if not each.closed:
                each.crash(self.story.lost_s)

    def run_closed(self) -> None:
        """A run's closing was acknowledged."""
        if self.story.pauses:
            self.story = replace(self.story, pauses=False)
            self._take_out("w0", "paused", 200.0)

    def _some_worker(self) -> SimWorker:
        return self.world.chance.choice(list(self.workers.values()))

    def _some_endpoint(self) -> str:
        names = [*self.workers, *(f"gateway-{plan.name}" for plan in self.plans)]
        return self.world.chance.choice(names)

    def _freeze(self, seconds: float) -> None:
        """Freeze a worker; in a crowd for long, while it plays a hidden episode."""
        worker = self._some_worker()
        if not self.crowd:
            worker.freeze(seconds)
        elif any(kind == "hidden" for _, _, kind in self.truth.plays.values()):
            worker.freeze(50.0)

    def _crash_gateway(self) -> None:
        if self.gateways:
            self.world.chance.choice(self.gateways).crash()

    def _flap(self) -> None:
        name = self._some_worker().name
        self.coordinator.receive(name, events.LivenessLost, {"worker": name}, lambda message: None)

    def _drain(self) -> None:
        self._take_out(self._some_worker().name, self._out_of_service, 20.0)

    def _take_out(self, name: str, state: str, for_s: float) -> None:
        """An operator takes a worker out of service, and reactivates it later."""
        operator = self.operators[0]

        def drained(message: object) -> None:
            self.checkers.drained_at[name] = self.world.now
            operator.later(for_s, back)

        def back() -> None:
            self.checkers.drained_at.pop(name, None)
            operator.ask(SetWorker, {"worker": name, "state": "active"}, lambda message: None)

        operator.ask(SetWorker, {"worker": name, "state": state}, drained)

    # ---- running ----

    def run(self) -> None:
        """Play the seed to its end. Raises the errors of the checkers and the core."""
        finished = self.world.run(self.world.now + self._horizon_s, self.over)
        if not finished:
            missing = {plan.name for plan in self.plans} - self.checkers.finished_runs
            core = self.coordinator.core
            status = None if core is None else core.status(self.world.now, reason_text)
            raise ViolationError(f"runs that never finish: {sorted(missing)}; {status}")
        self.world.calm_at = self.world.now
        self.world.run(self.world.now + 20.0, lambda: False)
        self.checkers.ended(self.coordinator.core)
        for waited_s, idle_s in self.truth.waited_s:
            late = waited_s > self.story.permit_s or idle_s > PERMIT_S
            if self.faults == Faults() and not (self.hostile or self.truth.agents) and late:
                raise ViolationError(
                    f"an agent waits {waited_s:.0f} s for its permit, {idle_s:.0f} s of them while nothing is scored"
                )

    def over(self) -> bool:
        """Whether all runs have ended."""
        return len(self.checkers.finished_runs) == len(self.plans) and all(
            each.closed for each in self.gateways
        )


def _plan(name: str, size: Size, chance: random.Random) -> PlannedRun:
    submits = []
    for index in range(chance.randint(1, size.submits)):
        ids = tuple(chance.randrange(4) for _ in range(chance.randint(1, size.episodes)))
        submits.append(PlannedSubmit(ids, f"{chance.choice(KINDS)}-{name}-{index}"))
    total = sum(len(submit.ids) for submit in submits)
    return PlannedRun(
        name=name,
        env=chance.choice(ENVS),
        budget=max(1, total - chance.choice((0, 0, 0, 1))),
        n_validation=chance.randint(1, size.hidden),
        n_heldout=chance.randint(1, size.hidden),
        scope=chance.choice(("episode", "episode", "submit")),
        submits=tuple(submits),
        cancel_at=chance.random() * 60.0 if chance.random() < 0.08 else None,
    )
