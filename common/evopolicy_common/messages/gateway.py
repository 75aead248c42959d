"""What a run's gateway and the coordinator say to each other.

No message here has a field for a seed, a hidden split, a hidden score, a worker's name or a path: what a gateway cannot
be told, an agent cannot steal from it. A test walks every type in `GatewayReply`.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Plain, Text, Word
from evopolicy_common.messages.environment import (
    EnvironmentDescription,
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
    "quarantined",
    "cancelled",
]
"""`cancelled`: the operator ended the run meanwhile, and nothing was charged. All others were charged. `quarantined`: only of
submits that a coordinator of an earlier version ended."""

CANCELLED = "cancelled"
"""Why an operator's cancelled run takes no more submits: `close_reason`."""
VideoOption = Literal["off", "first", "all"]
SimulationRule = Literal["forbidden", "allowed"]
"""Whether the agent's rules let it simulate the environment outside its submits."""
FinishRule = Literal["early", "budget"]
"""Whether a run whose agent stops before its budget is spent is scored, or is an error."""
Profile = Literal["own", "published"]
"""`published`: all choices of the published protocol together (`operator.off_profile`)."""


class OpenRun(Message, frozen=True, kw_only=True, tag="open_run"):
    """The gateway's first word, after every start of either side."""

    run: Word
    token: Word
    """The run's capability; sent with every request and checked on each."""
    asks_permit: bool = False
    """The gateway sends `RequestPermit` before its agent starts. Without it the agent may be on any machine already."""
    reads_rendered: bool = False
    """The gateway reads episodes that workers have rendered (`records.rendered`); those of earlier versions do not."""


class RequestPermit(Message, frozen=True, kw_only=True, tag="request_permit"):
    """Ask that the run's agent may be alive on a kernel: a long poll, safe to send again.

    The permit lasts until the run is closed or cancelled, or its machine has another boot id.
    """

    run: Word
    token: Word
    boot_id: Word
    """Of the kernel that the agent runs on (`host.boot_id`); empty: unknown, which counts as every kernel."""
    machine_id: Word = ""
    """Of that machine (`host.machine_id`), the same over reboots; empty: unknown."""
    host: Word = ""
    """Its name, for people."""
    wait_s: Number = 0.0


class Permit(Message, frozen=True, kw_only=True, tag="permit"):
    """The answer to `RequestPermit`."""

    granted: bool
    """False: not within `wait_s`; the agent must not start, and the gateway asks again."""
    waits_for: Text = ""
    """What it waits for, in words that tell nothing of other runs' results."""


FREE_SLOT = "a free slot"
"""What most submits wait for at times, and no cause for concern: one of `waits_for`."""


class SubmitInFlight(msgspec.Struct, frozen=True, kw_only=True):
    """The submit that runs now."""

    submit_index: Int
    n_episodes: Int
    n_done: Int
    waits_for: Text = ""
    """What it waits for when nothing of it runs, in words for the agent; empty while episodes run."""
    held_s: Number = 0.0
    """Seconds for which none of its episodes ran because hidden work had the machines; they count against no limit."""


class RunState(msgspec.Struct, frozen=True, kw_only=True):
    """What changes of a run, as its gateway may know it."""

    remaining_budget: Int
    n_submits: Int
    """Accepted submits so far."""
    is_finalized: bool
    """True when no more submits are taken."""
    in_flight: SubmitInFlight | None = None
    cancelled: bool = False
    """The operator ended the run."""
    held_s: Number = 0.0
    """The same seconds of all the run's submits so far."""


class RunOpened(Message, frozen=True, kw_only=True, tag="run_opened"):
    """All that is fixed for the run, and its state now."""

    env: EnvironmentDescription
    n_env_instances: Int
    """Train cases: the agent's ids are 0 … n − 1."""
    episode_budget: Int
    min_episodes_per_submit: Int
    max_episodes_per_submit: Int
    policy_scope: PolicyScope
    observations: ObservationForm
    sandbox_tier: Tier
    video: VideoOption
    limits: ResourceLimits
    allowed_imports: Many[Text]
    denied_imports: Many[Text]
    state: RunState
    simulation: SimulationRule = "forbidden"
    finish: FinishRule = "early"
    max_steps: Int = 0
    """Steps after which an episode is cut, and which agents are told as the limit; 0: the environment's own."""

    @property
    def told_steps(self) -> int:
        """What agents and policies are told as `max_episode_steps`."""
        return self.max_steps or self.env.max_episode_steps


class StateRequest(Message, frozen=True, kw_only=True, tag="state"):
    """How the run stands; answered at once."""

    run: Word
    token: Word


class StateReply(Message, frozen=True, kw_only=True, tag="state_reply"):
    """The answer to `StateRequest`."""

    state: RunState


class Submit(Message, frozen=True, kw_only=True, tag="submit"):
    """Evaluate a bundle on train cases. Safe to send again with the same key."""

    run: Word
    token: Word
    key: Word
    """Idempotency key: one accepted submit for each."""
    env_instances: Many[Int]
    bundle: Word | None
    """Digest of the snapshot, uploaded before; None when `system/` could not be snapshot."""
    bundle_error: PolicyFailure | None = None
    """Why there is no bundle: becomes the verdict, charged as `protocol.md` says of a bundle without a Policy."""


class SubmitAccepted(Message, frozen=True, kw_only=True, tag="submit_accepted"):
    """The submit is durable and its episodes are charged; also the answer to a repeated key."""

    submit_index: Int
    """Counts accepted submits from 0."""
    first_global_episode: Int
    remaining_budget: Int
    """After this submit."""


class ResultsRequest(Message, frozen=True, kw_only=True, tag="results"):
    """A long poll for what has happened to a submit since `cursor`."""

    run: Word
    token: Word
    submit_index: Int
    cursor: Int
    """0 at first, then the last page's."""
    wait_s: Number


class EpisodeFeedback(msgspec.Struct, frozen=True, kw_only=True):
    """One train episode as the agent may see it."""

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
    """When it was accepted, Unix time, seconds."""
    completed_at: Number
    failure: PolicyFailure | None
    """Why the status is not ok; None when it is."""
    n_kept: Int
    """Episodes whose feedback is kept: all when ok; with `rollout_timeout` those before the first unfinished."""


class ResultsPage(Message, frozen=True, kw_only=True, tag="results_page"):
    """Episodes in order of arrival; none before the submit is known to yield a Policy."""

    cursor: Int
    episodes: Many[EpisodeFeedback]
    done: SubmitDone | None
    """Set on the page after which nothing more comes."""
    waits_for: Text = ""
    held_s: Number = 0.0
    """As in `RunState`."""


class CloseRun(Message, frozen=True, kw_only=True, tag="close_run"):
    """No more submits: sent once the agent and all its children are gone, which finalisation waits for."""

    run: Word
    token: Word
    reason: Text
    """`budget_spent`, `agent_stopped`, `agent_failed`, `silent`, `wall_limit`, `cancelled`."""
    agent: Plain = {}
    """What the gateway has to say of the agent for `run.json`: turns, retries, tokens, version."""


class RunClosed(Message, frozen=True, kw_only=True, tag="run_closed"):
    """Taken; the outcome goes to the operator only."""


GatewayRequest = (
    OpenRun | RequestPermit | StateRequest | Submit | ResultsRequest | CloseRun | BlobPut | BlobGet
)
GatewayReply = (
    RunOpened | Permit | StateReply | SubmitAccepted | ResultsPage | RunClosed | BlobAck | BlobChunk | Refused
)
