"""Bugs to plant in the production core or in the simulated shell, one at a time: each changes a few words in one
function's source.

A test plants each bug and requires that some seed fails; this shows that the simulation detects errors.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sim_coordinator import SimCoordinator
from sim_store import Disk

from evopolicy_coordinator.core import loading, machine
from evopolicy_coordinator.core.agents import permits, precedence, requests
from evopolicy_coordinator.core.isolation import conflicts, occupancies
from evopolicy_coordinator.core.leasing import fleet, groups, leases, queue
from evopolicy_coordinator.core.runs import finalisation, finished, submits, templates
from evopolicy_coordinator.core.structures.ledger import Ledger
from evopolicy_coordinator.core.tables.model import Profile
from evopolicy_coordinator.core.tables.state import CaseSets, State
from evopolicy_coordinator.core.tables.step import Step
from evopolicy_coordinator.core.workers import membership, results, scheduler


@dataclass(frozen=True)
class Bug:
    """One change: in function `name` of `owner`, `old` becomes `new`."""

    title: str
    owner: Any
    name: str
    old: str
    new: str
    seed: int = 0
    """The first that detects it, to try before the others. After a change of the core it may be another one."""


@contextmanager
def planted(bug: Bug) -> Iterator[None]:
    """Context manager: the bug is in the core while the context is open."""
    function = getattr(bug.owner, bug.name)
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(bug.old) >= 1, f"{bug.title}: {bug.old!r} is not in {bug.name}"
    made: dict[str, Any] = {}
    exec(
        compile(source.replace(bug.old, bug.new), f"<planted: {bug.title}>", "exec"),
        function.__globals__,
        made,
    )
    tables: tuple[dict[Any, Any], ...] = (machine.EVENTS, machine.NEWS, machine.TIMERS)
    before = [dict(table) for table in tables]
    planted_one = made[bug.name]
    setattr(bug.owner, bug.name, planted_one)
    for table in tables:
        for key, rule in table.items():
            table[key] = (
                tuple(planted_one if each is function else each for each in rule)
                if isinstance(rule, tuple)
                else planted_one
                if rule is function
                else rule
            )
    try:
        yield
    finally:
        setattr(bug.owner, bug.name, function)
        for table, old in zip(tables, before, strict=True):
            table.update(old)


BUGS = (
    Bug("settle twice", Ledger, "_take", ".pop(submit_index, None)", ".get(submit_index)"),
    Bug("refund what is to be charged", submits, "end", "run.ledger.settle(", "run.ledger.refund("),
    Bug("send before persist", Step, "effects", "[first, *self._out]", "[*self._out, first]"),
    Bug("let a deposed leader write", Disk, "admits", "term == self.incarnation", "True", seed=7),
    Bug(
        "reply before the commit",
        SimCoordinator,
        "_flush",
        "effects, self._queue = self._queue, []",
        "effects, self._queue = sorted(self._queue, key=lambda each: isinstance(each, Persist)), []",
    ),
    Bug(
        "let two coordinators lead",
        SimCoordinator,
        "_step_down",
        "life == self.life and",
        "False and",
        seed=7,
    ),
    Bug(
        "refuse from memory after losing the lock",
        SimCoordinator,
        "_flush",
        "isinstance(effect, Refuse) and not",
        "False and not",
        seed=1037,
    ),
    Bug("forget to queue after a back-off", queue, "backed_off", "if job is not None", "if False", seed=10),
    Bug("forget the adoption timer", loading, "load", "if state.adopting:", "if False:", seed=5),
    Bug("forget the worker's timer", membership, "check_due", "if deadlines:", "if False:"),
    Bug(
        "skip the fencing",
        results,
        "take_results",
        "live = lease is not None and lease.live and job.lease is lease",
        "live = True",
        seed=13,
    ),
    Bug("count late limit verdicts", results, "_done", "if silent and", "if False and", seed=49),
    Bug("keep a job open when it is done", results, "_commit", "groups.close_job(state, job, step)", "pass"),
    Bug("answer for outcomes that were not stored", results, "_commit", "step.persist(row)", "pass"),
    Bug("count attempts from one after a restart", State, "__init__", "(incarnation - 1) *", "0 *", seed=13),
    Bug(
        "show episodes before the gate",
        submits,
        "_released",
        "if 0 in group.digests",
        "if True",
        seed=15,
    ),
    Bug(
        "let ties go to the earlier submit",
        finished,
        "select",
        "best_validated(means, run.row.settings.profile)",
        "max(means, key=lambda index: (means[index], -index), default=None)",
        seed=34,
    ),
    Bug("select before all are validated", finalisation, "advance", "if waiting:", "if False:"),
    Bug(
        "forget idempotency keys at a restart",
        loading,
        "_run",
        "run.keys[row.key] = row.submit_index",
        "pass",
        seed=49,
    ),
    Bug("take a second submit while one runs", submits, "submit", "if run.open is not None:", "if False:"),
    Bug("take submits of a closed run", submits, "submit", 'run.state.phase != "open"', "False", seed=22),
    Bug("accept the same key twice", submits, "submit", "known is not None", "False", seed=8),
    Bug(
        "lease to a poll that was given up unread",
        scheduler,
        "poll",
        "event.waited_s > message.wait_s + state.settings.late_s",
        "False",
        seed=150,
    ),
    Bug(
        "leave runs unpinned when a lost worker is back",
        membership,
        "worker_of",
        "if was_lost:",
        "if False:",
        seed=23,
    ),
    Bug(
        "leave runs unpinned when a worker is taken back",
        membership,
        "worker_state",
        "pins.pin_waiting(state, worker, step)",
        "pass",
        seed=15,
    ),
    Bug("let a lease expire under heartbeats", leases, "hear", "lease.renewed = now", "pass", seed=1),
    Bug(
        "take a liveliness hint for the truth",
        membership,
        "liveness_lost",
        "worker.doubted_at = step.now",
        "__import__('evopolicy_coordinator.core.workers.membership', fromlist=['lose']).lose(state, worker, step)",
        seed=20,
    ),
    Bug(
        "expire leases after the loop stood still",
        machine.Core,
        "_watch",
        "now - due > state.settings.late_s",
        "False",
        seed=150,
    ),
    Bug(
        "play what is done again after a restart",
        groups,
        "open_group",
        "loading.heads.pop(group.id, [])",
        "[]",
        seed=5,
    ),
    Bug(
        "forget after a restart who is out of service",
        fleet,
        "count_in",
        'state.out_of_service.get(worker.name, "active")',
        '"active"',
        seed=13,
    ),
    Bug("mix fingerprint classes", Profile, "serves", "and fingerprint_class == self.classes[env]", ""),
    Bug("adopt a job that is leased elsewhere", leases, "_adopt", "or job.lease is not None", "", seed=46),
    Bug("forget to tell a worker to stop", leases, "hear", "stop.append(item.lease_id)", "pass", seed=13),
    Bug(
        "leave a lost worker's leases with it",
        membership,
        "_take_all",
        "list(worker.leases.values())",
        "[]",
        seed=26,
    ),
    Bug(
        "refuse a worker that comes back",
        fleet,
        "of_session",
        'if worker.state == "lost":',
        "if False:",
        seed=23,
    ),
    Bug(
        "play hidden episodes beside an agent",
        conflicts,
        "hidden_conflict",
        "if permits_there(state, kernel, case_set):",
        "if False:",
    ),
    Bug(
        "play hidden episodes beside train episodes",
        conflicts,
        "hidden_conflict",
        "if related(kernel.train, case_set) or related(state.everywhere.train, case_set):",
        "if False:",
        seed=5,
    ),
    Bug(
        "play train episodes beside hidden ones",
        conflicts,
        "train_conflict",
        "if related(kernel.hidden, case_set) or related(state.everywhere.hidden, case_set):",
        "if False:",
        seed=12,
    ),
    Bug(
        "play hidden episodes on a kernel that is not known",
        conflicts,
        "hidden_conflict",
        "if kernel is state.everywhere:",
        "if False:",
        seed=29,
    ),
    Bug(
        "take an agent that may be anywhere for one that is nowhere",
        conflicts,
        "permits_there",
        "or related(state.everywhere.permits, case_set)",
        "",
        seed=1,
    ),
    Bug("take siblings for strangers", CaseSets, "join", "(env, case.seed,", "(len(self._known), case.seed,"),
    Bug("forget permits at a restart", permits, "load", "row.ended_at is not None", "True", seed=34),
    Bug("forget what a silent worker may still play", occupancies, "vacate", "if sure:", "if True:", seed=19),
    Bug(
        "take all kernels for free after a restart",
        occupancies,
        "load",
        "for hidden in (True, False):",
        "for hidden in ():",
        seed=44,
    ),
    Bug("keep a closed run's permit", finalisation, "close", "permits.end(", "(lambda *_: None)("),
    Bug(
        "hold the submits of an agent that hidden episodes wait for",
        conflicts,
        "reserved_there",
        "and not permits_there(state, kernel, case_set)",
        "",
    ),
    Bug("keep what was handed back in memory only", results, "_keep_begun", "step.persist(", "str(", seed=19),
    Bug(
        "drop what was handed back",
        results,
        "_keep_begun",
        "job.begun, job.begun_attempt = result.begun, result.attempt",
        "job.begun_attempt = result.attempt",
        seed=19,
    ),
    Bug(
        "forget at a restart what was handed back", loading, "load", "loading.begun.update(", "dict(", seed=38
    ),
    Bug(
        "end others' permits when a gateway names another kernel of their machine",
        requests,
        "requested",
        "kernel = permits.place(run, message.boot_id)",
        "kernel = permits.place(run, message.boot_id);"
        " [permits._end(state, there, row, step, '') for each in list(state.permits)"
        " for there, row in permits.permits_of_run(state, each)"
        " if row.host == message.host and row.boot_id != message.boot_id]",
        seed=145,
    ),
    Bug(
        "end permits when a worker names another kernel of their machine",
        membership,
        "registered",
        "occupancies.joined(state, worker, step)",
        "occupancies.joined(state, worker, step);"
        " permits = __import__('evopolicy_coordinator.core.agents.permits', fromlist=['permits_of_run']);"
        " [permits._end(state, there, row, step, '') for each in list(state.permits)"
        " for there, row in permits.permits_of_run(state, each)"
        " if row.host == worker.host and row.boot_id != message.boot_id]",
        seed=19,
    ),
    Bug(
        "let a worker free the kernel of another of its name",
        occupancies,
        "surely",
        "(occupancy.kernel, occupancy.machine) != (worker.kernel, worker.machine)",
        "False",
        seed=19,
    ),
    Bug(
        "cancel a run that keeps others waiting at once",
        precedence,
        "_end_overdue",
        ">= state.settings.agent_wait_s",
        ">= 0.0",
        seed=0,
    ),
    Bug(
        "let an agent start before hidden episodes have ended",
        conflicts,
        "permit_conflict",
        "if not occupancies:",
        "if not any(occupancy.lease is not None and occupancy.lease.live for occupancy in occupancies):",
        seed=19,
    ),
    Bug(
        "never reserve a kernel",
        precedence,
        "_kept",
        "flow.kept_s >= state.settings.hidden_wait_s",
        "False",
        seed=2,
    ),
    Bug(
        "never release a reserved kernel",
        precedence,
        "check_due",
        "if not any(flow.n_hidden and flow.lane is lane for flow in reservation.flows):",
        "if False:",
        seed=2,
    ),
    Bug(
        "let later hidden episodes prolong a reservation",
        precedence,
        "check_due",
        "if not any(flow.n_hidden and flow.lane is lane for flow in reservation.flows):",
        "if not lane.waiting[HIDDEN]:",
        seed=6,
    ),
    Bug(
        "let an agent keep others waiting for ever",
        precedence,
        "_kept",
        "_end_overdue(state, reservation, step)",
        "pass",
        seed=113,
    ),
    Bug(
        "believe in kernels on which nobody works",
        precedence,
        "_at_work",
        "(worker.poll or worker.n_live or asked)",
        "True",
        seed=2,
    ),
    Bug(
        "keep agents away for hidden episodes that nobody can play",
        precedence,
        "_at_work",
        "for profile in lane.profiles for",
        "for profile in state.profiles.values() for",
        seed=0,
    ),
    Bug(
        "validate while the run is open",
        finalisation,
        "submit_ended",
        "advance(state, news.run, step)",
        "advance(state, news.run, step); news.row.status != 'ok' or"
        " _open(state, templates.hidden('validation', news.run, news.row, step), step)",
    ),
    Bug(
        "keep evaluations of open cases from agents' kernels",
        templates,
        "hidden_evaluation",
        "row.split in HIDDEN_SPLITS and",
        "",
        seed=14,
    ),
)
