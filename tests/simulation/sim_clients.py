"""Clients: an operator who creates runs and waits, and a gateway that plays its plan and may crash on the way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim_coordinator import Page
from sim_oracle import PlannedRun
from sim_worker import Asker

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.refusals import NOT_NOW, RUN_OVER

if TYPE_CHECKING:
    from sim_scenario import Simulation
    from sim_truth import Machine


class SimOperator(Asker):
    """Creates one run, waits until it is finished, and may cancel it."""

    def __init__(self, simulation: Simulation, plan: PlannedRun, start_s: float) -> None:
        super().__init__(simulation, f"operator-{plan.name}")
        self.plan = plan
        self.result: operator.RunFinished | None = None
        self.started = False
        self.later(start_s, self._create)
        if plan.cancel_at is not None:
            self.later(start_s + plan.cancel_at, self._cancel)

    def _create(self) -> None:
        plan = self.plan
        cases = {
            split: tuple(Case(seed=seed) for seed in plan.cases(split))
            for split in ("train", "validation", "heldout")
        }
        fields = {
            "run": plan.name,
            "key": f"key-{plan.name}",
            "capability": "cap",
            "secret": plan.secret,
            "settings": RunSettings(
                env=plan.env,
                entry="e",
                model="m",
                exp_id="x",
                policy_scope="submit" if plan.scope == "submit" else "episode",
            ),
            "budget": plan.budget,
            "min_episodes_per_submit": 1,
            "max_episodes_per_submit": plan.budget,
            "split_hashes": {},
            "cases_secret": True,
            "policy_seeds": "",
            "epoch": "",
            "salt": b"",
            "max_steps": 0,
            "allowed_imports": (),
            "denied_imports": (),
            **cases,
        }
        self.ask(operator.CreateRun, fields, self._created)

    def _created(self, message: Any) -> None:
        assert isinstance(message, operator.RunCreated), message
        if not self.started:
            self.started = True
            self.start_gateway()
        self._wait()

    def start_gateway(self) -> None:
        self.simulation.gateways.append(SimGateway(self.simulation, self.plan))

    def _wait(self) -> None:
        self.ask(operator.WaitRun, {"run": self.plan.name, "wait_s": 10.0}, self._waited, 10.0)

    def _waited(self, message: Any) -> None:
        if isinstance(message, operator.RunFinished):
            self.result = message
            self.simulation.checkers.finished(self.plan, message)
        else:
            self._wait()

    def _cancel(self) -> None:
        def cancelled(message: Any) -> None:
            # The command that cancels also ends the agent, within its time limit.
            agents = self.simulation.truth
            self.world.after(self.world.chance.random() * 20.0, agents.agent_ends, self.plan)

        self.ask(operator.CancelRun, {"run": self.plan.name}, cancelled)


class SimGateway(Asker):
    """Plays a run's plan, submit after submit. Its durable state survives a crash: keys, and the submits
    it has seen finished."""

    def __init__(self, simulation: Simulation, plan: PlannedRun) -> None:
        super().__init__(simulation, f"gateway-{plan.name}")
        self.plan = plan
        self.position = 0
        """Number of the plan's submits that have ended; durable."""
        self.closed = False
        self.machine, self.tells_kernel = simulation.machine_of(plan)
        self.asks_permit = simulation.asks_permit(plan)
        self.boot_id = self.machine.boot_id
        self._open()

    def machine_starts_anew(self) -> None:
        """The machine reboots: the gateway and its agent end, and return on another kernel."""
        self.simulation.truth.agent_ends(self.plan, self.boot_id)
        self.crash()

    def moves(self, machine: Machine) -> None:
        """Its machine is given up: an operator makes sure that the agent is not alive, reports so,
        and resumes elsewhere."""
        self.world.note(f"{self.name} is lost on {self.machine.name}")
        self.life += 1
        life = self.life

        def resumed(message: Any) -> None:
            if life == self.life and not self.closed:
                self.machine = machine
                self._open()

        def vouch() -> None:
            self.simulation.truth.agent_ends(self.plan)
            voucher = self.simulation.operators[0]
            voucher.ask(operator.AgentGone, {"run": self.plan.name}, resumed)

        self.world.after(20.0 + self.world.chance.random() * 60.0, vouch)

    def crash(self, back_s: float = 0.0) -> None:
        """The gateway dies, and returns after `back_s` or a little later. Its agent lives on."""
        self.world.note(f"{self.name} dies")
        self.life += 1
        life = self.life

        def back() -> None:
            if life == self.life and not self.closed:
                self._open()

        self.world.after(back_s + self.world.chance.random() * 5.0, back)

    def _open(self) -> None:
        self.boot_id = self.machine.boot_id
        fields = {"run": self.plan.name, "asks_permit": self.asks_permit}
        self.ask(gateway.OpenRun, fields, self._opened)

    def _opened(self, message: Any) -> None:
        if isinstance(message, wire.Refused):
            if message.status in NOT_NOW:
                self.later(1.0, self._open)
                return
            self._over()  # the run is finished or cancelled
            return
        self.simulation.truth.asks(self.plan)
        self._ask_permit()

    def _over(self) -> None:
        self.simulation.truth.agent_ends(self.plan)
        self.ask(gateway.CloseRun, {"run": self.plan.name, "reason": "cancelled"}, self._run_closed)

    def _ask_permit(self) -> None:
        if not self.asks_permit:
            self._permitted(gateway.Permit(granted=True))
            return
        known = self.tells_kernel
        fields = {
            "run": self.plan.name,
            "boot_id": self.boot_id if known else "",
            "host": self.machine.name,
            "wait_s": 5.0,
        }
        self.ask(gateway.RequestPermit, fields, self._permitted, 5.0)

    def _permitted(self, message: Any) -> None:
        if isinstance(message, wire.Refused):
            self._over()
        elif not message.granted:
            self._ask_permit()
        else:
            if self.position < len(self.plan.submits):
                self.simulation.truth.agent_starts(self.plan, self.boot_id)
            self._next()

    def _next(self) -> None:
        if self.position == len(self.plan.submits):
            self.simulation.truth.agent_ends(self.plan)
            self.ask(gateway.CloseRun, {"run": self.plan.name, "reason": "done"}, self._run_closed)
            return
        submit = self.plan.submits[self.position]
        fields = self._fields(self.position)
        self.ask(gateway.Submit, fields, self._submitted)
        if self.world.chance.random() < 0.2 and submit.ids:
            other = {
                **fields,
                "key": f"other-{self.position}-{self.world.chance.random()}",
                "env_instances": (999,),
            }
            self.ask(gateway.Submit, other, self.simulation.checkers.refused)

    def _fields(self, position: int) -> dict[str, Any]:
        submit = self.plan.submits[position]
        return {
            "run": self.plan.name,
            "key": f"submit-{position}",
            "env_instances": submit.ids,
            "bundle": submit.bundle,
        }

    def _run_closed(self, message: Any) -> None:
        self.closed = True
        self.simulation.truth.closed(self.plan)
        if self.world.chance.random() < 0.3:
            late = {**self._fields(0), "key": "too-late"}
            self.ask(gateway.Submit, late, self.simulation.checkers.refused)

    def _submitted(self, message: Any) -> None:
        if isinstance(message, wire.Refused) and message.status in NOT_NOW:
            self.later(1.0, self._next)
            return
        if isinstance(message, wire.Refused) and message.status in RUN_OVER:
            self._over()
            return
        if isinstance(message, wire.Refused):
            self.simulation.checkers.submit_refused(self.plan, self.position, message)
            self._after_submit()
            return
        assert isinstance(message, gateway.SubmitAccepted)
        if self.world.chance.random() < 0.2:
            second = {
                **self._fields(self.position),
                "key": f"second-{self.position}",
                "env_instances": (999,),
            }
            self.ask(gateway.Submit, second, self.simulation.checkers.refused)
        self._read(message.submit_index, 0, [])

    def _read(self, index: int, cursor: int, seen: list[Any]) -> None:
        fields = {"run": self.plan.name, "submit_index": index, "cursor": cursor, "wait_s": 8.0}
        self.ask(gateway.ResultsRequest, fields, lambda message: self._page(index, seen, message), 8.0)

    def _page(self, index: int, seen: list[Any], message: Any) -> None:
        assert isinstance(message, Page), message
        seen = [*seen, *message.rows]
        if message.done is None:
            self._read(index, message.cursor, seen)
            return
        self.simulation.checkers.submit_seen(self.plan, index, seen, message.done)
        self._after_submit()

    def _after_submit(self) -> None:
        self.position += 1
        thinks_s = self.simulation.thinks_s
        self.later(thinks_s + self.world.chance.random(), self._next)
