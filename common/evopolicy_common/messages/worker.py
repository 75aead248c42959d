"""Messages between workers, which send requests, and the coordinator, which replies."""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec
from msgspec.structs import replace

from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Text, Word
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, Tier
from evopolicy_common.refusals import Refusal

DEFINITION_DIGITS = 16
"""Leading hex digits of a definition's digest that fingerprints and command lines use."""


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="op"):
    """A message on the wire; `op` names its type."""


class Refused(Message, frozen=True, kw_only=True, tag="refused"):
    """The request was understood but refused; it changed nothing."""

    status: Refusal
    message: Text


class Fingerprint(msgspec.Struct, frozen=True, kw_only=True):
    """Everything besides the seed that decides results, of a worker or of one environment (`of`)."""

    code_version: Word
    """Version and source digest of the worker's own code."""
    python: Word
    packages: Named[Text]
    """Name to exact version of the distributions that environments are made of."""
    cpu: Text
    """CPU model and the features by which numerical libraries choose their code."""
    adapter: Word = ""
    """`EnvironmentDescription.adapter`; empty in the fingerprint of a whole worker."""
    definition: Word = ""
    """The first digits of `EnvironmentDescription.digest()`."""

    def of(self, description: EnvironmentDescription) -> Fingerprint:
        """The fingerprint of one environment; the whole worker's where the worker does not distinguish environments."""
        if not description.adapter:
            return self
        return replace(
            self,
            packages=description.packages,
            adapter=description.adapter,
            definition=description.digest()[:DEFINITION_DIGITS],
        )

    def class_name(self, *, cpu: bool) -> str:
        """12 hex digits, equal for workers whose results may stand in one run; with `cpu`, by the CPU's
        features too. The worker's code changes an environment's class only if it is in the adapter's."""
        code = [self.adapter, self.definition] if self.adapter else [self.code_version]
        parts = [*code, self.python, sorted(self.packages.items())]
        if cpu:
            parts.append(self.cpu)
        return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()[:12]

    def versions(self) -> dict[str, str]:
        """The components of the class, by name."""
        code = {"adapter": self.adapter, "definition": self.definition} if self.adapter else {}
        return {"evopolicy-worker": self.code_version, **code, "python": self.python, **self.packages}

    def flat(self) -> dict[str, str]:
        """The form that `run.json` uses."""
        return {**self.versions(), "cpu": self.cpu}


REASON_CHARACTERS = {"tier": 500, "environment": 2000, "environments": 60_000, "result": 2000}
"""Most characters of a worker's reasons: of a tier, of an environment, of all environments, of a job."""


class Register(Message, frozen=True, kw_only=True, tag="register"):
    """A worker's first request; repeated whenever the coordinator does not know its session."""

    worker: Word
    """The worker's name, unique in the cluster, such as `host-3f2a`."""
    token: Word
    """The cluster's join token."""
    protocol: Int
    """Wire protocol version; see `codec.WIRE_VERSION`."""
    slots: Int
    tiers: Many[Tier]
    environments: Many[EnvironmentDescription]
    fingerprint: Fingerprint
    host: Word = ""
    boot_id: Word = ""
    """Boot id of the worker's kernel (`proc.boot_id`); without it a worker plays no hidden episodes."""
    undescribed: Many[Word] = ()
    """Ids of shipped environments that it offers, too, and describes once a reply to a heartbeat asks for them."""
    installation: Word = ""
    """The worker's Python installation (`installs.own`)."""
    missing_tiers: Named[Text] = {}
    """Sandbox tiers that should work there and do not, with the reasons."""
    failed_environments: Named[Text] = {}
    """Environments that it should offer and that could not be described or failed their try-out, with the reasons."""


class Registered(Message, frozen=True, kw_only=True, tag="registered"):
    """The worker is registered and may request leases."""

    session: Word
    """Sent with every later request; valid until the coordinator's or the worker's process ends."""
    lease_ttl_s: Number
    """A lease without a heartbeat for this many seconds expires."""
    heartbeat_s: Number
    refused: Named[Text] = {}
    """Run id to the reason why this worker gets no work of that run, such as versions that differ from the run's."""
    hidden_bar: Text = ""
    """Why this worker gets no hidden work of any run; empty when it gets some."""
    refused_environments: Named[Text] = {}
    """Environment to the reason why its announcement is ignored."""


class LeaseRequest(Message, frozen=True, kw_only=True, tag="lease"):
    """A long poll for work: answered as soon as there is some, or with no leases after `wait_s`."""

    worker: Word
    session: Word
    n: Int
    """How many leases the worker can take; 0 withdraws the open poll, which is then answered at once with none."""
    wait_s: Number
    warm_bundles: Many[Text] = ()
    warm_environments: Many[Text] = ()
    serial: Int = 0
    """The worker's number of this poll; increases, also across restarts. 0: it does not number its polls."""


