"""Messages between an operator's commands and the coordinator. Only operators receive hidden results."""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Plain, Text, Word
from evopolicy_common.messages.environment import (
    Case,
    EnvironmentDescription,
    Split,
    StepLimit,
)
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Record, ResourceLimits, Tier
from evopolicy_common.messages.gateway import Conditions, SubmitStatus
from evopolicy_common.messages.run_settings import HiddenIsolation, RunSettings
from evopolicy_common.messages.status import FromOperator, StatusReply, StatusRequest
from evopolicy_common.messages.worker import (
    BlobAck,
    BlobChunk,
    BlobGet,
    BlobPut,
    Fingerprint,
    Message,
    Refused,
)


class CreateRun(FromOperator, frozen=True, kw_only=True, tag="create_run"):
    """Open a run. Safe to send again with the same key."""

    key: Word
    """Idempotency key: creating twice with one key returns the same run."""
    settings: RunSettings
    replay_key: Word = ""
    """With `settings.replay_of`: the key with which that run was created, which only its operator knows."""
    run: Word = ""
    """The run that was opened with the key before, to be opened again by a coordinator that has lost it; empty: new."""


class RunCreated(Message, frozen=True, kw_only=True, tag="run_created"):
    """The run is durable, and its gateway may open it."""

    run: Word
    capability: Word
    """Token of this run's gateway."""


RunEnd = Literal["completed", "no_ok_submit", "error", "cancelled"]
"""`cancelled`: the operator ended the run. `error`: the run could not be completed."""


class Committed(msgspec.Struct, frozen=True, kw_only=True):
    """The coordinator's commitment before the run's agent started, with its journal entries. See `records.journal`."""

    commitment: Word
    """Salted SHA-256 (hex) of the run's splits and settings."""
    epoch: Word
    """The epoch of the run's cases."""
    opened: Int
    """Index of the journal entry that holds the commitment, from 0."""
    opened_head: Word
    """Hash (hex) of the journal up to that entry."""
    ended: Int | None = None
    """Index of the entry with the digest of the run's result; None until then."""
    ended_head: Word = ""
    """Hash (hex) of the journal up to that entry."""


class SubmitResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of one accepted submit."""

    submit_index: Int
    status: SubmitStatus
    bundle: Word | None
    """SHA-256 (hex) of the policy's bundle."""
    env_instances: Many[Int]
    remaining_budget: Int
    """After this submit."""
    mean_return: Number | None
    """Mean return over the train episodes, visible to the agent; None unless ok."""
    val_mean: Number | None
    started_at: Number
    completed_at: Number
    tree: Word = ""
    """Digest of the workspace at the submit; empty: not recorded."""


class RunResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a run: the document that the journal's last entry on the run commits to, published as it is."""

    run: Word
    status: RunEnd
    closed_reason: Text
    best_submit_index: Int | None
    final_score: Number | None
    """Held-out mean return of the selected checkpoint."""
    heldout_returns: Many[Number]
    heldout_successes: Many[bool]
    """Whether each held-out episode solved the task; empty where the environment does not report it."""
    random_heldout_returns: Many[Number]
    """Returns of uniform random actions on the same held-out cases."""
    validation_ineligible: Many[Int]
    """`ok` checkpoints that cannot be selected, since their policy failed in validation."""
    policy_failures: Named[Int]
    """Hidden episodes in which the selected policy failed, by split."""
    budget_used: Int
    submits: Many[SubmitResult]
    infrastructure_retries: Int
    nondeterministic_results: Int
    """Repeated attempts of a job whose results differed."""
    split_hashes: Named[Text]
    """SHA-256 of each split, and of each case file, by name."""
    env_title: Word
    env_family: Word
    """Title and family as the environment's definition states them; empty: the catalogue's."""
    env_version: Word
    deterministic: bool
    fingerprint: Fingerprint | None
    """Fingerprint of the worker to which the run was pinned."""
    installations: Many[Word]
    """Installations of the workers that played its episodes, in the order of their first ones."""
    n_overrides: Int
    """How often an operator let the run continue with other versions."""
    hidden_isolation: HiddenIsolation
    wall_s: Named[Number]
    """Seconds by phase: `queue`, `rollout`, `finalise`."""
    record: Plain
    """The gateway's facts when it closed the run (`account.Told`); empty: none."""

    @property
    def val_scores(self) -> dict[int, float]:
        """Validation means of the eligible checkpoints, by submit."""
        return {one.submit_index: one.val_mean for one in self.submits if one.val_mean is not None}


