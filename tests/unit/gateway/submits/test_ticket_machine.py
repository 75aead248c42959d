"""The ticket machine under any order of requests, refusals, errors and crashes, with and without bugs."""

from __future__ import annotations

import inspect
import json
import textwrap
from collections import Counter
from typing import Any

import pytest
from gateway_double import opened
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from evopolicy_common.errors import RefusedError, RequestError
from evopolicy_common.messages.gateway import RunState, SubmitAccepted, SubmitDone
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.open_run import (
    AnyLine,
    Died,
    Rejected,
    Settled,
    SubmitRefused,
    SubmitRequested,
)
from evopolicy_common.refusals import Refusal
from evopolicy_gateway.submits import tickets
from evopolicy_gateway.submits.snapshots import SystemSnapshot
from evopolicy_gateway.submits.tickets import (
    ConflictError,
    Effect,
    Note,
    Send,
    Stop,
    TakeSnapshot,
    Ticket,
    TicketMachine,
)

BUDGET = 12
BODIES = (b'{"env_instances": [1, 2]}', b'{"env_instances": [3]}', b'{"env_instances": [99]}')
CLIENT_KEYS = (None, "a", "b")
REFUSALS = {
    "refuse": Refusal.BUDGET_INVALID,
    "end run": Refusal.RUN_CLOSED,
    "cancel run": Refusal.RUN_CANCELLED,
    "refuse oddly": Refusal.DAMAGED,
}
ACTIONS = (*["ask"] * 4, *["ok"] * 8, *["fail"] * 3, "crash", "crash after", "state", *REFUSALS)


