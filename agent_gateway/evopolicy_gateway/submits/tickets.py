"""The submits of one run as a pure machine: outcomes in, next effect out. No clock, disk, network or await.

    machine = TicketMachine(run, entries)                # the journal's: the state that the last gateway left
    ticket = machine.open_ticket(body, client_key, key)  # raises RequestError
    effect = machine.next()                              # for the ticket in flight: a new one, or the last gateway's

The pipeline performs one effect at a time and passes its outcome to the method that returns the next effect:

| ticket        | effect         | outcome                                                                           |
|---------------|----------------|-----------------------------------------------------------------------------------|
| is new        | `TakeSnapshot` | `snapshotted`: `Note` of the entry `SubmitRequested`                              |
| is journalled | `Send`         | `sent`: `Note` of `SubmitAccepted`; `refused`: `Note` of `SubmitRefused`, its end |
| is accepted   | `Collect`      | `collected`: `Note` of `Settled`, its end                                         |
| has an entry  | `Note`         | `noted`: the effect that its next state needs                                     |
| met an error  | `Note`, `Died` | `noted`: `Stop`, which ends the process. If that happens to the next gateway      |
|               |                | too: `Note` of `SubmitRefused`, its end                                           |

State that survives the process changes in `noted` alone, when its entry is durable.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, cast, get_args

import msgspec

from evopolicy_common.errors import RefusedError, RequestError
from evopolicy_common.messages import gateway as messages
from evopolicy_common.messages.gateway import CANCELLED, RunOpened, RunState, SubmitAccepted
from evopolicy_common.records import open_run
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.open_run import AnyLine, SubmitRequested
from evopolicy_common.records.run_record import RejectedStatus, RejectedSubmit
from evopolicy_common.records.summary import utc_text
from evopolicy_common.refusals import RUN_OVER, WRONG_REQUEST, Refusal
from evopolicy_gateway.run_folder.layout import submit_id
from evopolicy_gateway.submits.snapshots import SystemSnapshot
from evopolicy_gateway.submits.submit_request import Bounds, parse

MAX_REJECTED_KEPT = 1000
RUN_CLOSED = "run_closed"
"""The published protocol's status for a submit after the last possible one."""
MAX_DEATHS = 2
"""Number of gateway crashes over one submit, or over one episode's files, after which it is abandoned."""


class ConflictError(RequestError):
    """The request contradicts an earlier one: another submit runs, or the key belongs to another body."""

    def __init__(self, index: int, message: str) -> None:
        super().__init__("conflict", message)
        self.index = index
        """Index of the earlier submit."""


class Ticket(msgspec.Struct, kw_only=True, eq=False):
    """The state of a submit that passed the checks."""

    request: SubmitRequested
    requested_at: int | None = None
    """Offset of the journal's entry with `request` and its snapshot; None before it is there."""
    index: int
    """Known before it is accepted, because this gateway is the run's only submitter."""
    submit_id: str
    """Its folder's name."""
    n_episodes: int
    n_done: int = 0
    """Episodes whose feedback is written."""
    waits_for: str = ""
    held_s: float = 0.0
    """Seconds in which none of its episodes ran because hidden episodes used the machines."""
    accepted: SubmitAccepted | None = None
    place: int | None = None
    """Offset of the journal's entry with its summary; None before its feedback is committed."""
    status: str | None = None
    mean_return: float | None = None
    """As in its summary, as the next two; None before it is settled, and for a mean that is not finite."""
    policy_failures: int | None = None
    warning: str | None = None
    error: RequestError | None = None
    """The reason for its failure or refusal."""

    @property
    def done(self) -> bool:
        """Whether its summary or `error` is available."""
        return self.place is not None or self.error is not None

    @property
    def decided(self) -> bool:
        """Whether it is accepted, or certainly will not be."""
        return self.accepted is not None or self.done


class TakeSnapshot(msgspec.Struct, frozen=True):
    """Take a snapshot of `system/`."""


class Send(msgspec.Struct, frozen=True):
    """Send the submit to the coordinator."""


class Collect(msgspec.Struct, frozen=True):
    """Write its feedback, page by page."""


class Note(msgspec.Struct, frozen=True):
    """Append an entry to the journal."""

    entry: AnyLine


class Stop(msgspec.Struct, frozen=True):
    """End the process with this error."""

    error: Exception


Effect = TakeSnapshot | Send | Collect | Note | Stop