class RunFinished(RunResult, frozen=True, kw_only=True, tag="finished"):
    """A finalised run, as the coordinator stores it and its operator gets it: the source of `run.json`. Key: `run`."""

    settings: RunSettings
    error: Text | None
    agent: Plain
    """The gateway's facts about the agent."""
    fingerprint_overrides: Many[Text]
    """`CLASS → CLASS: why` for each time an operator let the run continue with other versions, oldest first."""
    budget: Int
    min_episodes_per_submit: Int
    max_episodes_per_submit: Int
    n_train: Int
    n_validation: Int
    n_heldout: Int
    cases_secret: bool
    created_at: Number
    finished_at: Number
    committed: Committed

    @property
    def result(self) -> RunResult:
        """The part that is committed to and published: without an operator's words and the agent's other facts."""
        return RunResult(**{name: getattr(self, name) for name in RunResult.__struct_fields__})


class WaitRun(FromOperator, frozen=True, kw_only=True, tag="wait_run"):
    """A long poll for a finished run; answered with `RunProgress` until then."""

    run: Word
    wait_s: Number


class RunProgress(Message, frozen=True, kw_only=True, tag="run_progress"):
    """A run's progress, and its result once it is finished."""

    phase: Literal["open", "validation", "heldout", "random", "finished"]
    done: Int
    """Finished episodes of this phase."""
    total: Int
    waits_for: Text = ""
    finished: RunFinished | None = None
    trouble: Text = ""
    """Why the coordinator accepts no changes, of this run or any other; empty: it accepts them."""
    env_failure: Text = ""
    """Why its environment failed on a worker, if no connected worker offers it."""


class PlayedAs(msgspec.Struct, frozen=True, kw_only=True):
    """The place of replayed episodes in their original run: the policy receives the same arguments."""

    run: Word
    """The coordinator's id of the run; its policy seeds are used if the coordinator knows the run. May be empty."""
    submit_index: Int
    """-1 for the random reference."""
    env_instances: Many[Int]
    """The whole list of cases to which they belonged, in order."""
    indexes: Many[Int]
    """Their positions in that list."""
    modulo: Int
    """Number of episodes of the checkpoint's own submit: episode indexes count modulo this."""
    remaining_budget_after: Int
    conditions: Conditions = Conditions()
    """With the policy scope `submit`, `indexes` must cover the whole list."""


class Evaluate(FromOperator, frozen=True, kw_only=True, tag="evaluate"):
    """Play cases outside any run: `evopolicy try`."""

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
    """A trajectory for each of `cases`, whose actions replace a policy's; uploaded beforehand, `bundle` None."""
    as_in: PlayedAs | None = None
    """None for episodes that were not played in a run before."""
    step_limit: StepLimit = "natural"
    definition: Word = ""
    """As `RunSettings.definition`."""


class DescribeEnvironment(FromOperator, frozen=True, kw_only=True, tag="describe_environment"):
    """Requests what a cluster has for replaying a finished run's episodes."""

    env: Word
    run: Word = ""
    n_validation: Int | None = None
    n_heldout: Int | None = None
    """The run's own numbers, where they were not the suite's."""


class EnvironmentState(Message, frozen=True, kw_only=True, tag="environment_state"):
    """The reply to `DescribeEnvironment`."""

    split_hashes: Named[Text]
    """SHA-256 by split name; equal to a run's when the cases are the same."""
    knows_run: bool
    """The run finished here, and its episodes' records may still be stored."""
    fingerprints: Many[Fingerprint]
    """Distinct fingerprints of the connected workers that offer the environment."""
    classes: Many[Word] = ()
    """The class of each of `fingerprints`."""
    awaited: bool = False
    """No worker has described the environment yet, and one does so now: ask again."""
    result: Bytes = b""
    """The result of the finished run (`RunResult`, JSON); empty without one."""


