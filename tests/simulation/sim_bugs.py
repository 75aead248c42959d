"""Bugs to plant in the production core, one at a time: each is a change of a few words in one function's source.

The simulation is worth what it catches: a test plants each and sees that some seed fails.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from evopolicy_coordinator.core import (
    audit,
    finalisation,
    handin,
    loading,
    machine,
    membership,
    precedence,
    runs,
)
from evopolicy_coordinator.core.isolation import Families, Isolation
from evopolicy_coordinator.core.jobs import JobGroup
from evopolicy_coordinator.core.leases import LeaseBook
from evopolicy_coordinator.core.ledger import Ledger
from evopolicy_coordinator.core.queue import Profile
from evopolicy_coordinator.core.scheduler import Scheduler
from evopolicy_coordinator.core.turn import Turn
from evopolicy_coordinator.core.workers import Fleet


@dataclass(frozen=True)
class Bug:
    """One change: in function `name` of `owner`, `old` becomes `new`."""

    title: str
    owner: Any
    name: str
    old: str
    new: str


@contextmanager
def planted(bug: Bug) -> Iterator[None]:
    """The bug is there while this lasts."""
    function = getattr(bug.owner, bug.name)
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(bug.old) >= 1, f"{bug.title}: {bug.old!r} is not in {bug.name}"
    made: dict[str, Any] = {}
    exec(
        compile(source.replace(bug.old, bug.new), f"<planted: {bug.title}>", "exec"),
        function.__globals__,
        made,
    )
    handlers = machine._HANDLERS
    handled = [kind for kind, handler in handlers.items() if handler is function]
    imported = [bug.owner] + [each for each in (machine,) if getattr(each, bug.name, None) is function]
    for owner in imported:
        setattr(owner, bug.name, made[bug.name])
    for kind in handled:
        handlers[kind] = made[bug.name]
    try:
        yield
    finally:
        for owner in imported:
            setattr(owner, bug.name, function)
        for kind in handled:
            handlers[kind] = function


BUGS = (
    Bug("settle twice", Ledger, "_take", ".pop(submit_index, None)", ".get(submit_index)"),
    Bug("refund what is to be charged", runs, "end", "run.ledger.settle(", "run.ledger.refund("),
    Bug("send before persist", Turn, "effects", "[first, *self._out]", "[*self._out, first]"),
    Bug("forget to queue after a back-off", machine.Core, "_fire", 'kind == "job"', 'kind == "no"'),
    Bug("forget the adoption timer", loading, "load", "if core.adopting:", "if False:"),
    Bug("forget the worker's timer", LeaseBook, "look", "if deadlines:", "if False:"),
    Bug(
        "skip the fencing",
        handin,
        "take",
        "live = lease is not None and lease.live and job.lease is lease",
        "live = True",
    ),
    Bug("count late limit verdicts", handin, "_done", "(silent or not live) and", "False and"),
    Bug(
        "keep a job open when it is done",
        handin,
        "commit",
        'core.close_job(job, turn, "done by another attempt")',
        "pass",
    ),
    Bug("answer for outcomes that were not stored", handin, "commit", "turn.persist(row)", "pass"),
    Bug("count attempts from one after a restart", machine.Core, "__init__", "(incarnation - 1) *", "0 *"),
    Bug("show episodes before the gate", runs, "_released", "if 0 in group.marks", "if True"),
    Bug("let ties go to the earlier submit", finalisation, "select", ">= best_mean", "> best_mean"),
    Bug("select before all are validated", finalisation, "advance", "if waiting:", "if False:"),
    Bug(
        "forget idempotency keys at a restart",
        loading,
        "_run",
        "run.keys[row.key] = row.submit_index",
        "pass",
    ),
    Bug("take a second submit while one runs", runs, "submit", "if run.open is not None:", "if False:"),
    Bug("take submits of a closed run", runs, "submit", 'run.state.phase != "open"', "False"),
    Bug("accept the same key twice", runs, "submit", "known is not None", "False"),
    Bug("never preempt", Scheduler, "dispatch", "if lane.n_ready[TRAIN]:", "if False:"),
    Bug(
        "forget the hidden jobs that train jobs wait behind",
        Scheduler,
        "hidden_leased",
        "if lane.n_ready[TRAIN]:",
        "if False:",
    ),
    Bug(
        "lease to a poll that was given up unread",
        Scheduler,
        "poll",
        "event.waited_s > message.wait_s + core.settings.late_s",
        "False",
    ),
    Bug(
        "leave runs unpinned when a lost worker is back", membership, "worker_of", "if was_lost:", "if False:"
    ),
    Bug(
        "leave runs unpinned when a worker is taken back",
        membership,
        "worker_state",
        "_pin_waiting(core, worker, turn)",
        "pass",
    ),
    Bug("let a lease expire under heartbeats", LeaseBook, "hear", "lease.renewed = now", "pass"),
    Bug(
        "take a liveliness hint for the truth",
        membership,
        "liveness_lost",
        "worker.doubted_at = turn.now",
        "core.book.lose(worker, turn)",
    ),
    Bug(
        "expire leases after the loop stood still",
        machine.Core,
        "_watch",
        "now - due > self.settings.late_s",
        "False",
    ),
    Bug(
        "play what is done again after a restart",
        machine.Core,
        "open_group",
        "self.heads.pop(group.id, [])",
        "[]",
    ),
    Bug(
        "forget after a restart who is out of service",
        Fleet,
        "_count_in",
        'self.out_of_service.get(worker.name, "active")',
        '"active"',
    ),
    Bug("mix fingerprint classes", Profile, "serves", "and fingerprint_class == self.key[2]", ""),
    Bug("adopt a job that is leased elsewhere", LeaseBook, "_adopt", "or job.lease is not None", ""),
    Bug("forget to tell a worker to stop", LeaseBook, "hear", "stop.append(item.lease_id)", "pass"),
    Bug("leave a lost worker's leases with it", LeaseBook, "lose", "list(worker.leases.values())", "[]"),
    Bug("refuse a worker that comes back", Fleet, "of_session", 'if worker.state == "lost":', "if False:"),
    Bug("let a worker audit itself", JobGroup, "bars", "worker.name in self.not_on or", ""),
    Bug("forget at a restart what is to be audited", audit, "resume", 'row.state != "open"', "True"),
    Bug("wait for audits that nobody can play", machine.Core, "_fire", 'kind == "audits"', 'kind == "no"'),
    Bug(
        "call a forger who one other contradicts", audit, "compared", "elif event.replay == 1:", "elif False:"
    ),
    Bug(
        "forget at a restart who is quarantined",
        Fleet,
        "set_state",
        "self.quarantined[name] = reason",
        "pass",
    ),
    Bug(
        "play hidden episodes beside an agent",
        Isolation,
        "hidden_bar",
        "if self._permits(kernel, family):",
        "if False:",
    ),
    Bug(
        "play hidden episodes beside train episodes",
        Isolation,
        "hidden_bar",
        "if related(kernel.train, family) or related(self.everywhere.train, family):",
        "if False:",
    ),
    Bug(
        "play train episodes beside hidden ones",
        Isolation,
        "train_bar",
        "if related(kernel.hidden, family) or related(self.everywhere.hidden, family):",
        "if False:",
    ),
    Bug(
        "play hidden episodes on a kernel that is not known",
        Isolation,
        "hidden_bar",
        "if kernel is self.everywhere:",
        "if False:",
    ),
    Bug(
        "take an agent that may be anywhere for one that is nowhere",
        Isolation,
        "_permits",
        "or related(self.everywhere.permits, family)",
        "",
    ),
    Bug(
        "let an agent start before hidden episodes have stopped",
        Isolation,
        "permit_bar",
        "if not stays:",
        "if not any(stay.lease is not None and stay.lease.live for stay in stays):",
    ),
    Bug("take siblings for strangers", Families, "join", "(env, case.seed,", "(len(self._known), case.seed,"),
    Bug("forget permits at a restart", Isolation, "load", "row.ended_at is not None", "True"),
    Bug("forget what a silent worker may play", Isolation, "left", "if sure:", "if True:"),
    Bug(
        "take a lease on its way for one that was let go of",
        Isolation,
        "surely",
        "stay is None or settled == 0",
        "True",
    ),
    Bug(
        "take all kernels for free after a restart",
        Isolation,
        "load",
        "for hidden in (True, False):",
        "for hidden in ():",
    ),
    Bug("keep a closed run's permit", finalisation, "close", "core.isolation.end(", "(lambda *_: None)("),
    Bug(
        "never turn a kernel over to hidden episodes",
        precedence,
        "_hidden",
        "kept_s >= core.settings.hidden_wait_s",
        "False",
    ),
    Bug(
        "never turn a kernel back",
        precedence,
        "_hidden",
        "lane.done_looks[family] >= DONE_LOOKS",
        "False",
    ),
    Bug(
        "hold the submits of an agent that hidden episodes wait for",
        Isolation,
        "_reversed",
        "and not self._permits(kernel, family)",
        "",
    ),
    Bug("draw episodes anew at a restart", audit, "sample", "run.row.audit_share", "0.5"),
)