class TicketMachine:
    """All submits of one run, of which at most one is in flight."""

    def __init__(self, run: RunOpened, entries: Mapping[int, AnyLine] | None = None) -> None:
        """`entries`: as in `Journal`."""
        self.run = run
        self.state: RunState = run.state
        """The state known to this gateway; `hear` updates it."""
        self.closed = run.state.is_finalized
        self.cancelled = run.state.cancelled
        """The operator has cancelled the run."""
        self.in_flight: Ticket | None = None
        self.tickets: list[Ticket] = []
        """Accepted submits by index, followed by at most one that is not accepted yet."""
        self.n_settled = 0
        """Submits with a verdict."""
        self.n_rejected = 0
        self.in_flight_s = 0.0
        """Seconds in which a submit was in flight, in this process."""
        self.feedback_s = 0.0
        """Of `in_flight_s`, seconds from the last result's arrival to the committed feedback."""
        self.held_s = run.state.held_s
        """Seconds for which submits of the run waited because hidden episodes used the machines."""
        self.deaths: Counter[tuple[str, int | None]] = Counter()
        """Number of gateways that died over an episode of a submit, or (None) over the submit as a whole."""
        self._failure: Exception | None = None
        """The unexpected error of the ticket in flight."""
        for place, entry in (entries or {}).items():
            self.noted(entry, place)
        # `run.state` is newer than the entries, except for an open submit's acceptance, and on an earlier backup.
        if len(self.accepted) <= run.state.n_submits and all(each.done for each in self.accepted):
            self.state = run.state

    @property
    def accepted(self) -> list[Ticket]:
        """Submits that a coordinator has accepted, by index."""
        return [each for each in self.tickets if each.accepted is not None]

    @property
    def spent(self) -> bool:
        """Whether no further submit is possible, and none runs."""
        too_little = self.state.remaining_budget < max(1, self.run.min_episodes_per_submit)
        return self.in_flight is None and (too_little or self.closed)

    @property
    def last_warning(self) -> str | None:
        """The warning of the last answered submit about its policy; None when the policy did not fail."""
        answered = (ticket.warning for ticket in reversed(self.tickets) if ticket.status is not None)
        return next(answered, None)

    def finalizes(self, ticket: Ticket) -> bool:
        """Whether the run is spent, and `ticket` is the last that played."""
        return self.spent and ticket is self.tickets[-1]

    def find(self, name: str) -> Ticket | None:
        """Returns the submit with that index or folder name; None when there is none."""
        return next((each for each in self.tickets if name in (str(each.index), each.submit_id)), None)

    # Requests.

    def repeated(self, body: bytes, client_key: str | None) -> Ticket | None:
        """The ticket that a request repeats. Raises ConflictError when its key belongs to another body."""
        keyed = (each for each in self.tickets if each.request.client_key == client_key is not None)
        ticket = next(keyed, None)
        if ticket is not None and ticket.request.body_digest != digest_of(body):
            why = f"this Idempotency-Key was used for {ticket.submit_id} with another body; use a new key"
            raise ConflictError(ticket.index, why)
        return ticket

    def open_ticket(self, body: bytes, client_key: str | None, key: str) -> Ticket:
        """Puts a request in flight under the new `key`. Raises RequestError: refused, nothing is charged."""
        if self.in_flight is not None:
            index, name = self.in_flight.index, self.in_flight.submit_id
            raise ConflictError(index, f"{name} is running; wait for it, or ask GET /submit/{index}")
        if self.spent:
            raise self._refusal()
        run = self.run
        bounds = Bounds(
            n_env_instances=run.n_env_instances,
            min_episodes=run.min_episodes_per_submit,
            max_episodes=run.max_episodes_per_submit,
            remaining_budget=self.state.remaining_budget,
        )
        return self._begin(
            SubmitRequested(
                submit=messages.Submit(key=key, env_instances=parse(body, bounds), bundle=None),
                client_key=client_key,
                body_digest=digest_of(body),
            )
        )

    def _begin(self, request: SubmitRequested) -> Ticket:
        index, n = len(self.tickets), len(request.submit.env_instances)
        name = submit_id(index, self.run.episode_budget)
        self.in_flight = Ticket(request=request, index=index, submit_id=name, n_episodes=n)
        self.tickets.append(self.in_flight)
        return self.in_flight

    def reject(self, error: RequestError, now: float) -> open_run.Rejected | None:
        """Counts a refused request that `run.json` lists; returns its entry, up to a maximum number. `now`: Unix time,
        seconds."""
        if error.status not in get_args(RejectedStatus):
            return None
        self.n_rejected += 1
        if self.n_rejected > MAX_REJECTED_KEPT:
            return None
        status, n = cast(RejectedStatus, error.status), self.state.n_submits
        one = RejectedSubmit(status=status, message=error.message, at=utc_text(now), after_submits=n)
        return open_run.Rejected(submit=one)

    # Effects, and their outcomes.

    @property
    def _open(self) -> Ticket:
        assert self.in_flight is not None
        return self.in_flight

    def next(self) -> Effect | None:
        """The effect that the ticket in flight needs in its state; None without one."""
        if self.in_flight is None:
            return None
        if self.in_flight.requested_at is None:
            return TakeSnapshot()
        return Send() if self.in_flight.accepted is None else Collect()

    def snapshotted(self, snapshot: SystemSnapshot) -> Note:
        request = self._open.request
        why, tree = snapshot.error, snapshot.tree
        submit = msgspec.structs.replace(request.submit, bundle=snapshot.digest, bundle_error=why, tree=tree)
        return Note(msgspec.structs.replace(request, submit=submit, kept=snapshot.kept))

    def sent(self, reply: SubmitAccepted) -> Note:
        return Note(reply)

    def paged(self, page: messages.ResultsPage, n_done: int, held_before: float) -> None:
        """A page is written, `n_done` episodes in all. `held_before`: `held_s` before the first page."""
        ticket, self.held_s = self._open, max(self.held_s, page.held_s)
        ticket.n_done, ticket.waits_for, ticket.held_s = n_done, page.waits_for, self.held_s - held_before

    def collected(self, done: messages.SubmitDone, summary: bytes) -> Note:
        if done.status == CANCELLED:
            self.state = msgspec.structs.replace(self.state, remaining_budget=done.remaining_budget)
            self.close(cancelled=True)
        settled = open_run.Settled(
            key=self._open.request.submit.key, status=done.status, summary=summary.decode()
        )
        return Note(settled)

    def refused(self, error: RefusedError) -> Effect | None:
        """The coordinator refused the submit, or to give its results."""
        request, over = self._open.request, error.status in RUN_OVER
        if over:
            self.close(cancelled=error.status == Refusal.RUN_CANCELLED)
        if self._open.accepted is None and (over or error.status in WRONG_REQUEST):
            return Note(
                open_run.SubmitRefused(key=request.submit.key, status=error.status, message=error.message)
            )
        if not over:
            return self.failed(error)
        # Without an entry: if the coordinator opens the run once more, the next gateway collects the results.
        self._end(self._refusal("closed"))
        return None

    def failed(self, error: Exception) -> Effect:
        if self._failure is not None:
            return Stop(error)
        self._failure = error
        return Note(open_run.Died(key=self._open.request.submit.key))

    def noted(self, entry: AnyLine, place: int) -> Effect | None:
        """The entry is durable at that offset of the journal; returns the next effect."""
        match entry:
            case SubmitRequested():
                ticket = self.in_flight or self._begin(entry)
                ticket.request, ticket.requested_at = entry, place
            case SubmitAccepted():
                ticket = self._open
                ticket.accepted, ticket.index = entry, entry.submit_index
                ticket.submit_id = submit_id(ticket.index, self.run.episode_budget)
                remaining, n, over = entry.remaining_budget, entry.submit_index + 1, self.state.is_finalized
                self.state = RunState(remaining_budget=remaining, n_submits=n, is_finalized=over)
            case open_run.Settled():
                self._settle(self._open, entry, place)
            case open_run.SubmitRefused():
                over = entry.status in RUN_OVER
                self._end(self._refusal() if over else RequestError(entry.status, entry.message))
            case open_run.Died():
                self.deaths.update((entry.key, index) for index in entry.episodes or (None,))
                if self._failure is not None:
                    return self._after_death(self._open, self._failure)
            case open_run.Rejected():
                self.n_rejected += 1
        return self.next()

    def _settle(self, ticket: Ticket, entry: open_run.Settled, place: int) -> None:
        summary = msgspec.json.decode(entry.summary, type=dict[str, Any])
        mean = summary["mean_return"]
        ticket.mean_return = mean if isinstance(mean, float) else None
        ticket.policy_failures, ticket.warning = summary.get("policy_failures"), summary.get("warning")
        ticket.status, ticket.place, ticket.waits_for = entry.status, place, ""
        ticket.n_done = ticket.n_episodes
        self.n_settled += 1
        # To save memory: a run has thousands of episodes.
        submit = msgspec.structs.replace(ticket.request.submit, env_instances=())
        ticket.request = msgspec.structs.replace(ticket.request, submit=submit)
        self._end(None)

    def _after_death(self, ticket: Ticket, failure: Exception) -> Effect:
        if self.deaths[ticket.request.submit.key, None] < MAX_DEATHS:
            return Stop(failure)
        charged = "it was not accepted" if ticket.accepted is None else "its episodes are charged and count"
        text = f"the gateway failed {MAX_DEATHS} times on this submit and gives it no feedback; {charged}"
        return Note(
            open_run.SubmitRefused(key=ticket.request.submit.key, status="gateway_failed", message=text)
        )

    def _end(self, error: RequestError | None) -> None:
        """Ends the ticket in flight. Without acceptance it takes no index."""
        self._open.error = error
        if self._open.accepted is None:
            self.tickets.pop()
        self.in_flight = self._failure = None

    # The run's state.

    def hear(self, state: RunState) -> bool:
        """The coordinator's state of the run. Returns whether it closes the run, which is news."""
        # While a submit is being sent, this may be older than its acceptance.
        if state.n_submits < self.state.n_submits:
            return False
        self.state = state
        self.held_s = max(self.held_s, state.held_s)
        return state.is_finalized and self.close(cancelled=state.cancelled)

    def close(self, *, cancelled: bool = False) -> bool:
        """Takes no more submits; `cancelled`: by the operator. Returns whether that is news."""
        before = self.closed, self.cancelled
        self.closed, self.cancelled = True, self.cancelled or cancelled
        return before != (self.closed, self.cancelled)

    def _refusal(self, status: str = RUN_CLOSED) -> RequestError:
        """The refusal of a submit to a closed or spent run."""
        if self.cancelled:
            return RequestError(CANCELLED, "the operator cancelled the run: no more submits are taken")
        why = "the run is closed" if self.closed else "the episode budget is spent"
        return RequestError(status, f"{why}: no more submits are taken")
