"""What an operator's commands and the coordinator say to each other. Only operators learn hidden results."""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.audit import AuditRecord
from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Numbered, Plain, Text, Word
from evopolicy_common.messages.environment import (
    EnvironmentDescription,
    ObservationForm,
    PolicyScope,
    Split,
    StepLimit,
)
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Record, ResourceLimits, Tier
from evopolicy_common.messages.gateway import FinishRule, Profile, SimulationRule, SubmitStatus, VideoOption
from evopolicy_common.messages.journal import Committed
from evopolicy_common.messages.worker import (
    BlobAck,
    BlobChunk,
    BlobGet,
    BlobPut,
    Fingerprint,
    Message,
    Refused,
)

HiddenIsolation = Literal["exclusive", "shared", "waived", "unknown"]
"""Whether hidden episodes and agents shared a kernel: never; they could, as the rule was off for all or some of the run; the
operator vouched for where the agent was; or the run was played before this was recorded."""

HiddenCases = Literal["shared", "per_run"]
"""Validation and held-out cases: the same for all runs of an environment, or each run's own (no paired statistics)."""

ELSEWHERE = "elsewhere"
"""For `RunSettings.agent_host`: the operator vouches that the agent is on no machine of the cluster."""


class RunSettings(msgspec.Struct, frozen=True, kw_only=True):
    """What a run is opened with. None means the suite's own number."""

    env: Word
    entry: Word
    """Name of the agent in tables, such as `evolve` or `GPT-5.5 (Codex)`."""
    model: Word
    exp_id: Word
    repeat: Int = 0
    attempt: Int = 1
    budget: Int | None = None
    min_episodes_per_submit: Int | None = None
    max_episodes_per_submit: Int | None = None
    n_validation: Int | None = None
    n_heldout: Int | None = None
    policy_scope: PolicyScope = "episode"
    observations: ObservationForm = "arrays"
    sandbox_tier: Tier = "bwrap"
    video: VideoOption = "off"
    replays: VideoOption | None = None
    """Which held-out episodes of the selected checkpoint are recorded for people to watch; None: as `video`."""
    limits: ResourceLimits = ResourceLimits()
    notes: Named[Text] = {}
    """The operator's own labels; kept in `run.json`."""
    hidden_cases: HiddenCases = "shared"
    simulation: SimulationRule = "forbidden"
    finish: FinishRule = "early"
    step_limit: StepLimit = "natural"
    """Rows and messages of earlier versions tell none."""
    profile: Profile = "own"
    definition: Word = ""
    """First digits of the digest of the environment's definition; empty: the one that ships or is approved."""
    agent_host: Word = ""
    """Boot id of the kernel that the agent runs on, or `ELSEWHERE`; empty: its gateway's own, or for a remote agent unknown."""

    @property
    def recorded_heldout(self) -> VideoOption:
        """Which held-out episodes are recorded."""
        return self.video if self.replays is None else self.replays


PUBLISHED: dict[str, str] = {
    "policy_scope": "submit",
    "observations": "lists",
    "simulation": "forbidden",
    "finish": "budget",
    "step_limit": "published",
    "hidden_cases": "shared",
}
"""What the profile `published` chooses, by the names of `RunSettings`. Its cases are the published files besides."""
PUBLISHED_TRAIN = 1024
"""Train ids of the published case files."""


def off_profile(settings: RunSettings) -> str:
    """The settings in which a run of profile `published` differs from it, in words; empty where there are none."""
    if settings.profile == "own":
        return ""
    told = {name: getattr(settings, name) for name in PUBLISHED}
    return ", ".join(
        f"{name} {told[name]} (not {value})" for name, value in PUBLISHED.items() if told[name] != value
    )


class CreateRun(Message, frozen=True, kw_only=True, tag="create_run"):
    """Open a run. Safe to send again with the same key."""

    token: Word
    key: Word
    """Idempotency key: creating twice with one key gives the same run."""
    settings: RunSettings


class RunCreated(Message, frozen=True, kw_only=True, tag="run_created"):
    """The run is durable, and its gateway may open it."""

    run: Word
    capability: Word
    """Token of this run's gateway."""


RunEnd = Literal["completed", "no_ok_submit", "error", "cancelled"]
"""`cancelled`: the operator ended the run; `error`: it could not be played to its end."""