class World:
    """A journal, a coordinator that accepts each key once, and the machine between them."""

    def __init__(self, profile: str) -> None:
        self.profile = profile
        self.journal: list[AnyLine] = []
        self.accepted: dict[str, SubmitAccepted] = {}
        self.sent: dict[str, SubmitRequested] = {}
        self.heard: list[RunState] = []
        """The coordinator's states, oldest first."""
        self.n_asked = 0
        self.refusals: list[tuple[type, Ticket | None]] = []
        """Refused requests: the error, and the ticket that was in flight."""
        self.ends = False
        """Whether the run has accepted its last submit."""
        self.start()

    @property
    def state(self) -> RunState:
        remaining = min([each.remaining_budget for each in self.accepted.values()], default=BUDGET)
        return RunState(remaining_budget=remaining, n_submits=len(self.accepted), is_finalized=False)

    def start(self) -> None:
        """A gateway starts on the journal."""
        run = opened(state=self.state, profile=self.profile, episode_budget=BUDGET)
        self.machine = TicketMachine(run, dict(enumerate(self.journal)))
        self.effect: Effect | None = self.machine.next()
        self.ends = False

    def ask(self, n: int) -> None:
        body, client_key = BODIES[n % 3], CLIENT_KEYS[n // 3 % 3]
        try:
            earlier = self.machine.repeated(body, client_key)
        except ConflictError as error:
            other = self.machine.tickets[error.index].request
            assert (other.client_key, other.body_digest != digest_of(body)) == (client_key, True)
            return
        if earlier is not None:
            assert (earlier.request.client_key, earlier.request.body_digest) == (client_key, digest_of(body))
            return
        before = self.machine.in_flight
        self.n_asked += 1
        try:
            self.machine.open_ticket(body, client_key, f"key-{self.n_asked}")
        except RequestError as refusal:
            self.refusals.append((type(refusal), before))
            if (entry := self.machine.reject(refusal, 0.0)) is not None:
                self.journal.append(entry)
            return
        assert before is None
        assert not self.ends
        self.effect = self.machine.next()
        assert self.effect == TakeSnapshot()

    def perform(self, outcome: str) -> None:
        """Performs the effect, or lets it fail."""
        effect, machine = self.effect, self.machine
        if isinstance(effect, Stop):
            died = [entry.key for entry in self.journal if isinstance(entry, Died)]
            assert died.count(died[-1]) == 1
            self.start()
        elif outcome == "crash":
            self.start()
        elif effect is None:
            pass
        elif isinstance(effect, Note):
            self.journal.append(effect.entry)
            if outcome == "crash after":
                self.start()
            else:
                self.effect = machine.noted(effect.entry, len(self.journal) - 1)
        else:
            self.effect = self.fulfil(effect, outcome)
            if outcome == "crash after":
                self.start()

    def fulfil(self, task: Effect, outcome: str) -> Effect | None:
        ticket, machine = self.machine.in_flight, self.machine
        assert ticket is not None
        if ticket.accepted is None and ticket.request.submit.key in self.accepted:
            outcome = "ok"  # a repeated key gets its acceptance
        if outcome == "fail":
            return machine.failed(KeyError("a bug"))
        if isinstance(task, TakeSnapshot):
            assert ticket.request not in self.journal
            return machine.snapshotted(
                SystemSnapshot(digest=f"bundle-{ticket.request.submit.key}", error=None)
            )
        key = ticket.request.submit.key
        assert ticket.request in self.journal
        assert self.sent.setdefault(key, ticket.request) == ticket.request
        assert ticket.request.submit.bundle
        if isinstance(task, Send):
            assert ticket.accepted is None
            if outcome in REFUSALS:
                self.ends |= outcome in ("end run", "cancel run")
                return machine.refused(RefusedError(REFUSALS[outcome], "no"))
            if key not in self.accepted:
                before = self.state
                self.accepted[key] = SubmitAccepted(
                    submit_index=before.n_submits,
                    first_global_episode=BUDGET - before.remaining_budget,
                    remaining_budget=before.remaining_budget - len(ticket.request.submit.env_instances),
                )
            return machine.sent(self.accepted[key])
        assert ticket.accepted in self.journal
        if outcome in REFUSALS:
            self.ends |= outcome in ("end run", "cancel run")
            return machine.refused(RefusedError(REFUSALS[outcome], "no"))
        summary = json.dumps({"mean_return": ticket.index + 0.5, "policy_failures": 0}).encode()
        return machine.collected(done(ticket), summary)

    def check(self) -> None:
        machine, open_ticket = self.machine, self.machine.in_flight
        assert [ticket.index for ticket in machine.tickets] == list(range(len(machine.tickets)))
        assert open_ticket is None or open_ticket is machine.tickets[-1]
        assert sum(not ticket.done for ticket in machine.tickets) == (open_ticket is not None)
        assert all(ticket.accepted for ticket in machine.tickets if ticket is not open_ticket)
        assert (self.effect is None) == (open_ticket is None)
        assert all((kind is ConflictError) == (before is not None) for kind, before in self.refusals)
        for kinds in (SubmitRequested, Settled | SubmitRefused):
            keys = [getattr(one, "submit", one).key for one in self.journal if isinstance(one, kinds)]
            assert len(keys) == len(set(keys))
        indices = [one.submit_index for one in self.journal if isinstance(one, SubmitAccepted)]
        assert indices == list(range(len(indices)))
        charged = sum(ticket.n_episodes for ticket in machine.tickets if ticket.accepted)
        # An acceptance may be known from the coordinator's state before its reply arrives.
        assert self.state.remaining_budget <= machine.state.remaining_budget <= BUDGET - charged
        assert open_ticket or machine.state.remaining_budget == BUDGET - charged
        assert machine.closed >= self.ends
        listed = [entry.submit.status for entry in self.journal if isinstance(entry, Rejected)]
        assert (machine.n_rejected, "conflict" in listed) == (len(listed), False)
        named = Counter(self.sent[key].client_key for key in self.accepted)
        assert all(n == 1 for client_key, n in named.items() if client_key is not None)
        noted = [ticket for ticket in machine.tickets if not ended_without_an_entry(ticket)]
        again = TicketMachine(machine.run, dict(enumerate(self.journal)))
        assert [visible(ticket) for ticket in noted if ticket.done] == [
            visible(ticket) for ticket in again.tickets if ticket.done
        ]


def done(ticket: Ticket) -> SubmitDone:
    return SubmitDone(
        status="ok",
        n_episodes=ticket.n_episodes,
        env_instances=ticket.request.submit.env_instances,
        first_global_episode=0,
        remaining_budget=0,
        started_at=0.0,
        completed_at=1.0,
        failure=None,
        n_kept=ticket.n_episodes,
    )


def ended_without_an_entry(ticket: Ticket) -> bool:
    return ticket.error is not None and ticket.error.status in ("closed", "cancelled")


def visible(ticket: Ticket) -> dict[str, Any]:
    """The ticket without the identity of its error, and without what is told of a submit in flight only."""
    values = {name: getattr(ticket, name) for name in ticket.__struct_fields__}
    error = ticket.error
    return values | {"error": None if error is None else (error.status, error.message)}


def play(actions: list[tuple[str, int]], profile: str) -> None:
    """Plays the actions, then a gateway without faults, which ends every submit."""
    world = World(profile)
    for action, n in actions:
        if action == "ask":
            world.ask(n)
        elif action == "state":
            world.heard.append(world.state)
            world.machine.hear(world.heard[n % len(world.heard)])
        else:
            world.perform(action)
        world.check()
    world.start()
    for _ in range(10):
        if world.effect is not None:
            world.perform("ok")
            world.check()
    assert world.effect is None
    assert all(ticket.done for ticket in world.machine.tickets)
    assert len(world.machine.tickets) == len(world.accepted)


ANY = st.lists(st.tuples(st.sampled_from(ACTIONS), st.integers(0, 8)), min_size=10, max_size=60)


@given(ANY, st.sampled_from(("own", "published")))
@settings(deadline=None, max_examples=300)
def test_submits_survive_any_order_of_requests_errors_and_crashes(
    actions: list[tuple[str, int]], profile: str
) -> None:
    play(actions, profile)


BUGS = {
    "a key answers for another body": ("repeated", "ticket.request.body_digest != digest_of(body)", "False"),
    "a key is forgotten": ("repeated", "next(keyed, None)", "None"),
    "two submits at once": ("open_ticket", "self.in_flight is not None", "False"),
    "sent before it is journalled": ("next", "self.in_flight.requested_at is None", "False"),
    "sent after it is accepted": ("next", "self.in_flight.accepted is None", "True"),
    "journalled without its bundle": ("snapshotted", "bundle=snapshot.digest", "bundle=None"),
    "snapshot again after a crash": ("noted", "requested_at = entry, place", "requested_at = entry, None"),
    "nothing charged": ("noted", "budget=remaining", "budget=self.state.remaining_budget"),
    "a refused submit takes an index": ("_end", "self._open.accepted is None", "False"),
    "an accepted submit loses its index": ("_end", "self._open.accepted is None", "True"),
    "a crash not counted": ("noted", "self.deaths.update", "list"),
    "given up too late": ("_after_death", "< MAX_DEATHS", "<= MAX_DEATHS"),
    "an old failure ends the next submit": ("_end", "self._failure = None", "None"),
    "a closed run takes submits": ("close", "self.cancelled = True", "self.cancelled = False"),
    "a state older than the acceptance": ("hear", "state.n_submits < self.state.n_submits", "False"),
    "refused requests counted twice": ("noted", "self.n_rejected += 1", "self.n_rejected += 2"),
    "an end without its summary": ("_settle", "entry.status, place", "entry.status, None"),
}
"""A method, some of its text, and the text in its place."""


@pytest.mark.parametrize(("name", "old", "new"), BUGS.values(), ids=BUGS)
def test_a_bug_in_the_machine_is_found(
    name: str, old: str, new: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = textwrap.dedent(inspect.getsource(getattr(TicketMachine, name)))
    assert source.count(old) == 1
    made: dict[str, Any] = {}
    exec(source.replace(old, new), vars(tickets), made)
    monkeypatch.setattr(TicketMachine, name, made[name])

    @given(ANY, st.sampled_from(("own", "published")))
    @settings(deadline=None, max_examples=1000, derandomize=True, database=None, phases=[Phase.generate])
    def search(actions: list[tuple[str, int]], profile: str) -> None:
        play(actions, profile)

    with pytest.raises((AssertionError, AttributeError, IndexError, KeyError)):
        search()


def test_the_last_played_submit_of_a_spent_run_finalizes_it() -> None:
    world = World("published")
    for n in (0, 1, 0):
        world.ask(n)
        while world.effect is not None:
            world.perform("ok")
    assert [world.machine.finalizes(ticket) for ticket in world.machine.tickets] == [False] * 3
    assert isinstance(world.journal[-1], Settled)
    world.machine.close()
    world.ask(2)
    assert [world.machine.finalizes(ticket) for ticket in world.machine.tickets] == [False, False, True]
