"""The episode loop: one environment and one policy process, step by step, in the environment's process.

Rules:
- The policy receives observations, and `Policy.__init__` the spaces and `env_meta`; never a seed, a reward, or an info.
- After a policy fails, uniform random actions keyed by the policy seed replace its own to the end of the episode, and
  every row with such an action has `policy_failed`. An action outside the space is repaired, and its row marked.
- With `failed_episodes` = "end-submit", the episode ends after one such action, or has no step if the policy failed
  before its first `act`.
- When a recording is replayed, its actions replace the policy's, up to its last step. The episode then stops, even if
  the environment did not end it.
- Between a policy's calls the same work is done in every split, since a policy can measure the time: each step is
  recorded as feedback has it, although hidden episodes keep only the actions. `_Course` owns the recordings and this
  balance.
  Pictures are compressed after the end as far as memory allows (`rendered.HELD_BYTES`).
- A video is made from the episode's actions after the job's last policy has ended (see `video.py`); the episode itself
  never renders, and no policy waits for a video.
- A policy's failure is a result, and so is the effect of its actions on the environment. Other failures of environment
  or sandbox are raised.
- An episode is repeated in `JobPlayer._play` alone. The actions that the policy returned remain valid, and so does its
  failure: no policy gets a second attempt. An environment that is not deterministic would answer them with another
  episode, so there the episode starts over.

An attempt at an episode, by where its actions come from (`_Episode._source`):

| state | event | next |
|---|---|---|
| begin | the policy is loaded and reset | asked |
| | the policy fails | random; ended if it is the submit's verdict, or with "end-submit" |
| | no bundle, or an earlier attempt's policy has failed | random, after the actions that were returned |
| | a recording is given | recorded |
| asked | the policy returns an action; those of an earlier attempt are played in its place | asked |
| | the policy fails | random, from this step on |
| asked, recorded, random | the environment ends, the step limit, or the last recorded step | ended |
| random | "end-submit": after one action | ended |
| any | the job is cancelled | CancelledJobError |
| any | the policy's process is ended from outside | begin, at most `MAX_ENDS` times; raised with scope "submit" |
| any, the policy has acted | the environment breaks down | begin, all actions random, the policy has failed |
| any, it has not | the environment breaks down | raised |
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import itertools
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from evopolicy_common.catalogue import is_shipped
from evopolicy_common.errors import (
    BrokenEnvironmentError,
    EvopolicyError,
    SandboxError,
    SlotDiedError,
    WorkerError,
)
from evopolicy_common.messages.bounds import LARGEST
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import (
    LARGEST_LIMITS,
    NO_POLICY,
    BlobRef,
    EpisodeOutcome,
    EpisodeSpec,
    Job,
    PolicyFailure,
    ResourceLimits,
)
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.rendered import Renderer
from evopolicy_common.records.episodes.trajectory import Recorder, decode
from evopolicy_common.wire import codec
from evopolicy_worker import environments
from evopolicy_worker.environments import Environment
from evopolicy_worker.environments.interface.actions import ActionCodec, compile_actions
from evopolicy_worker.environments.interface.base import Observation, Step
from evopolicy_worker.environments.interface.calls import current as call
from evopolicy_worker.environments.interface.calls import described, note
from evopolicy_worker.environments.interface.trial import solved
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policies import CancelledJobError, Policies, RunningJob
from evopolicy_worker.episodes.policy_process import PolicyFailedError, PolicyProcess
from evopolicy_worker.episodes.video import VideoRecorder
from evopolicy_worker.sandbox.inside.policy_server import reset_floats
from evopolicy_worker.sandbox.jail import PolicyJail
from evopolicy_worker.sandbox.zygote import Zygote
from evopolicy_worker.slot_protocol import endings
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slot_protocol.begun import ActionLog, Returned, RunningEpisode, is_kept, unpack
from evopolicy_worker.slot_protocol.endings import EndedFromOutsideError

MAX_FAULT = 4000
"""Characters of an error that are reported."""
MAX_JOB_OUTPUT_BYTES = 64 << 20
"""Limit for the stored stdout, stderr, and tracebacks of a job. Each episode has an equal share; 327 episodes can use
their own limits fully."""
MAX_ENDS = 5
"""Number of times that one episode's policy is restarted here after an end from outside; then another worker plays
the job."""
MAX_WARM_ENVIRONMENTS = 4
"""Environments kept for later jobs: all sixteen in one process would take 230 MB."""

INVALID, FAILED = "action_invalid", "policy_failed"
"""Marks: the action was outside the space and was repaired; it is random, in place of a failed policy's."""
Source = Callable[[int, Observation], tuple[Any, Any, str]]
"""From a step's index and observation to the action as returned, as repaired, and its mark or ""."""
_ACTING = messages.framed(messages.Acting())
_Tell = Callable[[bytes], None]


