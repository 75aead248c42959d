"""A core with a store in memory and a clock that tests set. It replaces the shell, and never waits or fails."""

from __future__ import annotations

from operator import attrgetter
from typing import Any, TypeVar

from evopolicy_common.messages import gateway, operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_common.messages.episode import (
    EpisodeOutcome,
    FailureCategory,
    Job,
    PolicyFailure,
    ResourceLimits,
)
from evopolicy_common.messages.operator import RunFinished
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.status import StatusReply
from evopolicy_common.messages.worker import Message
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import (
    Effect,
    Log,
    Persist,
    ReadEvaluation,
    ReadFinished,
    ReadResults,
    Refuse,
    Reply,
)
from evopolicy_coordinator.core.contract.records import (
    BegunRow,
    EvaluationRow,
    JournalRow,
    KernelRow,
    OutcomeRow,
    PermitRow,
    Row,
    RunRow,
    RunStateRow,
    Snapshot,
    SubmitRow,
    WorkerRow,
    head_of,
)
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.server.reason_texts import message, reason_text
from evopolicy_coordinator.storage.store import _PLACES, _VALUES
from rigs.asking import asked
from rigs.core_invariants import check_invariants

ENV = "toy/line"
BUNDLE = "a" * 64
T = TypeVar("T")


def describe(env: str = ENV, **more: Any) -> EnvironmentDescription:
    fields = {"env_version": "1", "max_episode_steps": 10, "task_text": ""} | more
    return EnvironmentDescription(env=env, obs_space={}, action_space={}, **fields)


def fingerprint(version: str = "1", packages: dict[str, str] | None = None) -> wire.Fingerprint:
    packages = {"numpy": "2.4"} if packages is None else packages
    return wire.Fingerprint(code_version=version, python="3.11", packages=packages, cpu="x")


def outcome_of(index: int, value: float = 1.0, failure: FailureCategory | None = None) -> EpisodeOutcome:
    failed = failure and PolicyFailure(category=failure, step_index=None, message="it failed")
    values = {"length": 3, "terminated": True, "truncated": False, "wall_s": 1.0}
    return EpisodeOutcome(index=index, episode_return=value, failure=failed, **values)


def key_of(row: Row) -> tuple[Any, ...]:
    """The row's kind and the values of its key in the database."""
    names = _PLACES[type(row)].key
    return (type(row), *(_VALUES.get(name, attrgetter(name))(row) for name in names))


