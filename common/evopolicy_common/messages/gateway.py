"""Messages between a run's gateway and the coordinator.

No message here has a field for a seed, a hidden split, a hidden score, a worker's name or a path: an agent cannot steal
from its gateway what the gateway never receives. A test walks every type in `GatewayReply`.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Plain, Text, Word
from evopolicy_common.messages.environment import (
    EnvironmentDescription,
    FailedEpisodes,
    HiddenEvaluation,
    ObservationForm,
    PolicyScope,
)
from evopolicy_common.messages.episode import BlobRef, PolicyFailure, ResourceLimits, Tier
from evopolicy_common.messages.worker import BlobAck, BlobChunk, BlobGet, BlobPut, Message, Refused

SubmitStatus = Literal[
    "ok",
    "missing_policy",
    "denied_import",
    "import_error",
    "init_error",
    "rollout_timeout",
    "cancelled",
]
"""All verdicts are charged, except `cancelled`: the operator ended the run."""

CANCELLED = "cancelled"
"""The `close_reason` of a run that its operator cancelled."""
VideoOption = Literal["off", "first", "all"]
SimulationRule = Literal["forbidden", "allowed"]
"""Whether the agent's rules allow it to simulate the environment outside its submits."""
FinishRule = Literal["early", "budget"]
"""A run whose agent stops before its budget is spent is scored (`early`), or an error (`budget`)."""
FeedbackDetail = Literal["scores", "trajectories", "pictures"]
"""`scores`: the summary alone; `trajectories`: text too; `pictures`: also files of observations and
videos."""
Profile = Literal["own", "published", "published-data"]
"""All choices of the published protocol together (`run_settings.off_profile`): `published` with the number of hidden
cases in the paper, `published-data` with that of the published case files."""


class Conditions(msgspec.Struct, frozen=True, kw_only=True):
    """Settings that define the experiment besides agent and environment: a run is opened with them, its gateway gets
    them, and `run.json` has them among its dimensions. Runs that differ here are not comparable."""

    policy_scope: PolicyScope = "episode"
    observations: ObservationForm = "arrays"
    video: VideoOption = "off"
    simulation: SimulationRule = "forbidden"
    finish: FinishRule = "early"
    failed_episodes: FailedEpisodes = "play-on"
    """After a failure of the policy, random actions play the episode (`play-on`), or the submit has no mean return and
    its checkpoint is not eligible (`end-submit`)."""
    hidden_evaluation: HiddenEvaluation = "submit"
    """Arguments of a policy on hidden cases: those of its own submit, or those of one list of all cases (`pool`)."""
    profile: Profile = "own"
    """`published`: all choices of the published protocol together, including its public case files."""
    feedback: FeedbackDetail = "pictures"
    """The agent's feedback level."""

    @property
    def conditions(self) -> Conditions:
        """These alone, of settings with more fields."""
        return Conditions(**{name: getattr(self, name) for name in Conditions.__struct_fields__})


class FromGateway(Message, frozen=True, kw_only=True):
    """A request of a run's gateway."""

    run: Word = ""
    token: Word = ""
    """The run's capability; sent with every request and checked each time."""


class OpenRun(FromGateway, frozen=True, kw_only=True, tag="open_run"):
    """The gateway's first request, after every start of either side."""

    asks_permit: bool = False
    """The gateway sends `RequestPermit` before its agent starts. Otherwise the agent may already be on any machine."""


class RequestPermit(FromGateway, frozen=True, kw_only=True, tag="request_permit"):
    """Requests a permit for the run's agent to be alive on a kernel: a long poll, safe to send again. It
    lasts until the run is closed or cancelled, or an operator vouches that the agent has ended."""

    boot_id: Word
    """Boot id of the agent's kernel (`proc.boot_id`); empty: unknown, which counts as every kernel."""
    host: Word = ""
    """Name of that machine, for people."""
    wait_s: Number = 0.0


class Permit(Message, frozen=True, kw_only=True, tag="permit"):
    """The reply to `RequestPermit`."""

    granted: bool
    """False: not granted within `wait_s`; the agent must not start, and the gateway sends the request again."""
    waits_for: Text = ""
    """The reason why the permit waits, in words that reveal nothing about other runs' results."""


FREE_SLOT = "a free slot"
"""A value of `waits_for` that is normal for most submits and no cause for concern."""


class RunState(Message, frozen=True, kw_only=True, tag="run_state"):
    """The changing part of a run, as its gateway may know it; the reply to `StateRequest`."""

    remaining_budget: Int
    n_submits: Int
    """Accepted submits so far."""
    is_finalized: bool
    """True when no more submits are accepted."""
    cancelled: bool = False
    """The operator ended the run."""
    held_s: Number = 0.0
    """Seconds so far in which a submit was open and none of its episodes ran because hidden work had the machines; they
    count against no limit."""
    open_held_s: Number = 0.0
    """Of these, the open submit's, which is the last one; 0.0 without one, as the following fields are empty."""
    n_done: Int = 0
    """Finished episodes of the open submit."""
    waits_for: Text = ""
    """The reason why none of its episodes runs, in words for the agent; empty while episodes run."""


