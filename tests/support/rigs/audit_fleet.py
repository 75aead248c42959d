"""Workers that audit each other on a core, some of which forge what they report."""

from __future__ import annotations

from typing import Any

import msgspec

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import operator
from evopolicy_common.messages import worker as wire
from evopolicy_common.messages.episode import BlobRef
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.effects import PrepareAudit
from evopolicy_coordinator.core.contract.records import OutcomeRow
from rigs.core_rig import ENV, Rig, describe, fingerprint, outcome_of, result

WAIT_S = 100.0


class Fleet:
    """Workers on a rig, each with what it adds to every return that it reports, and the shell's side of audits."""

    def __init__(self, share: float = 1.0, **adds: float) -> None:
        self.rig = Rig(audit_share=share, audit_wait_s=WAIT_S)
        self.adds = adds
        self.sessions: dict[str, str] = {}
        self.played: list[tuple[str, str]] = []
        """Worker and job, in order."""
        for name in adds:
            self.join(name)

    def join(
        self, name: str, *, cpu: str = "x", deterministic: bool = True, slots: int = 2, machine: str = ""
    ) -> None:
        self.adds.setdefault(name, 0.0)
        session = f"{name}-s{self.rig.request()}"
        reply = self.rig.ask(
            wire.Register,
            worker=name,
            session=session,
            slots=slots,
            tiers=("bwrap",),
            environments=(msgspec.structs.replace(describe(ENV), deterministic=deterministic),),
            fingerprint=msgspec.structs.replace(fingerprint(), cpu=cpu),
            machine=machine,
            boot_id=f"kernel-of-{name}",
        )
        if not isinstance(reply, wire.Registered):
            raise RefusedError(reply.status, reply.message)
        self.sessions[name] = session
        self.rig.beat(session)

    def report_results(self, name: str, lease: wire.Lease) -> Any:
        return self.rig.report_results(self.sessions[name], self.done(name, lease))

    def done(self, name: str, lease: wire.Lease) -> wire.JobResult:
        self.played.append((name, lease.job.job_id))
        episodes = []
        for spec in lease.job.episodes:
            truth = float(spec.replay.digest) if spec.replay is not None else spec.case.seed * 0.5
            outcome = outcome_of(spec.index, truth + self.adds[name])
            recording = BlobRef(digest=f"{spec.index}" * 64, size=9)
            episodes.append(msgspec.structs.replace(outcome, trajectory=recording))
        return result(lease, "done", episodes=tuple(episodes))

    def turn(self, *names: str) -> int:
        """Each of the workers plays what it gets at once; gives the number of jobs."""
        n = 0
        for name in names or tuple(self.sessions):
            if name in self.rig.core.state.quarantined:
                continue
            for lease in self.rig.poll(self.sessions[name]) or ():
                self.report_results(name, lease)
                n += 1
        return n + self.shell()

    def shell(self) -> int:
        """Carry out what audits need of the store."""
        effects, self.rig.audits = self.rig.audits, []
        for effect in effects:
            played = self.rig.row(OutcomeRow, effect.group, effect.index).outcome
            common = {"run": effect.run, "audit": effect.audit}
            if isinstance(effect, PrepareAudit):
                true_return = self._truth(effect.group, effect.index)
                actions = BlobRef(digest=str(true_return), size=1)
                self.rig.tell(events.AuditPrepared(**common, actions=actions))
                continue
            again = [self.rig.row(OutcomeRow, group, 0).outcome for group in effect.replays]
            self.rig.tell(
                events.AuditCompared(
                    **common,
                    replay=len(again),
                    with_player=_difference(played.episode_return, again[-1].episode_return),
                    with_first=_difference(again[0].episode_return, again[-1].episode_return),
                )
            )
        return len(effects)

    def _truth(self, group: str, index: int) -> float:
        row = self.rig.row(OutcomeRow, group, index)
        return row.outcome.episode_return - self.adds[row.worker]

    def train(self, *ids: int, run: str = "r1") -> None:
        """A run with one submit, not closed."""
        self.rig.create(run, n_valid=2, n_held=2)
        self.rig.submit(*ids, run=run)

    def work_off(self) -> None:
        for _ in range(1000):
            if not self.turn():
                return
        raise AssertionError("there is no end to the work")

    def whole_run(self, *ids: int) -> operator.RunFinished:
        """A run from its creation to its end; every worker works."""
        self.train(*(ids or tuple(range(8))))
        self.work_off()
        return self.end(WAIT_S + 60.0)

    def end(self, wait_s: float = 0.0) -> operator.RunFinished:
        """Close the run, work off the rest, and let `wait_s` seconds pass."""
        self.rig.close()
        self.work_off()
        self.rig.pass_time(wait_s)
        return self.rig.finished()

    @property
    def audits(self) -> list[tuple[str, str]]:
        """The replays: the worker of each, and the player of the original."""
        found = []
        for name, job in self.played:
            group, mark, rest = job.rpartition("/")[0].partition("/audit-")
            if mark:
                index = int(rest.partition(".")[0])
                found.append((name, self.rig.row(OutcomeRow, group, index).worker))
        return found


def _difference(one: float, other: float) -> str | None:
    return None if one == other else f"step 0: reward {one!r} and {other!r}"


def audit_state(finished: operator.RunFinished) -> Any:
    assert finished.audit is not None
    return finished.audit
