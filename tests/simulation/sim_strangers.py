"""Hostile participants: a gateway that claims any kernel for its agent, and a worker that claims any kernel, machine
and name. Both have valid credentials of their own, and lie about everything else."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any

from sim_clients import SimOperator
from sim_oracle import PlannedRun
from sim_worker import Asker, describe

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire

if TYPE_CHECKING:
    from sim_scenario import Simulation

CREDENTIALS = "stranger"
"""The machine that the worker's certificate names."""


class _Stranger(Asker):
    def __init__(self, simulation: Simulation, name: str) -> None:
        super().__init__(simulation, name)
        self.whim = random.Random(f"{simulation.world.seed} {name}")
        self.unknown = self.whim.choice(("", "made-up"))
        """What it claims instead of a kernel, at times."""

    def claimed(self) -> tuple[str, str]:
        """Boot id and host name: a machine's present or former kernel, one that does not exist, or an unknown one."""
        machine = self.whim.choice(self.simulation.machines)
        made_up = f"made-up-{self.whim.randrange(4)}"
        boot_id = self.whim.choice(
            (machine.boot_id, f"{machine.name}-boot-1", made_up, made_up, self.unknown)
        )
        return boot_id, machine.name


class HostileGateway(_Stranger):
    """Requests permits for kernels of others and for all kernels, and closes its run late or never."""

    def __init__(self, simulation: Simulation, plan: PlannedRun) -> None:
        super().__init__(simulation, f"gateway-{plan.name}")
        self.run = plan.name
        if self.whim.random() < 0.5:
            close = {"run": self.run, "reason": "done"}
            self.later(
                self.whim.uniform(20.0, 200.0), self.ask, gateway.CloseRun, close, lambda message: None
            )
        self._lie()

    def _lie(self) -> None:
        if self.run in self.simulation.checkers.finished_runs:
            return
        self.later(self.whim.uniform(0.5, 12.0), self._lie)
        if self.whim.random() < 0.1 and not self.unknown:
            self._send(gateway.OpenRun, {"run": self.run, "asks_permit": False})
        else:
            boot_id, host = self.claimed()
            wait_s = self.whim.choice((0.0, 5.0))
            fields = {"run": self.run, "boot_id": boot_id, "host": host, "wait_s": wait_s}
            self._send(gateway.RequestPermit, fields)

    def _send(self, kind: type[wire.Message], fields: dict[str, Any]) -> None:
        receive = self.simulation.coordinator.receive
        self.world.send(self.name, receive, self.name, kind, fields, lambda message: None)


class HostileOperator(SimOperator):
    """Creates the run of the hostile gateway, and cancels it once nobody can wait for it any more."""

    def start_gateway(self) -> None:
        HostileGateway(self.simulation, self.plan)
        self._look()

    def _look(self) -> None:
        others = {plan.name for plan in self.simulation.plans if not plan.hostile}
        if others <= self.simulation.checkers.finished_runs:
            self.ask(operator.CancelRun, {"run": self.plan.name}, lambda message: None)
        else:
            self.later(5.0, self._look)


class HostileWorker(_Stranger):
    """Registers on kernels of others and under their names, states that it holds nothing, and plays nothing."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation, "stranger")
        self.faithful = self.whim.random() < 0.5
        """Whether it is always on the same kernel, which does not exist."""
        self.later(self.whim.random(), self._join)

    def _join(self) -> None:
        self.later(self.whim.uniform(3.0, 20.0), self._join)
        if self.simulation.over():
            return
        as_whom = self.whim.choice(("stranger", "stranger", *self.simulation.workers))
        boot_id, host = self.claimed()
        if self.faithful and as_whom == self.name:
            boot_id = "made-up-for-ever"
        fields = {
            "worker": as_whom,
            "session": f"stranger-{self.whim.randrange(1 << 30)}",
            "slots": 1,
            "machine": CREDENTIALS,
            "host": host,
            "boot_id": boot_id,
            **describe(("toy/line", "toy/maze"), "1"),
        }
        self.ask(wire.Register, fields, lambda message: self._joined(as_whom, message))

    def _joined(self, as_whom: str, message: Any) -> None:
        if isinstance(message, wire.Registered):
            # Under another's name for a short while only: as long as it is there, that worker is refused.
            until = self.world.now + (1e9 if as_whom == self.name else 6.0)
            self._beat(as_whom, message.session, until)

    def _beat(self, as_whom: str, session: str, until: float) -> None:
        if self.world.now > until or self.simulation.over():
            return

        def answered(message: Any) -> None:
            if not isinstance(message, wire.Refused):
                self.later(1.0, self._beat, as_whom, session, until)

        speaker = {"worker": as_whom, "session": session}
        self.ask(wire.Heartbeat, {**speaker, "held": (), "settled": 1 << 20}, answered)
        if as_whom == self.name and self.whim.random() < 0.1:
            self.ask(wire.LeaseRequest, {**speaker, "n": 1, "wait_s": 1.0}, lambda message: None, 1.0)