class RunOpened(Message, Conditions, frozen=True, kw_only=True, tag="run_opened"):
    """The run's fixed settings, and its current state."""

    env: EnvironmentDescription
    n_env_instances: Int
    """Number of train cases; the agent's ids are 0 … n − 1."""
    episode_budget: Int
    min_episodes_per_submit: Int
    max_episodes_per_submit: Int
    sandbox_tier: Tier
    limits: ResourceLimits
    allowed_imports: Many[Text]
    denied_imports: Many[Text]
    state: RunState
    max_steps: Int = 0
    """Steps after which an episode is cut, reported to agents as the limit; 0: the environment's own limit."""

    @property
    def announced_steps(self) -> int:
        """The value of `max_episode_steps` that agents and policies receive."""
        return self.max_steps or self.env.max_episode_steps


class StateRequest(FromGateway, frozen=True, kw_only=True, tag="state"):
    """Requests the run's state; answered at once."""


class Submit(FromGateway, frozen=True, kw_only=True, tag="submit"):
    """Evaluate a bundle on train cases. Safe to send again with the same key."""

    key: Word
    """Idempotency key: each key is accepted once."""
    env_instances: Many[Int]
    bundle: Word | None
    """Digest of the snapshot, uploaded beforehand; None when no snapshot of `system/` could be made."""
    bundle_error: PolicyFailure | None = None
    """Why there is no bundle: becomes the verdict, charged as `protocol.md` describes for a bundle without a Policy."""
    tree: Word = ""
    """Digest of the recorded workspace, from which other runs may start; empty: not recorded."""
    after: Int = 0
    """Number of submits that were accepted before; `unknown_submit` of a coordinator that has lost some."""


class SubmitAccepted(Message, frozen=True, kw_only=True, tag="submit_accepted"):
    """The submit is durable and its episodes are charged; also the reply to a repeated key."""

    submit_index: Int
    """Index among the accepted submits, from 0."""
    first_global_episode: Int
    remaining_budget: Int
    """Budget left after this submit, episodes."""


class ResultsRequest(FromGateway, frozen=True, kw_only=True, tag="results"):
    """A long poll for the results of a submit since `cursor`."""

    submit_index: Int
    cursor: Int
    """0 for the first request, then the `cursor` of the last page."""
    wait_s: Number


class EpisodeFeedback(msgspec.Struct, frozen=True, kw_only=True):
    """One train episode, as far as the agent may see it."""

    index: Int
    """Request index."""
    episode_return: Number
    length: Int
    failure: PolicyFailure | None
    reward_components: Named[Number]
    trajectory: BlobRef
    video: BlobRef | None
    stdout: Bytes
    stderr: Bytes
    success: bool | None = None
    """As `EpisodeOutcome.success`."""


class SubmitDone(msgspec.Struct, frozen=True, kw_only=True):
    """A submit's end."""

    status: SubmitStatus
    n_episodes: Int
    env_instances: Many[Int]
    first_global_episode: Int
    remaining_budget: Int
    started_at: Number
    """Time of acceptance, Unix time, seconds."""
    completed_at: Number
    failure: PolicyFailure | None
    """Why the status is not ok; None when it is ok."""
    n_kept: Int
    """Number of episodes with feedback: all when ok; with `rollout_timeout` those before the first unfinished one."""


class ResultsPage(Message, frozen=True, kw_only=True, tag="results_page"):
    """Episodes in order of arrival; none before it is known that the submit yields a Policy."""

    cursor: Int
    episodes: Many[EpisodeFeedback]
    done: SubmitDone | None
    """Set on the last page."""
    waits_for: Text = ""
    held_s: Number = 0.0
    """As in `RunState`."""
    more: bool = False
    """Whether the next page has episodes already."""


class CloseRun(FromGateway, frozen=True, kw_only=True, tag="close_run"):
    """No more submits will follow. Sent after the agent and all its children have ended; finalisation waits for it."""

    reason: Text
    """As `closed_reason` of `run.json` lists them."""
    agent: Plain = {}
    """The gateway's facts about the agent for `run.json`: turns, retries, tokens, version."""
    after: Int = 0
    """As in `Submit`."""


class RunClosed(Message, frozen=True, kw_only=True, tag="run_closed"):
    """The close was recorded; only the operator receives the outcome."""


GatewayRequest = (
    OpenRun | RequestPermit | StateRequest | Submit | ResultsRequest | CloseRun | BlobPut | BlobGet
)
GatewayReply = (
    RunOpened | Permit | RunState | SubmitAccepted | ResultsPage | RunClosed | BlobAck | BlobChunk | Refused
)
