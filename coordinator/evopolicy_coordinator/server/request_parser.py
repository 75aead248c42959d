"""Turns bytes received on a key into an event for the core or a refusal: decodes them and checks every token.

Rules that this module owns:
- A message is served only on the exact key of its kind (a gateway's only under its own run), so that Zenoh's access
  control covers all that is served.
- Tokens are compared in constant time. A wrong capability and an unknown run get the same reply.
- A request that is refused here has changed nothing.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import msgspec
from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_common.catalogue.worlds import OPTION, unchanged
from evopolicy_common.errors import ConfigError, ProtocolError, RefusedError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.environment import Case, Split, StepLimit
from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.run_settings import (
    MAX_EPISODES_PER_SUBMIT,
    PUBLISHED_TRAIN,
    RunSettings,
    episode_counts,
    off_profile,
)
from evopolicy_common.messages.status import StatusRequest
from evopolicy_common.messages.worker import BlobGet, BlobPut, Message
from evopolicy_common.records.blobs import BlobStore, is_digest
from evopolicy_common.records.journal import SALT_BYTES
from evopolicy_common.records.splits import SPLITS, overlaps
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec, keys
from evopolicy_common.wire.credentials import Role
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.events import AnyEvent
from evopolicy_coordinator.core.contract.records import EvaluationRow, RunRow, SubmitRow
from evopolicy_coordinator.core.runs.templates import RANDOM
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.server.definitions import Definitions
from evopolicy_coordinator.server.request_checks import (
    MAX_COUNT,
    MAX_REASON,
    bounded_agent,
    check_begun,
    check_idempotency_key,
    check_inline,
    check_job,
    check_key,
    check_limits,
    check_packages,
    check_place,
    check_registration,
    check_token,
    finite_cursor,
    finite_wait,
)
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.splits import FurtherSplit, SplitSource
from evopolicy_coordinator.storage.state_folder import Identity
from evopolicy_coordinator.storage.store import stored_blobs


class Rights(Protocol):
    """The core's knowledge of access rights."""

    def capability(self, run: str) -> str | None:
        """The token of a run's gateway; None for an unknown run."""


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
        source: SplitSource,
        uploads: Uploads,
        *,
        allowed_imports: tuple[str, ...],
        denied_imports: tuple[str, ...],
        machines: Machines | None = None,
        definitions: Definitions | None = None,
    ) -> None:
        """`machines`: other machines that hold tokens of their own, besides the state folder's; None: no others.
        `definitions`: the accepted environments; None: all."""
        self.definitions = definitions or Definitions()
        self._identity = identity
        self._blobs = blobs
        self._source = source
        self._uploads = uploads
        self._allowed_imports = allowed_imports
        self._denied_imports = denied_imports
        self._machines = machines
        self._prefix = keys.worker_key(identity.cluster, "")[: -len("work/")]

    def parse(self, key: str, payload: bytes, rights: Rights) -> Parsed:
        """Decodes the request in `payload` and checks its key and token.

        Raises RefusedError for a wrong token or key, ProtocolError when the payload is not a message.
        """
        subtree, _, tail = key.removeprefix(self._prefix).partition("/")
        if subtree == "work":
            return self._parse_worker(tail, payload)
        if subtree == "gw":
            return self._parse_gateway(tail, payload, rights)
        if subtree == "ops":
            message = codec.decode(codec.operator_requests, payload)
            self._check_token("operator", self._identity.operator_token, message.token)
            return Parsed("ops", "operator", message)
        raise RefusedError(Refusal.WRONG_KEY, f"no request is served on {key}")

    def _parse_worker(self, tail: str, payload: bytes) -> Parsed:
        message = codec.decode(codec.worker_requests, payload)
        check_key(tail, REQUESTS[type(message)].verb)
        if isinstance(message, worker.Register):
            self._check_token("worker", self._identity.worker_token, message.token)
            check_registration(message)
            check_packages(message, self._allowed_imports)
        else:
            self._check_session(message.token if isinstance(message, BlobPut | BlobGet) else message.session)
        # All other messages name a session, which the core checks.
        name = message.sender if isinstance(message, BlobPut | BlobGet) else message.worker
        return Parsed("work", name, message)

    def _parse_gateway(self, tail: str, payload: bytes, rights: Rights) -> Parsed:
        message = codec.decode(codec.gateway_requests, payload)
        run = message.sender if isinstance(message, BlobPut | BlobGet) else message.run
        check_key(tail, f"{run}/{REQUESTS[type(message)].verb}")
        capability = rights.capability(run)
        check_token(capability if capability is not None else secrets.token_urlsafe(32), message.token)
        return Parsed("gw", run, message)

    def _check_token(self, role: Role, local: str, given: str) -> None:
        """Checks that the token is this machine's for the role, or one of an admitted other machine."""
        if self._machines is None or self._machines.holder(role, given) is None:
            check_token(local, given)

    def _check_session(self, session: str) -> None:
        if self._machines is not None and self._machines.is_shut_out(session):
            raise RefusedError(
                Refusal.REVOKED,
                "the certificate of this machine was revoked or reissued; ask the cluster's operator for a new folder",
            )

    def is_gateways(self, key: str) -> bool:
        """Whether the key is a gateway's: its agent may see the replies."""
        return key.startswith(f"{self._prefix}gw/")

    def is_operators(self, key: str) -> bool:
        """Whether the key is an operator's."""
        return key.startswith(f"{self._prefix}ops/")

    def asks_for_change(self, key: str, payload: bytes) -> bool:
        """Whether the request would create something (a run, a submit, an evaluation). Does not check the token."""
        subtree = key.removeprefix(self._prefix).partition("/")[0]
        decoders: dict[str, Any] = {"gw": codec.gateway_requests, "ops": codec.operator_requests}
        decoder = decoders.get(subtree)
        try:
            return decoder is not None and REQUESTS[type(codec.decode(decoder, payload))].creates
        except ProtocolError:
            return False

    @staticmethod
    def reads_files(message: Message) -> bool:
        """Whether `event` reads splits or blobs for the message."""
        if isinstance(message, worker.ReportResults):
            return any(result.packed is not None for result in message.results)
        row = REQUESTS[type(message)]
        return row.creates and not row.verb

    def event(self, parsed: Parsed, request: int, stimulus_id: str) -> AnyEvent:
        """Returns the event that the request is for the core. Raises RefusedError when it cannot be served.

        Not for blob and status requests. Call it on a thread for messages that `reads_files`.
        """
        message: Any = parsed.message
        row = REQUESTS[type(message)]
        if row.made is not None:
            return row.made(self, message, request, stimulus_id)
        if "cursor" in message.__struct_fields__:
            message = replace(message, cursor=finite_cursor(message.cursor))
        if "wait_s" in message.__struct_fields__:
            message = replace(message, wait_s=finite_wait(message.wait_s))
        checked = message if row.check is None else row.check(self, message)
        return events.Requested(stimulus_id=stimulus_id, request=request, message=checked)

    # Workers.

    def _registered(self, m: worker.Register, request: int, stimulus: str) -> AnyEvent:
        machines = self._machines
        holder = None if machines is None else machines.holder("worker", m.token)
        admitted, refused = self.definitions.admit(m.environments)
        return events.WorkerRegistered(
            stimulus_id=stimulus,
            request=request,
            message=replace(m, environments=admitted),
            refused_environments=refused,
            size=len(msgspec.msgpack.encode(admitted)),
            session=secrets.token_urlsafe(16) if machines is None else machines.session_for(m.token),
            machine="" if holder is None else holder.name,
        )

    def _checked_results(self, m: worker.ReportResults) -> worker.ReportResults:
        results = tuple(map(self._unpacked, m.results))
        for result in results:
            check_begun(result.begun)
            if result.begun is not None and result.begun.inline is None:
                self._check_stored(result.begun)
            for outcome in result.episodes:
                for ref in (outcome.trajectory, outcome.video):
                    check_inline(ref)
                for ref in stored_blobs(outcome):
                    self._check_stored(ref)
        return replace(m, results=results)

    def _unpacked(self, result: worker.JobResult) -> worker.JobResult:
        """Returns the result with its outcomes unpacked when they came as a blob."""
        if result.packed is None:
            return result
        # Checked before they are read: a blob may have a gigabyte.
        if result.packed.size > codec.MAX_PACKED_BYTES:
            raise RefusedError(
                Refusal.BAD_BLOB,
                f"outcomes of {result.packed.size:,} bytes; {codec.MAX_PACKED_BYTES:,} are the limit",
            )
        self._check_stored(result.packed)
        try:
            outcomes = codec.unpack_outcomes(self._blobs.read(result.packed.digest))
        except ProtocolError as error:
            raise RefusedError(Refusal.BAD_BLOB, str(error)) from error
        return replace(result, episodes=outcomes, packed=None)

    def _check_stored(self, ref: BlobRef) -> None:
        if not is_digest(ref.digest) or not self._blobs.has(ref.digest):
            raise RefusedError(
                Refusal.MISSING_BLOB, f"blob {ref.digest[:64]!r} is not stored here; upload it first"
            )
        size = self._blobs.size(ref.digest)
        if size != ref.size:
            raise RefusedError(
                Refusal.BAD_BLOB, f"blob {ref.digest} has {size:,} bytes, and not {ref.size:,} as announced"
            )

    # Gateways.

    def _checked_open(self, m: gateway.OpenRun) -> gateway.OpenRun:
        if not m.reads_rendered:
            raise RefusedError(
                Refusal.WRONG_PROTOCOL,
                "this gateway is of an earlier version, which cannot read what workers report now: install the"
                " coordinator's version of evopolicy on the agent's host",
            )
        return m

    def _checked_permit(self, m: gateway.RequestPermit) -> gateway.RequestPermit:
        check_place(m.boot_id, m.host)
        return m

    def _checked_submit(self, m: gateway.Submit) -> gateway.Submit:
        check_idempotency_key(m.key)
        self._check_bundle(m.bundle, m.run)
        whole = m.rejected is None or bool(m.env_instances)
        if whole and (m.bundle is None) == (m.bundle_error is None):
            raise RefusedError(Refusal.BAD_MESSAGE, "a submit has either a bundle or a bundle_error")
        return m

    def _checked_poll(self, m: gateway.ResultsRequest) -> gateway.ResultsRequest:
        if not 0 <= m.submit_index <= MAX_COUNT:
            raise RefusedError(Refusal.UNKNOWN_SUBMIT, f"this run has no submit {m.submit_index}")
        return m

    def _checked_close(self, m: gateway.CloseRun) -> gateway.CloseRun:
        # Its end's message, in which the reason stands too, must be able to carry it.
        return replace(m, reason=m.reason[:MAX_REASON], agent=bounded_agent(m.agent))

    # Operators.

    def run_created(
        self,
        m: operator.CreateRun,
        request: int,
        stimulus: str,
        parent: tuple[RunRow | None, SubmitRow | None, bool] = (None, None, False),
    ) -> AnyEvent:
        """Builds the event that opens a run. `parent`: the run and submit that it starts from, and whether that run's
        agent has ended."""
        check_idempotency_key(m.key)
        wanted = m.settings
        check_limits(wanted.limits)
        try:
            suite = catalogue.suite_of(wanted.env)
            budget, least, most = episode_counts(wanted, suite)
            self._check_profile(wanted)
            wanted, related = _started(wanted, *parent)
            cases = self._source.splits(
                suite.name,
                wanted.env,
                self._counts(suite, wanted.n_validation, wanted.n_heldout),
                own=m.key if wanted.hidden_cases == "per_run" else "",
            )
        except ConfigError as error:
            raise RefusedError(Refusal.INVALID_SETTINGS, str(error)) from error
        if wanted.profile != "own":
            self._check_published(len(cases.train))
        if wanted.policy_scope == "submit":
            largest = most
            if wanted.hidden_evaluation == "pool":
                largest = max(most, len(cases.validation), len(cases.heldout))
            check_job((*cases.train, *cases.validation, *cases.heldout), largest)
        row = RunRow(
            **_new_secrets(),
            key=m.key,
            secret=secrets.token_bytes(32),
            settings=wanted,
            budget=budget,
            min_episodes_per_submit=least,
            max_episodes_per_submit=most,
            train=cases.train,
            validation=cases.validation,
            heldout=cases.heldout,
            split_hashes=cases.hashes(),
            split_secret=cases.secret,
            epoch=cases.epoch,
            allowed_imports=self._allowed_imports,
            denied_imports=self._denied_imports,
            max_steps=_max_steps(wanted.env, wanted.step_limit),
            related=tuple(
                case for case in related if case not in cases.validation and case not in cases.heldout
            ),
        )
        return events.RunCreated(stimulus_id=stimulus, request=request, message=m, row=row)

    def run_replayed(self, m: operator.CreateRun, request: int, stimulus: str, of: RunRow) -> AnyEvent:
        """Builds the event that opens a replay of the finished run `of`, with its cases and its secret."""
        check_idempotency_key(m.key)
        if not hmac.compare_digest(m.replay_key.encode(), of.key.encode()):
            raise RefusedError(
                Refusal.BAD_REQUEST,
                f"run {of.run} is another operator's, or its .replay.json is lost or changed: only the operator"
                " that opened a run replays it with its cases",
            )
        wanted, known = m.settings, of.settings
        if wanted.start is not None and known.start is not None:
            wanted = replace(wanted, start=replace(wanted.start, parent_scored=known.start.parent_scored))
        same = replace(known, replay_of=of.run, notes=wanted.notes)
        if wanted != same:
            names = [
                each for each in wanted.__struct_fields__ if getattr(wanted, each) != getattr(same, each)
            ]
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"a replay of run {of.run} has other settings than the run: {', '.join(names)}",
            )
        row = replace(of, key=m.key, settings=wanted, committed=None, **_new_secrets())
        return events.RunCreated(stimulus_id=stimulus, request=request, message=m, row=row)

    def evaluation_requested(
        self, m: operator.Evaluate, request: int, stimulus: str, of: RunRow | None = None
    ) -> AnyEvent:
        """Builds the event of an evaluation.

        `of`: the finished run whose episodes are replayed. It supplies the policy seeds, and the cases if they came
        from a secret.
        """
        check_idempotency_key(m.key)
        self._check_bundle(m.bundle)
        check_limits(m.limits)
        try:
            suite = catalogue.suite_of(m.env)
            run = _derived(of)
            cases = (
                self._source.splits(suite.name, m.env, self._counts(suite, None, None)).cases(m.split)
                if run is None
                else {"train": run.train, "validation": run.validation, "heldout": run.heldout}[m.split]
            )
        except ConfigError as error:
            raise RefusedError(Refusal.INVALID_SETTINGS, str(error)) from error
        ids = tuple(range(len(cases))) if m.cases is None else m.cases
        if len(ids) > MAX_EPISODES_PER_SUBMIT:
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"{len(ids):,} cases; {MAX_EPISODES_PER_SUBMIT:,} is the maximum at once",
            )
        self._check_again(m, len(ids))
        wrong = next((case_id for case_id in ids if not 0 <= case_id < len(cases)), None)
        if wrong is not None or not ids:
            raise RefusedError(
                Refusal.INVALID_ENV_INSTANCE,
                f"case {wrong} of {m.env}: the cases are 0 to {len(cases) - 1}"
                if ids
                else "no cases were given",
            )
        row = EvaluationRow(
            evaluation=f"e-{secrets.token_hex(8)}",
            key=m.key,
            env=m.env,
            bundle=m.bundle,
            split=m.split,
            case_ids=ids,
            cases=tuple(cases[case_id] for case_id in ids),
            secret=secrets.token_bytes(32) if of is None else of.secret,
            record=m.record,
            tier=m.sandbox_tier,
            limits=m.limits,
            definition=m.definition,
            replays=m.replays,
            as_in=m.as_in,
            max_steps=_max_steps(m.env, m.step_limit),
        )
        return events.EvaluationRequested(stimulus_id=stimulus, request=request, message=m, row=row)

    def further_cases(
        self, m: operator.FurtherCasesRequest, of: RunRow, revealed: frozenset[str]
    ) -> FurtherSplit:
        """Derives cases for a re-score of the finished run `of`. Raises RefusedError when there are none."""
        if not 1 <= m.n <= MAX_EPISODES_PER_SUBMIT:
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"{m.n:,} cases; 1 to {MAX_EPISODES_PER_SUBMIT:,} are re-scored at once",
            )
        try:
            suite = catalogue.suite_of(of.settings.env)
            cases = self._source.further(
                suite.name, of.settings.env, m.name, m.n, (*of.train, *of.validation, *of.heldout)
            )
        except ConfigError as error:
            raise RefusedError(Refusal.INVALID_SETTINGS, str(error)) from error
        if cases.epoch in revealed:
            raise RefusedError(
                Refusal.BAD_REQUEST,
                f"the cases of epoch {cases.epoch} are public, as runs on them were published: stop the coordinator,"
                " run `evopolicy-coordinator epoch new` with its --state, and start it again, or name other cases with"
                " --data",
            )
        return cases

    def rescore_requested(
        self, m: operator.Rescore, request: int, stimulus: str, of: RunRow, result: operator.RunFinished
    ) -> AnyEvent:
        """Builds the event of a re-score: everything but the cases is as in the finished run `of`."""
        check_idempotency_key(m.key)
        settings, n = of.settings, len(m.cases)
        if not m.indexes or n > MAX_EPISODES_PER_SUBMIT or not set(m.indexes) <= set(range(n)):
            raise RefusedError(
                Refusal.BAD_REQUEST, f"a re-score names positions in its list of cases; here are {n:,} cases"
            )
        if repeated := overlaps(
            {"train": of.train, "validation": of.validation, "heldout": (*of.heldout, *m.cases)}
        ):
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"the new cases are not disjoint from those of run {of.run}: {repeated[0]}",
            )
        worlds = {(case.options or {}).get(OPTION) for case in (*of.train, *m.cases)}
        if unchanged(settings.env) != settings.env and len(worlds) > 1:
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"the new cases are of another world than run {of.run}: give each the run's key in options.{OPTION}",
            )
        submit = next((each for each in result.submits if each.submit_index == m.submit_index), None)
        is_random = m.submit_index == RANDOM
        if not is_random and (submit is None or submit.status != "ok" or submit.bundle is None):
            raise RefusedError(Refusal.UNKNOWN_SUBMIT, f"run {of.run} has no ok submit {m.submit_index}")
        self._check_bundle(None if submit is None else submit.bundle)
        ids = tuple(len(of.heldout) + index for index in range(n))
        place = operator.PlayedAs(
            run=of.run,
            submit_index=m.submit_index,
            env_instances=ids,
            indexes=m.indexes,
            modulo=n if submit is None else len(submit.env_instances),
            remaining_budget_after=0 if submit is None else submit.remaining_budget,
            policy_scope="episode" if is_random else settings.policy_scope,
            observations="arrays" if is_random else settings.observations,
            failed_episodes=settings.failed_episodes,
            hidden_evaluation=settings.hidden_evaluation,
        )
        if place.policy_scope == "submit" and m.indexes != tuple(range(n)):
            raise RefusedError(Refusal.BAD_REQUEST, "with policy scope submit all cases are played at once")
        if place.policy_scope == "submit" and place.hidden_evaluation == "pool":
            check_job(m.cases, n)
        row = EvaluationRow(
            evaluation=f"e-{secrets.token_hex(8)}",
            key=m.key,
            env=settings.env,
            bundle=None if submit is None else submit.bundle,
            split="heldout",
            # They continue the ids of the held-out split, so that no policy seed is used twice.
            case_ids=tuple(ids[index] for index in m.indexes),
            cases=tuple(m.cases[index] for index in m.indexes),
            secret=of.secret,
            record="actions",
            tier=settings.sandbox_tier,
            limits=settings.limits,
            fingerprint_class=m.fingerprint_class or None,
            definition=settings.definition,
            as_in=place,
            max_steps=of.max_steps,
            # Related to all runs that share hidden cases with this one: their agents may be alive.
            related=() if is_random else (*of.validation, *of.heldout),
        )
        return events.EvaluationRequested(stimulus_id=stimulus, request=request, message=m, row=row)

    def _check_profile(self, wanted: RunSettings) -> None:
        """Raises ConfigError when a run of a published profile has other settings, or would not play case files."""
        if wanted.profile == "own":
            return
        if differences := off_profile(wanted):
            raise ConfigError(f"profile {wanted.profile} excludes {differences}")
        if not self._source.from_files:
            raise ConfigError(
                f"profile {wanted.profile} plays the published case files, and this coordinator derives its cases from"
                " a secret: start it with --data FOLDER, the folder data/main-128 of the published software"
            )

    def _check_published(self, n_train: int) -> None:
        if n_train != PUBLISHED_TRAIN:
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"the published train splits have {PUBLISHED_TRAIN:,} cases each, the one in this coordinator's"
                f" --data has {n_train:,}; give it data/main-128 of the published software, or leave out the profile",
            )

    def split_hashes(self, m: operator.DescribeEnvironment, of: RunRow | None = None) -> dict[str, str]:
        """SHA-256 of each split of an environment. Reads files; raises RefusedError when the splits are missing.

        `of`: the finished run in question, whose own hashes are returned when its cases came from a secret.
        """
        if (run := _derived(of)) is not None:
            return run.split_hashes
        try:
            suite = catalogue.suite_of(m.env)
            return self._source.splits(
                suite.name, m.env, self._counts(suite, m.n_validation, m.n_heldout)
            ).hashes()
        except ConfigError as error:
            raise RefusedError(Refusal.INVALID_SETTINGS, str(error)) from error

    def _checked_repin(self, m: operator.RepinRun) -> operator.RepinRun:
        if not m.reason.strip():
            raise RefusedError(Refusal.BAD_MESSAGE, "an override of a run's fingerprint class needs a reason")
        return m

    def _counts(
        self, suite: catalogue.Suite, n_validation: int | None, n_heldout: int | None
    ) -> dict[Split, int]:
        """Number of cases of each split for a run; files supply all of theirs unless the run requests fewer."""
        if min(_or(n_validation, 1), _or(n_heldout, 1)) < 1:
            raise ConfigError("a run needs at least one validation and one held-out case")
        requested: dict[Split, int | None] = {"train": None, "validation": n_validation, "heldout": n_heldout}
        usual: dict[Split, int] = {
            "train": suite.n_train,
            "validation": suite.n_validation,
            "heldout": suite.n_heldout,
        }
        if self._source.from_files:
            return {split: n for split, n in requested.items() if n is not None}
        return {split: _or(requested[split], n) for split, n in usual.items()}

    def _check_again(self, m: operator.Evaluate, n: int) -> None:
        """Checks that a request to replay episodes is consistent, and that its recordings are stored."""
        if m.replays and (m.bundle is not None or len(m.replays) != n):
            raise RefusedError(
                Refusal.BAD_MESSAGE,
                f"{len(m.replays)} recordings for {n} cases; one for each is needed, and no bundle beside them",
            )
        for ref in m.replays:
            self._check_stored(ref)
        place = m.as_in
        if place is None:
            return
        whole = len(place.env_instances)
        fits = len(place.indexes) == n and all(0 <= index < whole for index in place.indexes)
        if not fits or not 1 <= place.modulo <= MAX_COUNT or not -1 <= place.submit_index <= MAX_COUNT:
            raise RefusedError(Refusal.BAD_MESSAGE, f"{n} cases and {whole} in their list do not match")
        if place.policy_scope == "submit" and m.bundle is not None and place.indexes != tuple(range(whole)):
            raise RefusedError(
                Refusal.BAD_MESSAGE, "with policy scope submit only whole submits are played again"
            )

    def _check_bundle(self, digest: str | None, run: str | None = None) -> None:
        """Checks that the bundle is stored and, with `run`, that this run's gateway uploaded it."""
        brought = digest is None or run is None or self._uploads.has_sent(run, digest)
        if digest is not None and not (brought and is_digest(digest) and self._blobs.has(digest)):
            raise RefusedError(
                Refusal.MISSING_BUNDLE, f"bundle {digest[:64]!r} is not stored here; upload it first"
            )