class JobPlayer:
    """Plays jobs one after another with warm environments and a zygote."""

    def __init__(self, zygote: Zygote, jail: PolicyJail, monitor: Monitor, scratch: Path) -> None:
        self.policies = Policies(zygote, jail, monitor, scratch)
        self._environments: OrderedDict[str, Environment] = OrderedDict()
        self._videos = VideoRecorder()
        self._log = ActionLog(scratch)

    def play_job(
        self,
        job: Job,
        files: messages.BundleFiles | None,
        progress: RunningJob,
        tell: _Tell,
        first: int = 0,
        failure: PolicyFailure | None = None,
    ) -> bytes:
        """Plays the job's episodes in order, and passes each outcome to `tell` as a framed `Finished`, except for the
        last, which is returned. Videos follow likewise, as `Filmed`. `files`: its bundle.

        Starts at index `first`. If `failure` is given, the policy has failed in that episode, which is played without
        it. Raises CancelledJobError; WorkerError, SandboxError or SlotDiedError for failures that are not the policy's.
        """
        environment = self._environment(job.env)
        job = msgspec.structs.replace(job, limits=_within_share(job))
        if job.bundle is not None and files is None:
            raise WorkerError("a job with a bundle came without the bundle")
        self.policies.begin_job(job, files, environment, progress)
        repeats = environment.description.deterministic
        before = unpack(job) if repeats else {}
        frame = b""
        films: list[tuple[int, bytes, int]] = []
        """Videos to make: the episode's index in the job, its actions and length."""
        try:
            progress.episodes_done = first
            for k in range(first, len(job.episodes)):
                if frame:
                    tell(frame)
                if progress.cancelled:
                    raise CancelledJobError
                begun = (
                    before[k].unpacked()
                    if failure is None and k in before
                    else RunningEpisode(failure=failure)
                )
                if is_kept(job):
                    progress.begun = k, begun
                if job.bundle is not None:
                    self._log.begins(job.job_id, k, begun)
                outcome, frame, log = self._play(k, job, progress, tell, begun)
                if log and job.video and (not job.video_episodes or k < job.video_episodes):
                    films.append((k, log, outcome.length))
                progress.episodes_done += 1
                failure = outcome.failure
                if failure is not None and _verdict_of_submit(job, job.episodes[k], failure):
                    none = msgspec.structs.replace(
                        outcome, stdout=b"", stderr=b"", wall_s=0.0, policy_cpu_s=0.0
                    )
                    others = (
                        msgspec.structs.replace(none, index=each.index) for each in job.episodes[k + 1 :]
                    )
                    finished = (messages.Finished(outcome=_brief(each, _share(job))) for each in others)
                    # Joined once: there may be thousands, each with a traceback.
                    frame = b"".join((frame, *map(messages.framed, finished)))
                    break
                failure = None
        finally:
            progress.policy = None
            self.policies.drop()
        if not job.video:
            self._videos.close()
        for k, log, length in films:
            if frame:
                tell(frame)
            case, description = job.episodes[k].case, self._environment(job.env).description
            mp4 = self._videos.record(description, case, log, length, lambda: progress.cancelled)
            if progress.cancelled:
                raise CancelledJobError
            frame = b"" if mp4 is None else messages.framed(messages.Filmed(place=k, video=_blob(mp4)))
        return frame

    def _play(
        self, k: int, job: Job, progress: RunningJob, tell: _Tell, begun: RunningEpisode
    ) -> tuple[EpisodeOutcome, bytes, bytes]:
        """As `_Episode.play_episode`, from `begun` on; repeated after ends that are not the episode's own."""
        n_ends = 0
        while True:
            environment = self._environment(job.env)
            episode = _Episode(job, k, job.episodes[k], environment, self.policies, progress, tell, begun)
            try:
                return episode.play_episode()
            except EndedFromOutsideError as error:
                # Where one policy plays several episodes it took with it what it had learned.
                n_ends += 1
                if progress.cancelled or job.policy_scope == "submit" or n_ends > MAX_ENDS:
                    raise
                note(f"a policy is started again: {fault_of(error)}")
                self.policies.drop()
                if not environment.description.deterministic:
                    begun.taken.clear()
            except (CancelledJobError, SandboxError, SlotDiedError, OSError, MemoryError):
                raise
            except BaseException as error:  # such as an environment's sys.exit
                if progress.cancelled or not episode.acted:
                    raise
                # The same actions would fail again, and another worker would give the policy a second attempt.
                note(f"{job.env} broke down on a policy's actions: {fault_of(error)}")
                begun.taken.clear()
                begun.fail(begun.failure or endings.BROKE_DOWN)
                with contextlib.suppress(BaseException):  # of what broke down
                    self._environments.pop(job.env).close()

    def describe(self, env_id: str) -> EnvironmentDescription:
        """An environment's description. The environment is created for it and kept for later jobs. Raises WorkerError
        when it cannot be created."""
        if not is_shipped(env_id):
            return environments.describe(env_id)
        return environments.measured(self._environment(env_id))

    def _environment(self, env_id: str) -> Environment:
        environment = self._environments.get(env_id)
        if environment is None:
            while len(self._environments) >= MAX_WARM_ENVIRONMENTS:
                self._environments.popitem(last=False)[1].close()
            gc.unfreeze()
            environment = self._environments[env_id] = environments.make(env_id)
            # To search all that is loaded for garbage takes as long as an episode.
            gc.freeze()
        self._environments.move_to_end(env_id)
        return environment


