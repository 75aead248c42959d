"""What workers and the coordinator say to each other. A worker asks, the coordinator answers; never the reverse."""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec
from msgspec.structs import replace

from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Text, Word
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, Tier
from evopolicy_common.wire.refusals import Refusal

DEFINITION_DIGITS = 16
"""Of a definition's digest, as fingerprints and people name it."""


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="op"):
    """A message on the wire; `op` names its type."""


class Refused(Message, frozen=True, kw_only=True, tag="refused"):
    """The request was understood and is not served; nothing was changed by it."""

    status: Refusal
    message: Text


class Fingerprint(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker's numbers depend on, beside the seed; of the whole worker, or of one environment (`of`)."""

    code_version: Word
    """Version and source digest of the worker's own code."""
    python: Word
    packages: Named[Text]
    """Name to exact version of the packages that environments are made of."""
    cpu: Text
    """CPU model and the features that numerical libraries choose their code by."""
    adapter: Word = ""
    """`EnvironmentDescription.adapter`; empty: of the whole worker."""
    definition: Word = ""
    """The first digits of `EnvironmentDescription.digest()`."""

    def of(self, description: EnvironmentDescription) -> Fingerprint:
        """What the numbers of one environment depend on; the whole where the worker does not tell them apart."""
        if not description.adapter:
            return self
        return replace(
            self,
            packages=description.packages,
            adapter=description.adapter,
            definition=description.digest()[:DEFINITION_DIGITS],
        )

    def class_name(self, *, cpu: bool) -> str:
        """12 hex digits, equal for workers whose results may stand in one run; `cpu`: the CPU's features count too.

        Another file of the worker's code makes another class only where it is one of the adapter's.
        """
        code = [self.adapter, self.definition] if self.adapter else [self.code_version]
        parts = [*code, self.python, sorted(self.packages.items())]
        if cpu:
            parts.append(self.cpu)
        return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()[:12]

    def versions(self) -> dict[str, str]:
        """What the class is made of, by name."""
        code = {"adapter": self.adapter, "definition": self.definition} if self.adapter else {}
        return {"evopolicy-worker": self.code_version, **code, "python": self.python, **self.packages}

    def flat(self) -> dict[str, str]:
        """As `run.json` has it."""
        return {**self.versions(), "cpu": self.cpu}


class Register(Message, frozen=True, kw_only=True, tag="register"):
    """The first thing a worker says, and again whenever the coordinator does not know its session."""

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
    """Of the worker's kernel (`host.boot_id`); a worker without one plays no hidden episodes."""
    machine_id: Word = ""
    """Of its machine (`host.machine_id`)."""


class Registered(Message, frozen=True, kw_only=True, tag="registered"):
    """The worker is known from now on, and may ask for leases."""

    session: Word
    """To be sent with every later request; ends with the coordinator's or the worker's process."""
    lease_ttl_s: Number
    """A lease that no heartbeat renews for so long is taken away."""
    heartbeat_s: Number
    refused: Named[Text] = {}
    """Run id to why this worker gets no work of it, such as other versions than the run began with."""
    hidden_bar: Text = ""
    """Why this worker gets no hidden work of any run; empty when it may."""
    refused_environments: Named[Text] = {}
    """Environment to why its announcement is not listened to."""


class LeaseRequest(Message, frozen=True, kw_only=True, tag="lease"):
    """A long poll for work: answered as soon as there is some, or empty after `wait_s`."""

    worker: Word
    session: Word
    n: Int
    """How many leases the worker can take; 0 takes back the poll that waits, and is answered at once with none."""
    wait_s: Number
    warm_bundles: Many[Text] = ()
    warm_environments: Many[Text] = ()
    serial: Int = 0
    """The worker's own number of this sending; grows, over its starts too. 0: it does not count."""


class Lease(msgspec.Struct, frozen=True, kw_only=True):
    """The right, for a time, to play one job and report its result."""

    lease_id: Word
    attempt: Int
    """Counts from 1 per job: fences off the results of attempts that were given up."""
    stimulus_id: Word
    """Runs from the event that made the job through every log line about it."""
    job: Job
    stop_in_silence: bool = False
    """Stop it, and give it back, when no heartbeat was answered for `lease_ttl_s`: an agent may be let onto this kernel."""


class Leases(Message, frozen=True, kw_only=True, tag="leases"):
    """The answer to a poll; empty when there was nothing in time."""

    leases: Many[Lease]
    cancelled: Many[Text] = ()
    """Leases to stop at once, told here because the poll happened to wait; heartbeats tell them too."""


class HeldLease(msgspec.Struct, frozen=True, kw_only=True):
    """One lease in a worker's hands, as its heartbeat tells."""

    lease_id: Word
    job_id: Word
    attempt: Int
    running: bool
    """False while it waits in the worker's prefetch queue."""
    episodes_done: Int = 0
    steps: Int = 0
    """Environment steps done in the running job: a sign of progress."""


class Heartbeat(Message, frozen=True, kw_only=True, tag="beat"):
    """Every lease that the worker holds, renewed by being listed."""

    worker: Word
    session: Word
    held: Many[HeldLease]
    wait_s: Number = 0.0
    """The answer may be held back for so long, and then comes at once when there is a lease to stop."""
    settled: Int = 0
    """All polls up to this number were over when `held` was put down: what they brought is in it, or was let go of. 0: the
    worker does not count its polls."""


class HeartbeatReply(Message, frozen=True, kw_only=True, tag="beat_reply"):
    """What the worker is to stop."""

    cancelled: Many[Text] = ()
    """Leases to stop at once: expired, cancelled or preempted."""
    drain: bool = False
    """Ask for no more work; finish what runs."""


ResultKind = Literal["done", "returned", "slot_died", "failed"]
"""done: played; returned: given back unfinished (drained, preempted, cancelled); failed: infrastructure (ended
from outside, environment crashed by itself, disk full, sandbox). slot_died: only from workers of earlier versions; the same as
failed."""


class JobResult(msgspec.Struct, frozen=True, kw_only=True):
    """What came of one lease."""

    lease_id: Word
    job_id: Word
    attempt: Int
    kind: ResultKind
    episodes: Many[EpisodeOutcome] = ()
    """In the job's order; empty unless `done`."""
    packed: BlobRef | None = None
    """`codec.pack_outcomes` of the episodes, uploaded before, where they are too large for a message."""
    error: Text = ""
    """For operators; never shown to an agent."""
    begun: BlobRef | None = None
    """Of a hidden job that was not finished: what its policy has returned, and how it has failed, for `Job.begun` of the next
    attempt. Bytes that workers alone read."""
    limit_verdict: bool = False
    """Whether that tells of a failure by a limit."""


class ReportResults(Message, frozen=True, kw_only=True, tag="done"):
    """Results. Answered once they are durable; sending the same again is safe."""

    worker: Word
    session: Word
    results: Many[JobResult]


class ResultsReported(Message, frozen=True, kw_only=True, tag="done_reply"):
    """Every result of the request was taken (committed, compared, or found to be of a closed job)."""

    n: Int


class BlobPut(Message, frozen=True, kw_only=True, tag="blob_put"):
    """One chunk; chunks of a blob go in order, each answered before the next."""

    sender: Word
    """Worker's session or run id: whose right to write is checked."""
    token: Word
    digest: Word
    size: Int
    """Bytes of the whole blob."""
    offset: Int
    data: Bytes


class BlobAck(Message, frozen=True, kw_only=True, tag="blob_ack"):
    """How far a blob has come: the next chunk begins there."""

    have: Int
    """Bytes that the receiver has; equal to `size` when it is stored (also when it was already there)."""


class BlobGet(Message, frozen=True, kw_only=True, tag="blob_get"):
    """One chunk of a stored blob."""

    sender: Word
    token: Word
    digest: Word
    offset: Int


class BlobChunk(Message, frozen=True, kw_only=True, tag="blob_chunk"):
    """The answer to `BlobGet`: the bytes from its offset on, and the size of the whole."""

    size: Int
    data: Bytes


WorkerRequest = Register | LeaseRequest | Heartbeat | ReportResults | BlobPut | BlobGet
WorkerReply = Registered | Leases | HeartbeatReply | ResultsReported | BlobAck | BlobChunk | Refused