class RunFinished(msgspec.Struct, frozen=True, kw_only=True):
    """A finalised run as the coordinator knows it: the source of `run.json`."""

    run: Word
    settings: RunSettings
    status: RunEnd
    error: Text | None
    closed_reason: Text = msgspec.field(name="close_reason")
    agent: Plain
    final_score: Number | None
    """Held-out mean return of the selected checkpoint."""
    best_submit_index: Int | None
    val_scores: Numbered[Number]
    heldout_returns: Many[Number]
    validation_ineligible: Numbered[Text]
    """Checkpoints that were quarantined while hidden, with the reason."""
    policy_failures: Named[Int]
    """Hidden episodes in which the selected policy failed, by split."""
    random_heldout_returns: Many[Number]
    """Uniform random actions on the same held-out cases."""
    episode_budget: Int
    budget_used: Int
    split_hashes: Named[Text]
    """SHA-256 by split name."""
    split_secret: bool
    env_version: Word
    deterministic: bool
    fingerprint: Fingerprint | None
    """Of the worker that the run was pinned by."""
    created_at: Number
    closed_at: Number
    finished_at: Number
    submits: Many[SubmitRecord]
    wall_s: Named[Number]
    """Seconds by phase: `queue`, `rollout`, `finalise`."""
    infrastructure_retries: Int = 0
    nondeterministic_results: Int = 0
    """Repeated attempts of one job whose results differed."""
    audit: AuditRecord | None = None
    """None where nothing was to be audited and no forger is known."""
    hidden_isolation: HiddenIsolation = "unknown"
    fingerprint_overrides: Many[Text] = ()
    """`CLASS → CLASS: why` for each time an operator let the run go on with workers of other versions, oldest first."""
    reference_by_case: bool = False
    """The random actions follow from split and case; False for runs that an earlier version created."""
    committed: Committed | None = None
    """None for runs that an earlier version opened: they were never committed to, and cannot be any more."""


class SubmitRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One accepted submit, for checkpoints and `metrics.json`."""

    submit_index: Int
    status: SubmitStatus
    bundle: Word | None
    env_instances: Many[Int]
    remaining_budget: Int
    mean_return: Number | None
    """Visible mean over the train episodes; None unless ok."""
    val_mean: Number | None
    started_at: Number
    completed_at: Number


class WaitRun(Message, frozen=True, kw_only=True, tag="wait_run"):
    """A long poll until the run is finished; answered with `RunProgress` while it is not."""

    token: Word
    run: Word
    wait_s: Number


class RunProgress(Message, frozen=True, kw_only=True, tag="run_progress"):
    """Where a run stands, and once it is finished all of it."""

    phase: Literal["open", "validation", "heldout", "random", "finished"]
    done: Int
    """Episodes done of this phase."""
    total: Int
    waits_for: Text = ""
    finished: RunFinished | None = None


class PlayedAs(msgspec.Struct, frozen=True, kw_only=True):
    """Where episodes that are played again stood when a run played them: the policy is told the same."""

    run: Word
    """The coordinator's id of the run; its policy seeds are used where the coordinator knows it. May be empty."""
    submit_index: Int
    """-1 for the random reference."""
    env_instances: Many[Int]
    """The whole list of cases that they were part of, in order."""
    indexes: Many[Int]
    """Their positions in that list."""
    modulo: Int
    """Episodes of the checkpoint's own submit: episode indexes count modulo this."""
    remaining_budget_after: Int
    policy_scope: PolicyScope = "episode"
    """With `submit`, `indexes` must be the whole list."""
    observations: ObservationForm = "arrays"


class Evaluate(Message, frozen=True, kw_only=True, tag="evaluate"):
    """Play cases outside any run: `evopolicy try`, `evopolicy random`."""

    token: Word
    key: Word
    env: Word
    bundle: Word | None
    """None for uniform random actions."""
    split: Split
    cases: Many[Int] | None
    """Ids in the split; None for all of it."""
    record: Record = "full"
    sandbox_tier: Tier = "bwrap"
    limits: ResourceLimits = ResourceLimits()
    replays: Many[BlobRef] = ()
    """A trajectory for each of `cases`, whose actions are played in place of a policy's; uploaded before, `bundle` None."""
    as_in: PlayedAs | None = None
    """None for what was not played in a run before."""
    step_limit: StepLimit = "natural"
    definition: Word = ""
    """As `RunSettings.definition`."""


class DescribeEnvironment(Message, frozen=True, kw_only=True, tag="describe_environment"):
    """What a cluster has for playing a finished run's episodes again."""

    token: Word
    env: Word
    run: Word = ""
    n_validation: Int | None = None
    n_heldout: Int | None = None
    """Of the run, where they were not the suite's own."""


class EnvironmentState(Message, frozen=True, kw_only=True, tag="environment_state"):
    """The answer to `DescribeEnvironment`."""

    split_hashes: Named[Text]
    """SHA-256 by split name: equal to a run's where the cases are the same."""
    knows_run: bool
    """The run is finished here, and its episodes' records may still be stored."""
    fingerprints: Many[Fingerprint]
    """Of the connected workers that offer the environment, each once."""