@dataclass
class _Episode:
    job: Job
    k: int
    """The episode's index in the job."""
    spec: EpisodeSpec
    environment: Environment
    policies: Policies
    progress: RunningJob
    tell: _Tell
    begun: RunningEpisode
    """The policy's earlier actions. It is asked for them again, but they remain; random ones follow a failure."""
    acted: bool = False
    """Whether an action of the policy's has reached the environment."""

    def play_episode(self) -> tuple[EpisodeOutcome, bytes, bytes]:
        """The outcome, without a video; the same as a framed `Finished`; the log of actions if it was kept."""
        job, begun = self.job, self.begun
        outcome, log, unused = self._outcome()
        kept = None
        if len(job.episodes) > 1 and (is_kept(job) or (job.bundle and job.policy_scope == "submit")):
            # In every split, as a policy of several episodes can measure the pause between them.
            packed = begun.packed()
            kept = packed if is_kept(job) else None
        finished = messages.Finished(outcome=_brief(outcome, _share(job)), begun=kept, unused=unused)
        return outcome, messages.framed(finished), log

    def _outcome(self) -> tuple[EpisodeOutcome, bytes, bytes]:
        """The outcome, the log of actions, and feedback that nobody may read."""
        job, spec, begun = self.job, self.spec, self.begun
        start = time.monotonic()
        recorded: list[Returned] | None = None
        if spec.replay is not None:
            if spec.replay.inline is None:
                raise WorkerError(f"episode {spec.index} came without the recording that it plays")
            recorded = [(row.action, row.action) for row in decode(spec.replay.inline).rows()]
        course = _Course(job, self.environment, recorded)
        policy = self._begin() if job.bundle is not None and begun.failure is None else None
        unplayed = begun.failure is not None and _verdict_of_submit(job, spec, begun.failure)
        at_once = begun.failure is not None and begun.failure.step_index is None and not begun.taken
        if not (unplayed or (at_once and job.failed_episodes == "end-submit") or recorded == []):
            self._steps(self._source(policy, recorded), course)
        wall_s = time.monotonic() - start
        ended = self.policies.release()
        outcome = EpisodeOutcome(
            index=spec.index,
            episode_return=course.total,
            length=course.length,
            terminated=course.terminated,
            truncated=course.truncated,
            failure=begun.failure,
            stdout=ended.stdout,
            stderr=ended.stderr,
            wall_s=wall_s,
            policy_cpu_s=ended.cpu_s,
        )
        if unplayed:
            return outcome, b"", b""
        rows, log = course.finish(job)
        feedback, kept = _blob(rows), _blob(log)
        # An agent's feedback has only the success that the environment's description names.
        told = job.record != "full" or self.environment.description.success
        outcome = msgspec.structs.replace(
            outcome,
            reward_components=course.sums,
            success=course.success if told else None,
            trajectory=feedback if job.record == "full" else kept,
        )
        return outcome, log, rows if job.record != "full" else b""

    def _begin(self) -> PolicyProcess | None:
        """The policy, told of the new episode; None, with the failure noted, when it failed before its first act."""
        try:
            policy = self.policies.take_policy(self.k, self.spec)
            policy.reset(self.spec.episode_index)
            return policy
        except PolicyFailedError as error:
            self._keep_failure(error.failure)
            return None

    def _keep_failure(self, failure: PolicyFailure, step: int | None = None) -> None:
        if self.progress.cancelled:
            raise CancelledJobError
        self.begun.fail(msgspec.structs.replace(failure, step_index=step))

    def _source(self, policy: PolicyProcess | None, recorded: list[Returned] | None = None) -> Source:
        """The policy's actions, the recorded ones, or random ones after those that a policy has returned."""
        codec, begun = self.environment.action_codec, self.begun
        if self.job.published:
            codec = compile_actions(self.environment.description.action_space, published=True)
        if policy is not None:
            return _asked(codec, policy, begun)
        if recorded is not None:
            return _replayed(codec, recorded)
        mark, rng = FAILED if self.job.bundle is not None else "", random_actions(self.spec.policy_seed)
        return _replayed(codec, begun.taken, lambda t, obs: (action := codec.sample(rng), action, mark))

    def _steps(self, source: Source, course: _Course) -> None:
        """Plays from reset to the end."""
        progress, taken, step, add = self.progress, self.begun.taken, self.environment.step, course.add
        # A library that was compiled for speed may change rounding for the whole process when it is loaded,
        # and an episode must not depend on those that were played before it.
        reset_floats()
        obs = self.environment.reset(self.spec.case)
        for t in itertools.count():
            try:
                returned, action, mark = source(t, obs)
            except PolicyFailedError as error:
                self._keep_failure(error.failure, t)
                source = self._source(None)
                returned, action, mark = source(t, obs)
            if not self.acted and t < len(taken):
                self.acted = True
                self.tell(_ACTING)
            result = step(action)
            progress.steps += 1
            if add(obs, returned, action, mark, result):
                break
            if progress.cancelled:
                raise CancelledJobError
            obs = result.obs
        for name, value in (("reward", course.total), *course.sums.items()):
            if not abs(value) <= LARGEST:
                raise BrokenEnvironmentError(
                    f"environment {self.job.env}, {name}: its sum over {course.length} steps is {value};"
                    f" rewards, their components, and their sums have to be finite, at most {LARGEST:g}"
                )


