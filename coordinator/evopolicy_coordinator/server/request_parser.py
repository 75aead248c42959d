"""Turns bytes received on a key into an event for the core or a refusal: decodes them and checks every token.

Rules that this module owns:
- A message is served only on the exact key of its kind (a gateway's only under its own run), so that Zenoh's access
  control covers all that is served.
- Tokens are compared in constant time. A wrong capability and an unknown run get the same reply.
- A request that is refused here has changed nothing.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import msgspec
from msgspec.structs import replace

from evopolicy_common.errors import ProtocolError, RefusedError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.worker import BlobGet, BlobPut, Message
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec, keys
from evopolicy_common.wire.credentials import Role
from evopolicy_coordinator.core.contract.events import AnyEvent, Requested, WorkerRegistered
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.server import request_checks as checks
from evopolicy_coordinator.server.definitions import Definitions
from evopolicy_coordinator.server.request_checks import require
from evopolicy_coordinator.server.run_requests import RunRequests
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.storage.state_folder import Identity
from evopolicy_coordinator.storage.store import stored_blobs

_DECODERS: dict[str, Any] = {
    "work": codec.worker_requests,
    "gw": codec.gateway_requests,
    "ops": codec.operator_requests,
}
"""By the first part of a key after the cluster's name."""

_NO_REASON = "an override of a run's fingerprint class needs a reason"


class Parsed(msgspec.Struct, frozen=True):
    """A request whose sender is authenticated and allowed to make it."""

    subtree: str
    """Of its key: `work`, `gw`, `ops`."""
    asker: str
    """The worker's or the run's name, or `operator`."""
    message: Any
    """A `Message` of a kind in `REQUESTS`."""


class RequestParser:
    """Parses requests. `REQUESTS` has a row for each kind. The accepted definitions change through it, nothing else."""

    def __init__(
        self,
        identity: Identity,
        blobs: BlobStore,
        uploads: Uploads,
        runs: RunRequests,
        machines: Machines,
        definitions: Definitions,
    ) -> None:
        """`machines`: other machines that hold tokens of their own, besides the state folder's. `definitions`:
        the accepted environments."""
        self.definitions = definitions
        self.runs = runs
        self._identity = identity
        self._blobs = blobs
        self._uploads = uploads
        self._machines = machines
        self._prefix = keys.worker_key(identity.cluster, "")[: -len("work/")]

    def parse(self, key: str, payload: bytes, capability: Callable[[str], str | None]) -> Parsed:
        """Decodes the request in `payload` and checks its key and token. `capability` returns the token of a
        run's gateway, None for an unknown run.

        Raises RefusedError for a wrong token or key, ProtocolError when the payload is not a message.
        """
        subtree, _, tail = key.removeprefix(self._prefix).partition("/")
        if subtree not in _DECODERS:
            raise RefusedError(Refusal.WRONG_KEY, f"no request is served on {key}")
        message = codec.decode(_DECODERS[subtree], payload)
        is_blob = isinstance(message, BlobPut | BlobGet)
        if subtree == "ops":
            self._check_token("operator", self._identity.operator_token, message.token)
            return Parsed(subtree, "operator", message)
        asker = message.sender if is_blob else message.run if subtree == "gw" else message.worker
        verb = REQUESTS[type(message)].verb
        expected = f"{asker}/{verb}" if subtree == "gw" else verb
        text = f"this message belongs on {expected!r}, not on {tail!r}"
        require(tail == expected, Refusal.WRONG_KEY, text)
        if subtree == "gw":
            checks.check_token(capability(asker) or secrets.token_urlsafe(32), message.token)
        elif isinstance(message, worker.Register):
            self._check_token("worker", self._identity.worker_token, message.token)
            checks.check_registration(message)
            checks.check_packages(message, self.runs.allowed_imports)
        elif self._machines.is_shut_out(message.token if is_blob else message.session):
            # The core checks whether it knows the session.
            raise RefusedError(
                Refusal.REVOKED,
                "the certificate of this machine was revoked or reissued; ask the cluster's operator for a"
                " new folder",
            )
        return Parsed(subtree, asker, message)

    def _check_token(self, role: Role, local: str, given: str) -> None:
        """Checks that the token is this machine's for the role, or one of an admitted other machine."""
        if self._machines.holder(role, given) is None:
            checks.check_token(local, given)

    def subtree(self, key: str) -> str:
        """Part of the key that tells whose it is: `work`, `gw` (its agent may see the replies), `ops`."""
        return key.removeprefix(self._prefix).partition("/")[0]

    def asks_for_change(self, key: str, payload: bytes) -> bool:
        """Whether the request would create something (a run, a submit, an evaluation). Does not check the token."""
        decoder = _DECODERS.get(self.subtree(key))
        try:
            return decoder is not None and REQUESTS[type(codec.decode(decoder, payload))].creates
        except ProtocolError:
            return False

    def reads_files(self, message: Message) -> bool:
        """Whether `event` reads splits, blobs or the store for the message."""
        if isinstance(message, worker.ReportResults):
            return self._blobs.remote or any(result.packed is not None for result in message.results)
        if isinstance(message, gateway.Submit):
            return self._blobs.remote
        return _opens(message)

    def event(self, parsed: Parsed, request: int, stimulus_id: str) -> AnyEvent:
        """Returns the event that the request is for the core. Raises RefusedError when it cannot be served.

        Not for blob and status requests. Call it on a thread for messages that `reads_files`.
        """
        message: Any = parsed.message
        if _opens(message):
            return self.runs.event(message, request, stimulus_id)
        if isinstance(message, worker.Register):
            return self._registered(message, request, stimulus_id)
        row = REQUESTS[type(message)]
        if row.waits:
            message = replace(message, wait_s=checks.finite_wait(message.wait_s))
        changed = None if row.check is None else row.check(self, message)
        return Requested(stimulus_id=stimulus_id, request=request, message=changed or message)

    def _registered(self, m: worker.Register, request: int, stimulus: str) -> AnyEvent:
        holder = self._machines.holder("worker", m.token)
        admitted, refused = self.definitions.admit(m.environments)
        return WorkerRegistered(
            stimulus_id=stimulus,
            request=request,
            message=replace(m, environments=admitted),
            refused_environments=refused,
            size=len(msgspec.msgpack.encode(admitted)),
            session=self._machines.session_for(m.token),
            machine="" if holder is None else holder.name,
        )

    def _checked_results(self, m: worker.ReportResults) -> worker.ReportResults:
        results = tuple(map(self._unpacked, m.results))
        for result in results:
            if result.begun is not None:
                checks.check_begun(self._blobs, result.begun)
            for outcome in result.episodes:
                for ref in (outcome.trajectory, outcome.video):
                    checks.check_inline(ref)
                for ref in stored_blobs(outcome):
                    checks.check_stored(self._blobs, ref)
        return replace(m, results=results)

    def _unpacked(self, result: worker.JobResult) -> worker.JobResult:
        if result.packed is None:
            return result
        # Checked before they are read: a blob may have a gigabyte.
        size, most = result.packed.size, codec.MAX_PACKED_BYTES
        require(size <= most, Refusal.BAD_BLOB, f"outcomes of {size:,} bytes; {most:,} are the limit")
        checks.check_stored(self._blobs, result.packed)
        try:
            outcomes = codec.unpack_outcomes(self._blobs.read_blob(result.packed.digest))
        except ProtocolError as error:
            raise RefusedError(Refusal.BAD_BLOB, str(error)) from error
        return replace(result, episodes=outcomes, packed=None)

    def _check_submit(self, m: gateway.Submit) -> None:
        checks.check_idempotency_key(m.key)
        sent = m.bundle is None or self._uploads.has_sent(m.run, m.bundle)
        checks.check_bundle(self._blobs, m.bundle, sent=sent)
        one = (m.bundle is None) != (m.bundle_error is None)
        require(one, Refusal.BAD_MESSAGE, "a submit has either a bundle or a bundle_error")

    def _check_poll(self, m: gateway.ResultsRequest) -> gateway.ResultsRequest:
        index = m.submit_index
        require(0 <= index <= checks.MAX_COUNT, Refusal.UNKNOWN_SUBMIT, f"this run has no submit {index}")
        return replace(m, cursor=checks.finite_cursor(m.cursor))