class RecordedRequest(FromOperator, frozen=True, kw_only=True, tag="recorded"):
    """Requests the stored outcomes of a finished run's episodes; answered with an `EvaluationPage`."""

    run: Word
    split: Split
    submit_index: Int
    """-1 for the random reference."""
    cursor: Int


class FurtherCasesRequest(FromOperator, frozen=True, kw_only=True, tag="further_cases"):
    """Requests hidden cases for a re-score of a finished run, disjoint from its three splits."""

    run: Word
    name: Word
    """Of the re-score: runs of one environment get the same cases under the same name."""
    n: Int


class FurtherCases(Message, frozen=True, kw_only=True, tag="further_cases_reply"):
    """The reply to `FurtherCasesRequest`."""

    cases: Many[Case]
    epoch: Word
    """The epoch of the secret that the cases derive from."""


class Rescore(FromOperator, frozen=True, kw_only=True, tag="rescore"):
    """Plays a finished run's checkpoint on further hidden cases; answered with `EvaluationStarted`."""

    key: Word
    run: Word
    submit_index: Int
    """-1 for uniform random actions."""
    cases: Many[Case]
    """All cases of the re-score, disjoint from the run's splits."""
    indexes: Many[Int]
    """Positions in `cases` of the episodes to play; with policy scope `submit`, all of them."""
    fingerprint_class: Word = ""
    """The class of workers that plays them; empty: any."""


class EvaluationStarted(Message, frozen=True, kw_only=True, tag="evaluation_started"):
    """The evaluation is queued; also the reply to a repeated key."""

    evaluation: Word
    episodes: Int = 0
    """Number of its episodes; 0 when it has ended before this request."""


class EvaluationPoll(FromOperator, frozen=True, kw_only=True, tag="evaluation_poll"):
    """A long poll for outcomes of an evaluation from `cursor` on."""

    evaluation: Word
    cursor: Int
    wait_s: Number


class EvaluationPage(Message, frozen=True, kw_only=True, tag="evaluation_page"):
    """Outcomes in order of arrival; the next page starts at `cursor`."""

    cursor: Int
    total: Int
    outcomes: Many[EpisodeOutcome]
    finished: bool
    waits_for: Text = ""
    env_failure: Text = ""
    """As in `RunProgress`."""


class CancelRun(FromOperator, frozen=True, kw_only=True, tag="cancel_run"):
    """Ends a run or an evaluation without a score."""

    run: Word


class AgentGone(FromOperator, frozen=True, kw_only=True, tag="agent_gone"):
    """The operator declares a run's agent dead, which ends its permit. For machines that are lost for good."""

    run: Word
    boot_id: Word = ""
    """Boot id of the kernel that it is gone from; empty: from every kernel. The run may continue elsewhere."""


class RepinRun(FromOperator, frozen=True, kw_only=True, tag="repin_run"):
    """Lets a run continue with workers of another fingerprint class; the reason is recorded in the run."""

    run: Word
    fingerprint_class: Word
    """As `WorkerStatus.classes` shows it for the run's environment, or `WorkerStatus.fingerprint`."""
    reason: Text


class SetWorker(FromOperator, frozen=True, kw_only=True, tag="set_worker"):
    """Takes a worker out of service, or puts it back."""

    worker: Word
    state: Literal["active", "paused", "draining"]
    """paused: it gets no more work and stays. draining: it gets no more work, and exits once its jobs are done."""


class Done(Message, frozen=True, kw_only=True, tag="ok"):
    """The request was carried out."""


class Claim(FromOperator, frozen=True, kw_only=True, tag="claim"):
    """One run of a sweep: taken, renewed, released or settled, so that no two hosts play it."""

    suite: Word
    """The sweep's name."""
    name: Word
    """The run's name in the sweep."""
    holder: Word
    """The requesting host; the same after its restart."""
    ttl_s: Number
    """The claim expires after this many seconds unless renewed; 0.0 releases it."""
    run: Word = ""
    """The cluster's id of the run that is played for it, once it exists."""
    result: Plain | None = None
    """The run's result; settles the claim for good."""


