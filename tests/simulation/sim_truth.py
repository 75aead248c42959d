"""Ground truth of the kernels: machines that reboot, agents that are alive, episodes that are being played.

The coordinator learns of it from messages that are lost, late or incomplete; its view is not consulted here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sim_oracle import PlannedRun

from evopolicy_common.messages import worker as wire

if TYPE_CHECKING:
    from sim_scenario import Simulation


LONGEST_S = 30.0
"""Longest time that agents that start after a run's closing may delay it: `HIDDEN_WAIT_S` plus a margin."""


@dataclass(eq=False)
class Machine:
    """A machine; each boot is another kernel."""

    name: str
    boots: int = 1

    @property
    def boot_id(self) -> str:
        return f"{self.name}-boot-{self.boots}"


class SharedKernelError(AssertionError):
    """A hidden episode was played on a forbidden kernel, or an agent started too early."""


class Truth:
    """Live agents and playing episodes by kernel."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.agents: dict[tuple[str, str], PlannedRun] = {}
        """Live agents, by run and boot id."""
        self.plays: dict[tuple[str, str], tuple[str, PlannedRun, str]] = {}
        """By worker and lease: boot id, run, and `hidden` or `train`."""
        self.kept_since: dict[str, float] = {}
        """Closed, unfinished run to the time since when a related agent has been alive without a break."""
        self.asked_at: dict[str, tuple[float, float]] = {}
        """When a run's gateway first requested its permit, and `_scored_s` then."""
        self.waited_s: list[tuple[float, float]] = []
        """Seconds that agents waited for permits, and of them those in which no hidden episode was played."""
        self._scored_s = 0.0
        """Seconds in which hidden episodes were played, up to `_scored_at`."""
        self._scored_at = 0.0

    # ---- agents ----

    def agent_starts(self, plan: PlannedRun, boot_id: str) -> None:
        if (plan.name, boot_id) in self.agents:
            return
        world = self._simulation.world
        world.note(f"the agent of {plan.name} starts on {boot_id}")
        self._not_after_others(plan)
        self.agents[plan.name, boot_id] = plan
        self._look()
        if plan.name in self.asked_at:
            at, scored_s = self.asked_at.pop(plan.name)
            self.waited_s.append((world.now - at, world.now - at - (self._scored() - scored_s)))
        for (worker, lease), (where, run, kind) in self.plays.items():
            if where == boot_id and kind == "hidden" and plan.related(run):
                raise SharedKernelError(
                    f"the agent of {plan.name} starts on {boot_id} while {worker} plays {lease}"
                )

    def asks(self, plan: PlannedRun) -> None:
        self.asked_at.setdefault(plan.name, (self._simulation.world.now, self._scored()))

    def _scored(self) -> float:
        """Counts the time since the last call, in which the same episodes were played."""
        now = self._simulation.world.now
        if any(kind == "hidden" for _, _, kind in self.plays.values()):
            self._scored_s += now - self._scored_at
        self._scored_at = now
        return self._scored_s

    def agent_ends(self, plan: PlannedRun, boot_id: str | None = None) -> None:
        for key in [key for key in self.agents if key[0] == plan.name and boot_id in (None, key[1])]:
            self._simulation.world.note(f"the agent of {plan.name} on {key[1]} ends")
            del self.agents[key]
        self._look()

    def closed(self, plan: PlannedRun) -> None:
        """The closing of a run was acknowledged."""
        self.kept_since.setdefault(plan.name, self._simulation.world.now)
        self._look()
        self._simulation.run_closed()

    def _look(self) -> None:
        finished = self._simulation.checkers.finished_runs
        core = self._simulation.coordinator.core
        hidden = (
            {group.run for group in core.state.groups.values() if group.hidden} if core is not None else set()
        )
        for plan in self._simulation.plans:
            if plan.name not in self.kept_since:
                continue
            if plan.name in finished:
                del self.kept_since[plan.name]
            elif plan.name not in hidden or not any(agent.related(plan) for agent in self.agents.values()):
                self.kept_since[plan.name] = self._simulation.world.now

    def _not_after_others(self, plan: PlannedRun) -> None:
        """In an orderly crowd, on a single machine, no agent starts once hidden cases have waited for long."""
        self._look()
        for name, since in self.kept_since.items() if self._simulation.orderly else ():
            waited_s = self._simulation.world.now - since
            if waited_s > LONGEST_S:
                raise SharedKernelError(
                    f"the agent of {plan.name} starts; {name} has waited for {waited_s:.0f} s"
                )

    # ---- episodes ----

    def play_starts(self, worker: str, lease: wire.Lease, boot_id: str) -> None:
        name, _, rest = lease.job.job_id.partition("/")
        plans = self._simulation.plans
        plan = next((each for each in plans if each.name == name), None)
        if name == "evaluation" and self._simulation.story.evaluations == "heldout":
            plan, rest = plans[0], "heldout/"
        hidden = "/validation/" in f"/{rest}" or "/heldout/" in f"/{rest}"
        train = "/train/" in f"/{rest}"
        if plan is None or not (hidden or train):
            return
        kind = "hidden" if hidden else "train"
        self._scored()
        self.plays[worker, lease.lease_id] = boot_id, plan, kind
        for (other, at), agent in self.agents.items():
            if hidden and at == boot_id and agent.related(plan):
                raise SharedKernelError(
                    f"{worker} plays {lease.lease_id} on {boot_id}, where the agent of {other} is alive"
                )
        for (beside, each), (where, run, other_kind) in self.plays.items():
            if where == boot_id and other_kind != kind and run.related(plan):
                raise SharedKernelError(
                    f"{worker} plays {lease.lease_id} while {beside} plays {each} on {boot_id}"
                )

    def play_ends(self, worker: str, lease_id: str) -> None:
        self._scored()
        self.plays.pop((worker, lease_id), None)

    def worker_dies(self, worker: str) -> None:
        self._scored()
        for key in [key for key in self.plays if key[0] == worker]:
            del self.plays[key]