class Rig:
    """Drives a core; `now` is what tests say it is."""

    def __init__(self, **settings: Any) -> None:
        self.settings = CoreSettings(**settings)
        self.rows: dict[tuple[Any, ...], Row] = {}
        self.now = 1000.0
        self.replies: dict[events.RequestId, Any] = {}
        self.logs: list[Log] = []
        self.incarnation = 0
        self._requests = 0
        self.core = self.load()

    def load(self) -> Core:
        """A new core from what is stored, as after a crash."""
        self.incarnation += 1
        self.core, effects = Core.load(self.settings, self.snapshot(), self.now)
        self._carry_out(effects)
        return self.core

    def snapshot(self) -> Snapshot:
        def of(kind: type[T]) -> tuple[T, ...]:
            return tuple(row for row in self.rows.values() if isinstance(row, kind))

        return Snapshot(
            incarnation=self.incarnation,
            runs=of(RunRow),
            states=of(RunStateRow),
            submits=of(SubmitRow),
            outcomes=tuple(head_of(row) for row in of(OutcomeRow)),
            begun=of(BegunRow),
            evaluations=of(EvaluationRow),
            workers=of(WorkerRow),
            permits=tuple(row for row in of(PermitRow) if row.ended_at is None),
            kernels=of(KernelRow),
            journal=max(of(JournalRow), key=lambda row: row.seq, default=None),
            revealed=tuple(row.reveals for row in of(JournalRow) if row.reveals),
        )

    # ---- driving ----

    def request(self) -> int:
        self._requests += 1
        return self._requests

    def tell(self, event: events.AnyEvent) -> Any:
        """Hand an event in; gives the answer to its request, None while it waits."""
        self._carry_out(self.core.handle(event, self.now))
        check_invariants(self.core.state)
        return self.replies.get(getattr(event, "request", None))  # type: ignore[arg-type]

    def ask(self, kind: type[Message], **fields: Any) -> Any:
        """Send a message with the fields that the shell adds; gives the answer, None while it waits."""
        return self.tell(asked(kind, request=self.request(), **fields))

    def pass_time(self, seconds: float) -> None:
        """Let time pass, serving every deadline when it is due."""
        until = self.now + seconds
        while True:
            due = self.core.next_deadline()
            if due is None or due > until:
                break
            self.now = max(self.now, due)
            self._carry_out(self.core.handle_deadline(self.now))
            check_invariants(self.core.state)
        self.now = until

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Persist():
                    for row in effect.rows:
                        self.rows[key_of(row)] = row
                case Log():
                    self.logs.append(effect)
                case Reply() | Refuse():
                    assert effect.request not in self.replies, "one answer each"
                    self.replies[effect.request] = message(effect)
                case ReadResults() | ReadEvaluation() | ReadFinished():
                    assert effect.request not in self.replies, "one answer each"
                    self.replies[effect.request] = effect

    # ---- words ----

    def create(self, run: str = "r1", *, key: str | None = None, train: int = 64, n_valid: int = 2, n_held: int = 3,
               budget: int = 16, env: str = ENV, most: int = 16, least: int = 1, agent: str | None = "agents",
               hidden_from: int = 1000, max_steps: int = 0, epoch: str = "e1", cases_secret: bool = True, **settings: Any) -> Any:  # fmt: skip  # noqa: E501
        """Create a run; its agent gets a permit on kernel `agent`, of its own unless told otherwise, None for none."""
        reply = self.ask(
            operator.CreateRun,
            stimulus_id=f"create-{run}",
            run=run,
            key=key or f"key-{run}",
            capability=f"cap-{run}",
            secret=b"s" * 32,
            settings=RunSettings(env=env, entry="e", model="m", exp_id="x", **settings),
            budget=budget,
            min_episodes_per_submit=least,
            max_episodes_per_submit=most,
            train=tuple(Case(seed=seed) for seed in range(train)),
            validation=tuple(Case(seed=hidden_from + seed) for seed in range(n_valid)),
            heldout=tuple(Case(seed=1000 + hidden_from + seed) for seed in range(n_held)),
            split_hashes={},
            cases_secret=cases_secret,
            epoch=epoch,
            salt=b"n" * 32,
            max_steps=max_steps,
            policy_seeds="",
            allowed_imports=(),
            denied_imports=(),
        )
        if agent is not None and run in self.core.state.runs:
            self.permit(run, agent)
        return reply

    def permit(self, run: str = "r1", boot_id: str = "agents", wait_s: float = 0.0, **more: Any) -> Any:
        """Ask for a permit; None while it waits."""
        return self.ask(gateway.RequestPermit, run=run, boot_id=boot_id, wait_s=wait_s, **more)

    def register(
        self,
        worker: str = "w1",
        *,
        slots: int = 2,
        version: str = "1",
        envs: tuple[str, ...] = (ENV,),
        **more: Any,
    ) -> str:
        session = f"{worker}-s{self.request()}"
        reply = self.ask(
            wire.Register,
            worker=worker,
            session=session,
            slots=slots,
            tiers=more.get("tiers", ("bwrap",)),
            environments=more.get("described", tuple(describe(env) for env in envs)),
            fingerprint=fingerprint(version, more.get("packages")),
            boot_id=more.get("boot_id", f"kernel-of-{worker}"),
            machine=more.get("machine", ""),
            undescribed=more.get("undescribed", ()),
            failed_environments=more.get("failed", {}),
            installation=more.get("installation", ""),
        )
        assert isinstance(reply, wire.Registered)
        if self.incarnation > 1 and more.get("beats", True):
            self.beat(session)  # else it may be playing anything from before
        return session

    def submit(
        self, *ids: int, run: str = "r1", key: str = "k0", bundle: str | None = BUNDLE, **more: Any
    ) -> Any:
        return self.ask(
            gateway.Submit,
            stimulus_id=f"submit-{key}",
            run=run,
            key=key,
            env_instances=ids,
            bundle=bundle,
            **more,
        )

    def begin(
        self, *ids: int, worker: dict[str, Any] | None = None, run: dict[str, Any] | None = None
    ) -> str:
        """Register worker w1, create run r1, submit these episodes, if any. Returns the session."""
        session = self.register(**worker or {})
        self.create(**run or {})
        if ids:
            self.submit(*ids)
        return session

    def poll(self, session: str, n: int = 2, wait_s: float = 0.0, **more: Any) -> Any:
        """The leases that a poll gets; None while it waits."""
        reply = self.ask(
            wire.LeaseRequest, worker=session.split("-")[0], session=session, n=n, wait_s=wait_s, **more
        )
        if reply is None and wait_s == 0.0:
            request = self._requests
            self.pass_time(0.0)
            reply = self.replies.get(request)
        return list(reply.leases) if isinstance(reply, wire.Leases) else reply

    def held(self, lease: wire.Lease, *, running: bool = True) -> wire.HeldLease:
        name, job = lease.lease_id, lease.job.job_id
        return wire.HeldLease(lease_id=name, job_id=job, attempt=lease.attempt, running=running)

    def beat(self, session: str, *held: wire.Lease, running: bool = True, wait_s: float = 0.0) -> Any:
        leases = tuple(self.held(each, running=running) for each in held)
        worker = session.split("-")[0]
        return self.ask(wire.Heartbeat, worker=worker, session=session, held=leases, wait_s=wait_s)

    def report_results(self, session: str, *results: wire.JobResult) -> Any:
        return self.ask(wire.ReportResults, worker=session.split("-")[0], session=session, results=results)

    def play(
        self, session: str, *leases: wire.Lease, value: float = 1.0, failure: FailureCategory | None = None
    ) -> Any:
        """Hand in outcomes of leases."""
        return self.report_results(session, *(done(lease, value, failure) for lease in leases))

    def results(self, submit_index: int = 0, cursor: int = 0, wait_s: float = 0.0, run: str = "r1") -> Any:
        return self.ask(
            gateway.ResultsRequest, run=run, submit_index=submit_index, cursor=cursor, wait_s=wait_s
        )

    def close(self, run: str = "r1") -> Any:
        return self.ask(gateway.CloseRun, run=run, reason="budget_spent")

    def work_off(self, session: str, values: Any = lambda job: 1.0) -> int:
        """Let one worker play all there is; gives the number of jobs."""
        n = 0
        while leases := self.poll(session, n=4):
            n += len(leases)
            self.report_results(session, *(done(lease, values(lease.job)) for lease in leases))
            assert n <= 40_000, "there is no end to the work"
        return n

    def finish(self, session: str, values: Any = lambda job: 1.0) -> RunFinished:
        """Close run r1, let one worker play all there is, and give the run's result."""
        self.close()
        self.work_off(session, values)
        return self.finished()

    def evaluate(self, key: str = "e", **changes: Any) -> Any:
        """Ask for an evaluation of one train case, twice, as evaluation `key` unless told otherwise."""
        usual: dict[str, Any] = {"env": ENV, "bundle": BUNDLE, "split": "train", "case_ids": (4, 4)}
        usual |= {"cases": (Case(seed=4), Case(seed=4)), "secret": b"x", "record": "full"}
        usual |= {"sandbox_tier": "bwrap", "limits": ResourceLimits()}
        return self.ask(operator.Evaluate, evaluation=key, key=key, **usual | changes)

    def stay(self, session: str, n: int, seconds: float, *held: wire.Lease) -> None:
        """Let one worker beat after each of `n` pauses."""
        for _ in range(n):
            self.pass_time(seconds)
            self.beat(session, *held)

    # ---- reading ----

    def status(self) -> StatusReply:
        """An operator's view of the status."""
        return self.core.status(self.now, reason_text)

    def restarted(self, **worker: Any) -> str:
        """Another core from what is stored, with worker w1 of eight slots, once leases may have been adopted."""
        self.load()
        session = self.register(**{"slots": 8, **worker})
        self.pass_time(self.settings.adoption_s)
        return session

    def row(self, kind: type[T], *key: Any) -> T:
        row = self.rows[(kind, *key)]
        assert isinstance(row, kind)
        return row

    def finished(self, run: str = "r1") -> RunFinished:
        return self.row(RunFinished, run)


def done(lease: wire.Lease, value: float = 1.0, failure: FailureCategory | None = None) -> wire.JobResult:
    episodes = tuple(outcome_of(spec.index, value, failure) for spec in lease.job.episodes)
    return result(lease, "done", episodes=episodes)


def result(lease: wire.Lease, kind: wire.ResultKind, **more: Any) -> wire.JobResult:
    return wire.JobResult(
        lease_id=lease.lease_id, job_id=lease.job.job_id, attempt=lease.attempt, kind=kind, **more
    )


def split_of(job: Job) -> str:
    """Which list a job is from: train, validation, heldout, random or an evaluation's."""
    return job.job_id.rsplit("/", 2)[1]
