"""Stories of hidden episodes and agents: one seed in four plays one of them, half of these without other faults.

In each, all runs share their hidden cases, and their agents are alive on the workers' only machine unless it says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sim_coordinator import Page
from sim_worker import Asker

from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import ResourceLimits

if TYPE_CHECKING:
    from sim_scenario import Simulation


@dataclass(frozen=True, kw_only=True)
class Story:
    """What differs from the usual scenario."""

    title: str
    opened_s: tuple[float, ...] = (0.0, 6.0, 12.0, 18.0)
    """When each run is opened."""
    thinks_s: float = 6.0
    lengths: float = 0.4
    """As `Simulation.lengths`."""
    workers: tuple[tuple[str, int, int], ...] = (("1", 2, 0),)
    """Of each worker: version, slots, number of its machine."""
    mute: str = ""
    """The worker that never polls."""
    pauses: bool = False
    """The first worker is paused for 200 s once the first run has closed: nobody else has its class."""
    anywhere: bool = False
    """The first run's gateway does not tell its agent's kernel."""
    remote: bool = False
    """Agents are alive on machines of their own."""
    lost_s: float = 0.0
    """Gateways die, and return after this time; what their agents have started lives on meanwhile."""
    reboots: tuple[float, ...] = ()
    """When the machine starts anew: gateways resume on another kernel."""
    restarts: tuple[float, ...] = ()
    """When the coordinator dies."""
    evaluations: str = ""
    """Split of the cases that operators have played, four evaluations at any time."""
    orderly: bool = False
    """No agent starts once hidden cases have waited for long."""
    permit_s: float = 1e9
    """Longest time that an agent waits for its permit without faults."""


STORIES = (
    Story(
        title="the pinned class is away",
        opened_s=(0.0, 5.0, 80.0, 90.0),
        workers=(("1", 3, 0), ("2", 1, 0)),
        pauses=True,
        permit_s=100.0,
    ),
    Story(
        title="a worker never polls",
        opened_s=tuple(15.0 * index for index in range(7)),
        thinks_s=12.0,
        workers=(("1", 2, 0), ("1", 2, 1)),
        mute="w1",
        orderly=True,
    ),
    Story(title="an agent may be anywhere", anywhere=True),
    Story(
        title="endless scoring, and submits that wait",
        opened_s=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
        thinks_s=0.5,
        lengths=2.0,
        workers=(("1", 1, 0),),
        remote=True,
        evaluations="heldout",
    ),
    Story(title="children outlive their gateway", lost_s=100.0),
    Story(title="runs resume on another kernel during scoring", reboots=(25.0, 60.0), thinks_s=3.0),
    Story(
        title="restarts while a submit and hidden cases wait",
        opened_s=(0.0, 8.0, 16.0, 24.0, 32.0),
        lengths=2.0,
        workers=(("1", 2, 0),),
        restarts=(15.0, 30.0, 45.0),
        remote=True,
    ),
    Story(title="worlds are accepted beside agents", thinks_s=40.0, anywhere=True, evaluations="train"),
)


class SimEvaluator(Asker):
    """An operator who has cases played, again and again, until all runs are over."""

    def __init__(self, simulation: Simulation, name: str, split: str) -> None:
        super().__init__(simulation, f"operator-{name}")
        self.split, self.n, self.key = split, 0, name
        self.since = 0.0
        self.later(1.0, self._next)

    def _next(self) -> None:
        if self.simulation.over():
            return
        self.n += 1
        self.since = self.world.now
        cases = self.simulation.plans[0].cases(self.split)[:2]
        fields = {
            "evaluation": f"{self.key}-{self.n}",
            "key": f"{self.key}-{self.n}",
            "env": self.simulation.plans[0].env,
            "bundle": f"good-{self.key}-{self.n}",
            "split": self.split,
            "case_ids": tuple(range(len(cases))),
            "cases": tuple(Case(seed=seed) for seed in cases),
            "secret": self.key.encode(),
            "record": "actions",
            "sandbox_tier": "bwrap",
            "limits": ResourceLimits(),
            "related": tuple(Case(seed=seed) for seed in self.simulation.plans[0].cases("heldout")),
        }
        self.ask(operator.Evaluate, fields, lambda message: self._poll(0))

    def _poll(self, cursor: int) -> None:
        fields = {"evaluation": f"{self.key}-{self.n}", "cursor": cursor, "wait_s": 4.0}
        self.ask(operator.EvaluationPoll, fields, self._page, 4.0)

    def _page(self, message: Any) -> None:
        simulation = self.simulation
        if isinstance(message, wire.Refused):
            self.later(1.0, self._next)
        elif isinstance(message, Page) and message.done:
            simulation.checkers.evaluated(self.split, self.world.now - self.since)
            self._next()
        elif simulation.over():
            self.ask(operator.CancelRun, {"run": f"{self.key}-{self.n}"}, lambda message: None)
        else:
            self._poll(message.cursor if isinstance(message, Page) else 0)