class ClaimState(Message, frozen=True, kw_only=True, tag="claim_state"):
    """The state of a claim after a `Claim`."""

    granted: bool
    """Whether the requester holds the claim or has just settled it."""
    holder: Word
    """The present or last holder; empty for none."""
    run: Word
    """The run that the last holder played for it; empty: none yet."""
    previous: Word = ""
    """The previous holder, if the claim has just been taken over because it expired."""
    kept: bool = False
    """Whether the requester held the claim before."""
    coordinator: Word = ""
    """The coordinator's process: another one may have been started on an earlier backup."""
    result: Plain | None = None
    """The run's result, once the claim is settled."""


class Disclose(FromOperator, frozen=True, kw_only=True, tag="disclose"):
    """Declares the cases of finished runs public; answered with `Done` once the journal records it."""

    runs: Many[Word]


class JournalRequest(FromOperator, frozen=True, kw_only=True, tag="journal"):
    """Requests entries of the journal from `cursor` on."""

    cursor: Int


class JournalPage(Message, frozen=True, kw_only=True, tag="journal_page"):
    """Entries in order, as they were hashed; the next page starts at `cursor`."""

    cursor: Int
    entries: Many[Bytes]
    finished: bool


class OpeningRequest(FromOperator, frozen=True, kw_only=True, tag="opening"):
    """Requests what the coordinator committed to for a run whose cases were disclosed."""

    run: Word


class RunOpening(Message, frozen=True, kw_only=True, tag="run_opening"):
    """The documents as they were hashed; see `records.journal`."""

    salt: Bytes
    opening: Bytes
    result: Bytes


class SignRequest(FromOperator, frozen=True, kw_only=True, tag="sign"):
    """Requests a signature of a manifest of published results with the coordinator's key."""

    digest: Word
    """SHA-256 of the manifest, 64 hex digits."""


class Signed(Message, frozen=True, kw_only=True, tag="signed"):
    """An Ed25519 signature (128 hex digits) and the public key (64 hex digits) that verifies it."""

    key: Word
    signature: Word


class EnvironmentsRequest(FromOperator, frozen=True, kw_only=True, tag="environments"):
    """Requests the environments that the workers offer, page by page."""

    cursor: Int = 0


class OfferedEnvironment(msgspec.Struct, frozen=True, kw_only=True):
    """One definition of one environment."""

    description: EnvironmentDescription
    digest: Word
    """First digits of the definition's digest."""
    accepted: Text
    """`ships`, `approved`, `trusted`, or `by digest only`: in the last case a run has to name `ID@DIGEST`."""
    workers: Many[Text]
    """Connected workers that offer it."""


class EnvironmentsReply(Message, frozen=True, kw_only=True, tag="environments_reply"):
    """A page of the offered environments."""

    environments: Many[OfferedEnvironment]
    cursor: Int
    finished: bool
    undescribed: Named[Many[Text]] = {}
    """With the last page: shipped environments that workers describe on first use, with the names of these workers."""
    failed: Named[Named[Text]] = {}
    """With the last page: by environment, the workers on which it failed, with the reasons."""


class ApproveEnvironment(FromOperator, frozen=True, kw_only=True, tag="approve_environment"):
    """Lets runs use one definition of an environment that does not ship."""

    env: Word
    digest: Word


_OfRuns = CreateRun | WaitRun | CancelRun | AgentGone | RepinRun | Claim | Disclose | OpeningRequest | Rescore
_OfEpisodes = Evaluate | EvaluationPoll | RecordedRequest | FurtherCasesRequest | BlobPut | BlobGet
_OfEnvironments = DescribeEnvironment | EnvironmentsRequest | ApproveEnvironment
_OfCluster = StatusRequest | SetWorker | JournalRequest | SignRequest
OperatorRequest = _OfRuns | _OfEpisodes | _OfEnvironments | _OfCluster
_OnRuns = (
    RunCreated | RunProgress | ClaimState | RunOpening | EvaluationStarted | EvaluationPage | FurtherCases
)
_OnCluster = EnvironmentState | EnvironmentsReply | StatusReply | JournalPage | Signed | Done
OperatorReply = _OnRuns | _OnCluster | BlobAck | BlobChunk | Refused