class RecordedRequest(Message, frozen=True, kw_only=True, tag="recorded"):
    """Outcomes of a finished run's episodes as they were stored; answered with an `EvaluationPage`."""

    token: Word
    run: Word
    split: Split
    submit_index: Int
    """-1 for the random reference."""
    cursor: Int


class EvaluationStarted(Message, frozen=True, kw_only=True, tag="evaluation_started"):
    """The evaluation is queued; also the answer to a repeated key."""

    evaluation: Word


class EvaluationPoll(Message, frozen=True, kw_only=True, tag="evaluation_poll"):
    """A long poll for outcomes of an evaluation from a cursor on."""

    token: Word
    evaluation: Word
    cursor: Int
    wait_s: Number


class EvaluationPage(Message, frozen=True, kw_only=True, tag="evaluation_page"):
    """Outcomes in order of arrival; `cursor` is where the next page begins."""

    cursor: Int
    total: Int
    outcomes: Many[EpisodeOutcome]
    finished: bool
    waits_for: Text = ""


class CancelRun(Message, frozen=True, kw_only=True, tag="cancel_run"):
    """End a run or an evaluation without a score."""

    token: Word
    run: Word


class AgentGone(Message, frozen=True, kw_only=True, tag="agent_gone"):
    """The operator's word that a run's agent is no longer alive: ends its permit. For machines that are lost for good."""

    token: Word
    run: Word
    boot_id: Word = ""
    """Of the kernel that it is gone from; empty: from wherever it was. The run may go on elsewhere meanwhile."""


class RepinRun(Message, frozen=True, kw_only=True, tag="repin_run"):
    """Let a run go on with the workers of another fingerprint class; the reason is recorded in the run."""

    token: Word
    run: Word
    fingerprint_class: Word
    """As `WorkerStatus.classes` shows it for the run's environment, or `WorkerStatus.fingerprint`."""
    reason: Text


class SetWorker(Message, frozen=True, kw_only=True, tag="set_worker"):
    """Take a worker out of service, or back."""

    token: Word
    worker: Word
    state: Literal["active", "paused", "draining"]
    """paused: it gets no more work and stays. draining: it gets no more, and ends once what it plays is done."""


class Done(Message, frozen=True, kw_only=True, tag="ok"):
    """The request was carried out."""


class Claim(Message, frozen=True, kw_only=True, tag="claim"):
    """One run of a sweep, for this host to play: taken, renewed, given back or settled, so that none is played twice."""

    token: Word
    suite: Word
    """The sweep's name."""
    name: Word
    """The run's name in the sweep."""
    holder: Word
    """The host that asks; the same after its restart."""
    ttl_s: Number
    """Asked for again before this many seconds are over; 0.0 gives it back."""
    run: Word = ""
    """The cluster's id of what is played for it, once there is one."""
    result: Plain | None = None
    """What it came to: settles the claim for good."""


class ClaimState(Message, frozen=True, kw_only=True, tag="claim_state"):
    """How things stand after a `Claim`."""

    granted: bool
    """The asker holds it, or may not and need not because it is settled."""
    holder: Word
    """Who holds or held it last; empty: nobody."""
    run: Word
    """What the last holder played for it; empty: nothing yet."""
    previous: Word = ""
    """The holder from whom it has just been taken over, because its time was up."""
    result: Plain | None = None
    """What it came to, once it is settled."""


class Disclose(Message, frozen=True, kw_only=True, tag="disclose"):
    """Declare the cases of finished runs public; answered with `Done` once the journal says so."""

    token: Word
    runs: Many[Word]


class JournalRequest(Message, frozen=True, kw_only=True, tag="journal"):
    """Entries of the journal from `cursor` on."""

    token: Word
    cursor: Int


class JournalPage(Message, frozen=True, kw_only=True, tag="journal_page"):
    """Entries in order, as they were hashed; `cursor` is where the next page begins."""

    cursor: Int
    entries: Many[Bytes]
    finished: bool


class OpeningRequest(Message, frozen=True, kw_only=True, tag="opening"):
    """What the coordinator committed to for a run whose cases were disclosed."""

    token: Word
    run: Word


class RunOpening(Message, frozen=True, kw_only=True, tag="run_opening"):
    """The documents as they were hashed; see `records.journal`."""

    salt: Bytes
    opening: Bytes
    result: Bytes


class SignRequest(Message, frozen=True, kw_only=True, tag="sign"):
    """Have the manifest of published results signed with the coordinator's key."""

    token: Word
    digest: Word
    """SHA-256 of the manifest, 64 hex digits."""


class Signed(Message, frozen=True, kw_only=True, tag="signed"):
    """The signature (128 hex digits) and the public key (64) that it is checked with: Ed25519."""

    key: Word
    signature: Word