class Lease(msgspec.Struct, frozen=True, kw_only=True):
    """A temporary right to play one job and report its result."""

    lease_id: Word
    attempt: Int
    """Counts from 1 per job; rejects results of abandoned attempts."""
    stimulus_id: Word
    """Identifies the event that created the job, in every log line about it."""
    job: Job
    stop_in_silence: bool = False
    """Stop and return it when no heartbeat was answered for `lease_ttl_s`: an agent may be admitted to this kernel."""


class Leases(Message, frozen=True, kw_only=True, tag="leases"):
    """The reply to a poll; empty when no work came within `wait_s`."""

    leases: Many[Lease]
    cancelled: Many[Text] = ()
    """Leases to stop at once. Listed here because the poll was open anyway; heartbeat replies list them too."""


class HeldLease(msgspec.Struct, frozen=True, kw_only=True):
    """One lease that the worker holds, as its heartbeat reports it."""

    lease_id: Word
    job_id: Word
    attempt: Int
    running: bool
    """False while it waits in the worker's prefetch queue."""
    episodes_done: Int = 0
    steps: Int = 0
    """Environment steps done in the running job; shows progress."""


class Heartbeat(Message, frozen=True, kw_only=True, tag="beat"):
    """Lists every lease that the worker holds; each listed lease is renewed."""

    worker: Word
    session: Word
    held: Many[HeldLease]
    wait_s: Number = 0.0
    """The reply may be held back for this long; it comes at once when there is a lease to stop."""
    settled: Int = 0
    """All polls up to this one had ended when `held` was written. 0: no polls are numbered."""


class HeartbeatReply(Message, frozen=True, kw_only=True, tag="beat_reply"):
    """Leases that the worker has to stop."""

    cancelled: Many[Text] = ()
    """Leases to stop at once: expired or cancelled."""
    drain: bool = False
    """Request no more work; finish the running jobs."""
    describe: Many[Word] = ()
    """Undescribed environments that runs wait for: the worker registers again with their descriptions."""


ResultKind = Literal["done", "returned", "failed"]
"""done: played. returned: given back unfinished (drained, cancelled). failed: infrastructure."""


class JobResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of one lease."""

    lease_id: Word
    job_id: Word
    attempt: Int
    kind: ResultKind
    episodes: Many[EpisodeOutcome] = ()
    """In the job's order; empty unless `done`."""
    packed: BlobRef | None = None
    """`codec.pack_outcomes` of the episodes, uploaded beforehand, when they are too large for a message."""
    error: Text = ""
    """For operators; never shown to an agent."""
    begun: BlobRef | None = None
    """Of an unfinished hidden job, for `Job.begun`: actions and failures. Only workers read it."""
    limit_verdict: bool = False
    """Whether `begun` contains a failure by a limit."""
    environment_fault: bool = False
    """Whether the environment broke its word: it raised, hung, or left its spaces. The worker is not to blame then."""


class ReportResults(Message, frozen=True, kw_only=True, tag="done"):
    """Results of finished leases. Answered once they are durable; safe to send again."""

    worker: Word
    session: Word
    results: Many[JobResult]


class ResultsReported(Message, frozen=True, kw_only=True, tag="done_reply"):
    """Every result of the request was handled: committed, compared, or found to belong to a closed job."""

    n: Int


class BlobPut(Message, frozen=True, kw_only=True, tag="blob_put"):
    """One chunk of a blob. A blob's chunks are sent in order, each after the reply to the one before."""

    sender: Word
    """The worker's session, or the run id; its right to write is checked."""
    token: Word
    digest: Word
    size: Int
    offset: Int
    data: Bytes


class BlobAck(Message, frozen=True, kw_only=True, tag="blob_ack"):
    """How much of a blob has arrived; the next chunk starts there."""

    have: Int
    """Bytes that the receiver has; equal to `size` once the blob is stored (also if it was stored already)."""


class BlobGet(Message, frozen=True, kw_only=True, tag="blob_get"):
    """Requests one chunk of a stored blob."""

    sender: Word
    token: Word
    digest: Word
    offset: Int
    direct: bool = False
    """Whether an address may be answered instead of the first chunk."""


class BlobChunk(Message, frozen=True, kw_only=True, tag="blob_chunk"):
    """The reply to `BlobGet`: the bytes from its offset on, and the size of the whole blob."""

    size: Int
    data: Bytes
    address: Text = ""
    """Where an object store serves the whole blob, and nothing else, for a minute; then without data."""


WorkerRequest = Register | LeaseRequest | Heartbeat | ReportResults | BlobPut | BlobGet
WorkerReply = Registered | Leases | HeartbeatReply | ResultsReported | BlobAck | BlobChunk | Refused