class _Course:
    """An episode so far: its sums, how it ended, and what is recorded of it."""

    def __init__(self, job: Job, environment: Environment, recorded: list[Returned] | None) -> None:
        description = environment.description
        self.total, self.length = 0.0, 0
        self.sums = dict.fromkeys(description.reward_components, 0.0)
        self.terminated = self.truncated = False
        self.success: bool | None = None
        self._solves = description.success or environment.solved_by
        self._ever = description.success_at == "any"
        self._truncated_at = job.max_steps or sys.maxsize
        self._n_recorded = len(recorded or ())
        self._last_mark = FAILED if job.failed_episodes == "end-submit" else None
        self._form = job.observations
        self.full: Recorder | None = None
        """Of everything, as feedback has it, with the actions as the policy returned them."""
        if job.record == "full" and not job.render:
            self.full = Recorder("full", job.observations)
        elif job.record == "full" or job.bundle is not None:
            self.full = Renderer(job.observations, description.obs_storage)
        self._played: list[tuple[Any, float]] = []
        """The actions as played, with their rewards, which hidden results and videos need."""

    def add(self, obs: Any, returned: Any, action: Any, mark: str, step: Step) -> bool:
        """Adds the step that follows `obs`; whether the episode ends with it."""
        _, reward, terminated, truncated, info = step
        length = self.length = self.length + 1
        truncated = truncated or length >= self._truncated_at
        if sums := self.sums:
            components = info.get("rewards", info)
            for name in sums:
                part = components.get(name)
                if type(part) is float or isinstance(part, (int, float)):
                    sums[name] += part
        if self._solves and (reported := info.get(self._solves)) is not None:
            now = solved(reported)
            self.success = self.success if now is None else now or (self._ever and bool(self.success))
        if mark:
            info = {**info, mark: True}
        if self.full is not None:
            self.full.append(obs, returned, reward, terminated, truncated, info)
        self._played.append((action, reward))
        self.total += reward
        self.terminated, self.truncated = terminated, truncated
        return terminated or truncated or length == self._n_recorded or mark == self._last_mark

    def finish(self, job: Job) -> tuple[bytes, bytes]:
        """The recordings of everything and of the actions; empty where nobody needs one."""
        # A policy of several episodes can measure the pause between them, in which feedback is made and sent.
        pauses = job.policy_scope == "submit"
        rows = self.full.finish() if self.full and (pauses or job.record == "full") else b""
        log = b""
        if (pauses and job.bundle is not None) or job.record != "full" or job.video:
            actions, last = Recorder("actions", self._form), self.length - 1
            for t, (action, reward) in enumerate(self._played):
                ends = t == last
                actions.append(None, action, reward, ends and self.terminated, ends and self.truncated, {})
            log = actions.finish()
        return rows, log


