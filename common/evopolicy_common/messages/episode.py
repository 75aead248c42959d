"""Jobs, their limits, and the outcomes of episodes, as coordinator and worker exchange them."""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Blob, Bytes, Int, Many, Named, Number, Plain, Text, Word
from evopolicy_common.messages.environment import Case, FailedEpisodes, ObservationForm, PolicyScope

FailureCategory = Literal[
    # The bundle does not yield a Policy; decided by the episode at request index 0.
    "missing_policy",
    "denied_import",
    "import_error",
    "init_error",
    # One episode's failure: the episode continues with keyed uniform random actions.
    "reset_error",
    "act_error",
    "act_timeout",
    "episode_timeout",
    "cpu_limit",
    "oom",
    "process_limit",
    "file_limit",
    "killed",
]

NO_POLICY: frozenset[str] = frozenset({"missing_policy", "denied_import", "import_error", "init_error"})
"""Failure categories that become the whole submit's verdict at request index 0."""

TIME_LIMITS: frozenset[str] = frozenset({"act_timeout", "episode_timeout", "cpu_limit"})
"""Failure categories that the summary also lists under `timeouts`."""

RANDOM = -1
"""Submit index of the random reference."""

Record = Literal["full", "actions"]
"""A worker's record of an episode: the whole trajectory, or (for hidden episodes) only the action log."""

Tier = Literal["bwrap", "landlock", "none"]


class ResourceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of one episode's policy. `/info.resource_limits` shows all of them."""

    episode_wall_s: Number = 600.0
    """Wall time of the policy's work in one episode, seconds."""
    act_wall_s: Number = 20.0
    """Wall time of one `act` or `reset`, seconds."""
    init_wall_s: Number = 60.0
    """Wall time of importing the bundle and building the Policy, seconds."""
    cpu_s: Number = 300.0
    """CPU time of the policy process in one episode, seconds."""
    memory_bytes: Int = 1 << 30
    """Address space of the policy beyond that of Python and the allowed packages, bytes."""
    processes: Int = 16
    """Threads of the policy process; it may start no other process."""
    file_bytes: Int = 64 << 20
    """Bytes that the policy may write to its copy of `system/` and to `/tmp`, together."""
    files: Int = 4096
    """Files and folders that it may create there, besides its bundle's."""
    open_files: Int = 256
    """Open file descriptors, with the five of its start."""
    output_bytes: Int = 64 << 10
    """Bytes kept of an episode's stdout, and of its stderr."""
    action_bytes: Int = 16 << 10
    """Size of one action beyond 16 bytes for each number or character of the action space, bytes. It may have one
    value for every 16 bytes."""
    episode_action_bytes: Int = 4 << 20
    """The same, of all actions of an episode."""
    feedback_bytes: Int = 16 << 30
    """Size of all episodes' files of the run, bytes. Beyond an equal share, an episode loses its video, then its
    observations, then its rows."""
    submit_wall_s: Number | None = None
    """Wall time of a whole submit, seconds; None for no limit."""


LARGEST_LIMITS: dict[str, int] = {
    # Feedback keeps no more than this, and an outcome has to fit into a message.
    "output_bytes": 64 << 10,
    "action_bytes": 1 << 20,
    "episode_action_bytes": 64 << 20,
}
LARGEST_LIMIT = 1 << 53


class BlobRef(msgspec.Struct, frozen=True, kw_only=True):
    """A reference to bytes in a content-addressed store; small ones are carried inline."""

    digest: Word
    """SHA-256 of the bytes, lowercase hex."""
    size: Int
    inline: Blob | None = None
    """The bytes themselves; None when they must be fetched by digest."""


class EpisodeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One episode to play."""

    index: Int
    """Request index: position in the submit's list or in the split."""
    episode_index: Int
    """Passed to the policy's `reset`."""
    case: Case
    policy_seed: Bytes
    """16 bytes that seed the policy process's generators and the random actions that replace a failed policy's."""
    replay: BlobRef | None = None
    """A trajectory (of either record) whose actions are played in place of a policy's, to check that the environment
    responds as before; None for an episode of the job's own policy."""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """The unit of leasing: one episode, or with policy scope `submit` all episodes of a submit in order."""

    job_id: Word
    env: Word
    bundle: Word | None
    """Digest of the policy's bundle; None for keyed uniform random actions without a policy process."""
    episodes: Many[EpisodeSpec]
    policy_scope: PolicyScope = "episode"
    policy_every: Int = 0
    """With scope `submit`: a new Policy after this many episodes; 0 for one Policy throughout."""
    env_meta: Plain = {}
    """Passed to `Policy.__init__`; the worker adds the spaces."""
    observations: ObservationForm = "arrays"
    record: Record = "full"
    render: bool = False
    """With record "full": report finished feedback files (`records.episodes.rendered`)."""
    video: bool = False
    """Also record a video of each episode (one rendered frame per row)."""
    video_episodes: Int = 0
    """With `video`: record only the job's first this many episodes; 0 for all."""
    tier: Tier = "bwrap"
    """The sandbox tier that the run requires."""
    limits: ResourceLimits = ResourceLimits()
    max_steps: Int = 0
    """An episode is cut after this many steps; 0: only its environment ends it."""
    failed_episodes: FailedEpisodes = "play-on"
    published: bool = False
    """Of a run in a published profile: actions are read, and spaces described, as the published software does."""
    begun: BlobRef | None = None
    """The policy's actions of an earlier attempt, which remain valid (`JobResult.begun`); None for a first attempt."""
    environment_faults: Int = 0
    """How many earlier attempts the environment has ended, by hanging or otherwise (`JobResult.environment_fault`)."""


class PolicyFailure(msgspec.Struct, frozen=True, kw_only=True):
    """How a policy failed in one episode. It is a result, not an infrastructure failure."""

    category: FailureCategory
    step_index: Int | None
    """Step at which `act` failed, counted from 0; None before the first step."""
    message: Text
    traceback: Text = ""
    limit: Number | None = None
    """Value of the exceeded limit, in its own unit; None when it was no limit."""
    used: Number | None = None
    """The policy's use of that limit, in the same unit."""


class EpisodeOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """The result of one episode."""

    index: Int
    episode_return: Number
    """Sum of the rewards; always finite."""
    length: Int
    """Number of steps played."""
    terminated: bool
    truncated: bool
    failure: PolicyFailure | None = None
    reward_components: Named[Number] = {}
    """Sum over the episode of each of the environment's reward components."""
    success: bool | None = None
    """Whether the task was solved, as the environment reports it; None where it reports nothing."""
    trajectory: BlobRef | None = None
    """Bytes of the `trajectory` codec: the whole episode, or with record `actions` the action log. For a job with
    `render`, bytes of `rendered`."""
    video: BlobRef | None = None
    """MP4 bytes."""
    stdout: Bytes = b""
    stderr: Bytes = b""
    wall_s: Number = 0.0
    """Wall time from the policy's start to the last step, seconds."""
    policy_cpu_s: Number = 0.0