class EnvironmentsRequest(Message, frozen=True, kw_only=True, tag="environments"):
    """Which environments the workers offer; answered a page at a time."""

    token: Word
    cursor: Int = 0


class OfferedEnvironment(msgspec.Struct, frozen=True, kw_only=True):
    """One definition of one environment."""

    description: EnvironmentDescription
    digest: Word
    """First digits of its digest."""
    accepted: Text
    """`ships`, `approved`, `trusted`, or `by digest only`: then a run has to name `ID@DIGEST`."""
    workers: Many[Text]
    """Connected workers that offer it."""


class EnvironmentsReply(Message, frozen=True, kw_only=True, tag="environments_reply"):
    """A page of what is offered."""

    environments: Many[OfferedEnvironment]
    cursor: Int
    finished: bool


class ApproveEnvironment(Message, frozen=True, kw_only=True, tag="approve_environment"):
    """Let runs use an environment that does not ship, in one definition."""

    token: Word
    env: Word
    digest: Word


class StatusRequest(Message, frozen=True, kw_only=True, tag="status"):
    """What the cluster is doing."""

    token: Word


class WorkerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One worker that is connected, or was lately."""

    worker: Word
    host: Word
    slots: Int
    state: Literal["active", "paused", "draining", "lost", "quarantined"]
    tiers: Many[Tier]
    environments: Many[Text]
    fingerprint: Text
    """Short class of the whole worker's fingerprint: workers of which it is equal may share any run."""
    versions: Named[Text]
    """What the class is made of: `evopolicy-worker`, `python`, the environments' packages, `cpu`."""
    held: Int
    running: Int
    last_seen_s: Number
    """Seconds since its last heartbeat."""
    refused: Named[Text] = {}
    """Run id to why this worker gets no work of it."""
    boot_id: Word = ""
    hidden_bar: Text = ""
    """Why it plays no hidden episodes now; empty when it may."""
    classes: Named[Word] = {}
    """Environment to its fingerprint class here: only workers of one class share a run of it."""
    playing: Named[Int] = {}
    """Episode jobs that it plays now, by run or evaluation."""


class RunStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One unfinished run."""

    run: Word
    entry: Word
    env: Word
    phase: Text
    budget: Int
    remaining_budget: Int
    n_submits: Int
    queued: Int
    running: Int
    done: Int
    """Episode jobs finished, train and hidden together."""
    waits_for: Text = ""
    agent_host: Word = ""
    """Where its agent may be alive: a host's name, a boot id, or `everywhere`; empty: nowhere."""
    exp_id: Word = ""
    repeat: Int = 0
    best_mean: Number | None = None
    """Highest visible mean return of its ok submits so far."""
    created_at: Number = 0.0
    """Unix time, seconds."""


class TurnedAway(msgspec.Struct, frozen=True, kw_only=True):
    """A worker whose registration was refused."""

    worker: Word
    """As it called itself."""
    host: Word
    why: Text
    ago_s: Number
    """Seconds since the last time."""


class StatusReply(Message, frozen=True, kw_only=True, tag="status_reply"):
    """The answer to `StatusRequest`."""

    cluster: Word
    version: Word
    uptime_s: Number
    episodes_done: Int
    episodes_per_s: Number
    """Over the last minute."""
    workers: Many[WorkerStatus]
    runs: Many[RunStatus]
    stalls: Many[Text] = ()
    """What waits longer than it should, and for what."""
    audit_share: Number = 0.0
    """Share of the episodes of new runs that is played again elsewhere."""
    audits: Named[Int] = {}
    """Of the unfinished runs: audited episodes by where they stand (`open`, `agreed`, `disputed`, `not_audited`)."""
    disputes: Many[Text] = ()
    """What workers disagree on, the latest last."""
    quarantined: Named[Text] = {}
    """Workers that get no more leases, and why."""
    turned_away: Many[TurnedAway] = ()


OperatorRequest = (
    CreateRun
    | WaitRun
    | Evaluate
    | EvaluationPoll
    | DescribeEnvironment
    | RecordedRequest
    | CancelRun
    | AgentGone
    | RepinRun
    | SetWorker
    | Claim
    | Disclose
    | JournalRequest
    | OpeningRequest
    | SignRequest
    | StatusRequest
    | EnvironmentsRequest
    | ApproveEnvironment
    | BlobPut
    | BlobGet
)
OperatorReply = (
    RunCreated
    | RunProgress
    | EvaluationStarted
    | EvaluationPage
    | EnvironmentState
    | Done
    | ClaimState
    | JournalPage
    | RunOpening
    | Signed
    | StatusReply
    | EnvironmentsReply
    | BlobAck
    | BlobChunk
    | Refused
)