def _replayed(codec: ActionCodec, actions: Sequence[Returned], then: Source | None = None) -> Source:
    """Actions of an earlier attempt or a recording; after the last, those of `then`."""

    def act(t: int, obs: Observation) -> tuple[Any, Any, str]:
        if then is not None and t >= len(actions):
            return then(t, obs)
        returned, _ = actions[t]
        action, invalid = codec.repair(returned)
        return returned, action, INVALID if invalid else ""

    return act


def _asked(codec: ActionCodec, policy: PolicyProcess, begun: RunningEpisode) -> Source:
    """A policy's actions, which are added to `begun`. Raises PolicyFailedError."""
    earlier, n_earlier = _replayed(codec, begun.taken), len(begun.taken)
    ask, repair, take = policy.act, codec.repair, begun.add_action

    def act(t: int, obs: Observation) -> tuple[Any, Any, str]:
        returned = ask(obs)
        if t < n_earlier:
            return earlier(t, obs)
        action, invalid = repair(returned)
        take(returned, action)
        return returned, action, INVALID if invalid else ""

    return act


def random_actions(policy_seed: bytes) -> np.random.Generator:
    """The generator of the uniform random actions that play in place of a policy."""
    digest = hashlib.sha256(b"evopolicy random actions\0" + policy_seed).digest()
    return np.random.default_rng(int.from_bytes(digest, "little"))


def _verdict_of_submit(job: Job, spec: EpisodeSpec, failure: PolicyFailure) -> bool:
    """Whether the failure means that the submit yields no Policy, so that no episode is played.

    Hidden episodes are played in any case: a return of 0 would beat every policy where steps cost.
    """
    return spec.index == 0 and job.record == "full" and failure.category in NO_POLICY


def _share(job: Job) -> int:
    """Limit of one episode's stored output, bytes."""
    return max(1024, MAX_JOB_OUTPUT_BYTES // len(job.episodes))


def _within_share(job: Job) -> ResourceLimits:
    """The job's limits with the output that there is room for in its results."""
    most = min(LARGEST_LIMITS["output_bytes"], _share(job) // 3)
    return msgspec.structs.replace(job.limits, output_bytes=min(job.limits.output_bytes, most))


def _brief(outcome: EpisodeOutcome, share: int) -> EpisodeOutcome:
    """The outcome with the end of its traceback, within its share of the job's output."""
    failure = outcome.failure
    if failure is None or 4 * len(failure.traceback) <= share // 3:
        return outcome
    kept = failure.traceback[-(share // 12) :]
    return msgspec.structs.replace(outcome, failure=msgspec.structs.replace(failure, traceback=kept))


def _blob(data: bytes) -> BlobRef:
    if len(data) > codec.MAX_BLOB_BYTES:
        # Its actions take that many: no other attempt would take fewer.
        raise BrokenEnvironmentError(
            f"{call}: its recording has {len(data):,} bytes, and {codec.MAX_BLOB_BYTES:,} are the limit; give it a"
            " lower max_episode_steps, or smaller actions or observations"
        )
    return BlobRef(digest=digest_of(data), size=len(data), inline=data)


def fault_of(error: BaseException) -> str:
    """An infrastructure error in one line, with its type unless it is one of our own errors."""
    text = str(error) if isinstance(error, EvopolicyError) else described(error)
    return text.encode("utf-8", "replace").decode()[:MAX_FAULT]
