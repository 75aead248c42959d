"""A job, what limits it, and what came of it: what passes between coordinator and worker about episodes."""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Bytes, Int, Many, Named, Number, Plain, Text, Word
from evopolicy_common.messages.environment import Case, ObservationForm, PolicyScope

FailureCategory = Literal[
    # The bundle does not yield a Policy; decided by the episode at request index 0.
    "missing_policy",
    "denied_import",
    "import_error",
    "init_error",
    # One episode's failure: the episode goes on with keyed uniform random actions.
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
"""Failure categories which, at request index 0, become the whole submit's verdict."""

TIME_LIMITS: frozenset[str] = frozenset({"act_timeout", "episode_timeout", "cpu_limit"})
"""Failure categories that the summary lists under `timeouts` too."""

Record = Literal["full", "actions"]
"""What a worker keeps of an episode: the whole trajectory, or for hidden episodes the action log only."""

Tier = Literal["bwrap", "landlock", "none"]


class ResourceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """What one episode's policy may use. All are visible in `/info.resource_limits`."""

    episode_wall_s: Number = 600.0
    """Wall time of the policy's own work in one episode (import, init, reset, acts), seconds."""
    act_wall_s: Number = 20.0
    """Wall time of one `act` or `reset`, seconds."""
    init_wall_s: Number = 60.0
    """Wall time of importing the bundle and building the Policy, seconds."""
    cpu_s: Number = 300.0
    """CPU time of the policy process in one episode, seconds."""
    memory_bytes: Int = 1 << 30
    """Address space that the policy may add to what Python and the allowed packages take, bytes."""
    processes: Int = 16
    """Threads of the policy process; it may start no process."""
    file_bytes: Int = 64 << 20
    """What it may write to its copy of `system/` and `/tmp`, bytes together."""
    files: Int = 4096
    """Files and folders that it may make there, beside its bundle's."""
    open_files: Int = 256
    """Its open file descriptors, the five that it starts with among them."""
    output_bytes: Int = 64 << 10
    """What is kept of each of stdout and stderr of an episode, bytes."""
    action_bytes: Int = 16 << 10
    """What one action may take beyond 16 bytes for each number or character that the action space has, bytes; it may be
    made of as many values as there are 16 bytes in that."""
    episode_action_bytes: Int = 4 << 20
    """What the actions of an episode may take together beyond what the action space needs, bytes."""
    feedback_bytes: Int = 16 << 30
    """What the files of all the run's episodes may take together, bytes. Each episode has an equal share, whatever others take:
    what is written must not depend on which was done first. Beyond it its video is left out, then its observations, then its rows."""
    submit_wall_s: Number | None = None
    """Wall time of a whole submit, seconds; None (the default) for no limit."""


LARGEST_LIMITS: dict[str, int] = {
    # Feedback keeps no more, and an outcome has to fit into a message.
    "output_bytes": 64 << 10,
    "action_bytes": 1 << 20,
    "episode_action_bytes": 64 << 20,
}
"""Limits that cannot be set higher."""
LARGEST_LIMIT = 1 << 53
"""The same for all others."""


class BlobRef(msgspec.Struct, frozen=True, kw_only=True):
    """Names bytes in a content-addressed store, or carries them where they are few."""

    digest: Word
    """SHA-256 of the bytes, lowercase hex."""
    size: Int
    inline: Bytes | None = None
    """The bytes themselves; None when they must be fetched by digest."""


class EpisodeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One episode to play."""

    index: Int
    """Request index: position in the submit's (or split's) list."""
    episode_index: Int
    """What the policy's `reset` is given."""
    case: Case
    policy_seed: Bytes
    """16 bytes that seed the policy process's generators and the random actions that replace a failed policy."""
    replay: BlobRef | None = None
    """A trajectory (of either record) whose actions are played in place of a policy's, to see whether the environment
    answers as it did; None for an episode of the job's own policy."""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """Work that is leased as one piece: one episode, or with policy scope `submit` a submit's episodes in order."""

    job_id: Word
    env: Word
    bundle: Word | None
    """Digest of the policy's bundle; None for keyed uniform random actions without a policy process."""
    episodes: Many[EpisodeSpec]
    policy_scope: PolicyScope = "episode"
    policy_every: Int = 0
    """With scope `submit`: a new Policy every that many episodes; 0 for one Policy through all."""
    env_meta: Plain = {}
    """Handed to `Policy.__init__` without the spaces, which the worker adds."""
    observations: ObservationForm = "arrays"
    record: Record = "full"
    render: bool = False
    """With record "full": report the feedback files themselves (`records.rendered`), which their reader only unpacks."""
    video: bool = False
    """Also record a video of each episode (a rendered frame a row)."""
    video_episodes: Int = 0
    """With `video`: only of the job's first so many episodes; 0 for all."""
    tier: Tier = "bwrap"
    """The sandbox tier that the run demands."""
    limits: ResourceLimits = ResourceLimits()
    max_steps: Int = 0
    """An episode is cut after so many steps; 0: only its environment ends it."""
    begun: BlobRef | None = None
    """What the policy returned in an earlier attempt, and stands (`JobResult.begun`); None: the job begins anew."""


class PolicyFailure(msgspec.Struct, frozen=True, kw_only=True):
    """How a policy failed in one episode. A result, never a fault of ours."""

    category: FailureCategory
    step_index: Int | None
    """Step at which `act` failed, counted from 0; None before the first step."""
    message: Text
    traceback: Text = ""
    limit: Number | None = None
    """Value of the limit that was hit, in its own unit; None when no limit was."""
    used: Number | None = None
    """What the policy had used of it."""


class EpisodeOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """What one episode came to."""

    index: Int
    episode_return: Number
    """Sum of the rewards; always finite."""
    length: Int
    """Steps played."""
    terminated: bool
    truncated: bool
    failure: PolicyFailure | None = None
    reward_components: Named[Number] = {}
    """Per-episode sum of each of the environment's reward components."""
    success: bool | None = None
    """Whether the task was solved, by the environment's own word; None where it tells none."""
    trajectory: BlobRef | None = None
    """`trajectory` codec bytes: the whole episode, or with record `actions` the action log. Of a job with `render` those of
    `rendered`; workers of earlier versions do not know that."""
    video: BlobRef | None = None
    """MP4 bytes."""
    stdout: Bytes = b""
    stderr: Bytes = b""
    wall_s: Number = 0.0
    """Wall time from the policy's start to the last step, seconds."""
    policy_cpu_s: Number = 0.0