class Request(NamedTuple):
    """How requests of one kind are served. An operator's have no verb: all have the same key."""

    verb: str = ""
    """The last part of its key."""
    check: Callable[[RequestParser, Any], Message] | None = None
    """Returns the message as the event has it. Raises RefusedError."""
    made: Callable[[RequestParser, Any, int, str], AnyEvent] | None = None
    """Builds the event, where the shell adds ids, secrets or cases."""
    creates: bool = False
    """Whether it would create something: a run, a submit, an evaluation. An operator's is built from files."""


REQUESTS: dict[type[Message], Request] = {
    worker.Register: Request("register", made=RequestParser._registered),
    worker.LeaseRequest: Request("lease"),
    worker.Heartbeat: Request("beat"),
    worker.ReportResults: Request("done", RequestParser._checked_results),
    BlobPut: Request("blob"),
    BlobGet: Request("blob"),
    gateway.OpenRun: Request("open", RequestParser._checked_open),
    gateway.RequestPermit: Request("permit", RequestParser._checked_permit),
    gateway.StateRequest: Request("state"),
    gateway.Submit: Request("submit", RequestParser._checked_submit, creates=True),
    gateway.ResultsRequest: Request("results", RequestParser._checked_poll),
    gateway.CloseRun: Request("close", RequestParser._checked_close),
    operator.CreateRun: Request(made=RequestParser.run_created, creates=True),
    operator.Evaluate: Request(made=RequestParser.evaluation_requested, creates=True),
    operator.Rescore: Request(creates=True),
    operator.Disclose: Request(creates=True),
    operator.WaitRun: Request(),
    operator.EvaluationPoll: Request(),
    operator.CancelRun: Request(),
    operator.AgentGone: Request(),
    operator.RepinRun: Request(check=RequestParser._checked_repin),
    operator.SetWorker: Request(),
    # The service answers these itself; they never become events.
    operator.Claim: Request(),
    StatusRequest: Request(),
    operator.RecordedRequest: Request(),
    operator.JournalRequest: Request(),
    operator.OpeningRequest: Request(),
    operator.SignRequest: Request(),
    operator.DescribeEnvironment: Request(),
    operator.FurtherCasesRequest: Request(),
    operator.EnvironmentsRequest: Request(),
    operator.ApproveEnvironment: Request(),
}
"""All kinds of requests."""