class RequestKind(NamedTuple):
    """How requests of one kind are served. An operator's have no verb: all have the same key."""

    verb: str = ""
    """The last part of its key."""
    check: Callable[[RequestParser, Any], Message | None] | None = None
    """Returns the message as the event has it, None if it stays as it is. Raises RefusedError."""
    creates: bool = False
    """Whether it would create something: a run, a submit, an evaluation."""
    waits: bool = False
    """Whether it has `wait_s`, which is bounded."""


REQUESTS: dict[type[Message], RequestKind] = {
    **dict.fromkeys(get_args(operator.OperatorRequest), RequestKind()),
    worker.Register: RequestKind("register"),
    worker.LeaseRequest: RequestKind("lease", waits=True),
    worker.Heartbeat: RequestKind("beat", waits=True),
    worker.ReportResults: RequestKind("done", RequestParser._checked_results),
    BlobPut: RequestKind("blob"),
    BlobGet: RequestKind("blob"),
    gateway.OpenRun: RequestKind("open"),
    gateway.RequestPermit: RequestKind(
        "permit", lambda _, m: checks.check_place(m.boot_id, m.host), waits=True
    ),
    gateway.StateRequest: RequestKind("state"),
    gateway.Submit: RequestKind("submit", RequestParser._check_submit, creates=True),
    gateway.ResultsRequest: RequestKind("results", RequestParser._check_poll, waits=True),
    gateway.CloseRun: RequestKind("close", lambda _, m: checks.bounded_close(m)),
    operator.CreateRun: RequestKind(creates=True),
    operator.Evaluate: RequestKind(creates=True),
    operator.Rescore: RequestKind(creates=True),
    operator.Disclose: RequestKind(creates=True),
    operator.WaitRun: RequestKind(waits=True),
    operator.EvaluationPoll: RequestKind(
        check=lambda _, m: replace(m, cursor=checks.finite_cursor(m.cursor)), waits=True
    ),
    operator.RepinRun: RequestKind(
        check=lambda _, m: require(bool(m.reason.strip()), Refusal.BAD_MESSAGE, _NO_REASON)
    ),
}


def _opens(message: Message) -> bool:
    """Whether `RunRequests` builds the event: an operator's request that creates something."""
    row = REQUESTS[type(message)]
    return row.creates and not row.verb