def _derived(run: RunRow | None) -> RunRow | None:
    """Returns the run if its cases came from a secret; its coordinator may have another one now (see
    `splits.secret_of`)."""
    return run if run is not None and run.split_hashes.keys() == set(SPLITS) else None


def _new_secrets() -> dict[str, Any]:
    """The name and the secrets that every run has of its own, a replay too."""
    return {
        "run": f"r-{secrets.token_hex(8)}",
        "capability": secrets.token_urlsafe(32),
        "salt": secrets.token_bytes(SALT_BYTES),
    }


def _started(
    wanted: RunSettings, parent: RunRow | None, submit: SubmitRow | None, ended: bool
) -> tuple[RunSettings, tuple[Case, ...]]:
    """The settings of a run with its start as the coordinator knows it, and the hidden cases of the runs before it.

    Raises ConfigError for a start that is not as its gateway recorded it."""
    start = wanted.start
    if start is None:
        return wanted, ()
    where = f"start from submit {start.submit_index} of run {start.run}"
    if parent is None or submit is None:
        raise ConfigError(f"{where}: this coordinator has no such submit; name a run that it has played")
    if not submit.tree or submit.tree != start.tree:
        raise ConfigError(
            f"{where}: tree {start.tree or 'none'} is not the one recorded at the submit, {submit.tree or 'none'}:"
            " restore the run's folder, or name another submit"
        )
    if parent.settings.env != wanted.env:
        raise ConfigError(
            f"{where}: it is a run on {parent.settings.env}, not {wanted.env}; name its environment"
        )
    before = parent.settings.start
    scored = ended or (before is not None and before.parent_scored)
    return (
        replace(wanted, start=replace(start, parent_scored=scored)),
        (*parent.validation, *parent.heldout, *parent.related),
    )


def _or(value: int | None, otherwise: int) -> int:
    return otherwise if value is None else value


def _max_steps(env: str, step_limit: StepLimit) -> int:
    """Steps after which an episode is truncated; 0: only the environment ends it."""
    return (catalogue.entry(env).published_steps or 0) if step_limit == "published" else 0
