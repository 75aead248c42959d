"""The policies of a slot, one process after another: forked in advance, their `policy.py` compiled once.

Rules:
- No policy's process serves two policies, and none learns how many there were before it.
- All policies of the same `policy.py` load the same code.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable
from pathlib import Path

from evopolicy_common import published_forms
from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.episode import EpisodeSpec, Job, PolicyFailure
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_worker.environments import Environment
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policy_process import (
    PolicyEnd,
    PolicyFailedError,
    PolicyProcess,
    oom_kills,
)
from evopolicy_worker.sandbox.jail import PolicyJail
from evopolicy_worker.sandbox.zygote import ForkedPolicy, Zygote
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slot_protocol.begun import RunningEpisode

MAX_CODES = 8
"""Policies whose compiled code is kept, at most 1 MiB each."""
_COUNT_S = 1.0
"""Interval at which the processes are counted that the machine ended for want of memory. The kernel's list of counters
takes it 50 µs and more."""


class CancelledJobError(Exception):
    """The job was cancelled while it ran."""


class RunningJob:
    """Progress of the running job; written by the loop, read by the monitor's thread, which hears of a
    cancellation."""

    def __init__(self) -> None:
        self.episodes_done = 0
        self.steps = 0
        self.cancelled = False
        self.policy: PolicyProcess | None = None
        self.begun: tuple[int, RunningEpisode] | None = None
        """The running episode, with its index in the job, that is reported when the job is stopped."""
        self._given_up = False
        self._lock = threading.Lock()

    def give_up(self, send: Callable[[messages.SlotMessage], None] | None) -> None:
        """Reports the started episode, once; the report is sent when this returns. With None, nothing more is
        reported."""
        with self._lock:
            if send is not None and self.begun is not None and not self._given_up:
                place, begun = self.begun
                send(messages.Begun(place=place, begun=begun.packed()))
            self._given_up = True

    def report(self, send: Callable[[messages.SlotMessage], None]) -> None:
        """Reports episodes and steps; nothing once the job was given up, since its last answer may have been sent."""
        with self._lock:
            if not self._given_up:
                send(messages.JobProgress(episodes_done=self.episodes_done, steps=self.steps))

    def cancel(self) -> None:
        """Ends the running job at the next step, and the policy at once."""
        self.cancelled = True
        policy = self.policy
        if policy is not None:
            policy.kill()


class Policies:
    """The policy of each episode: its own, or one for several of a job. Removes its files at the end."""

    def __init__(self, zygote: Zygote, jail: PolicyJail, monitor: Monitor, scratch: Path) -> None:
        self._zygote = zygote
        self._jail = jail
        self._monitor = monitor
        self._scratch = scratch
        self._prepared: ForkedPolicy | None = None
        self._policy: PolicyProcess | None = None
        self._codes: dict[bytes, bytes] = {}
        self._n_policies = 0
        self._folders: list[Path] = []
        self._oom_kills, self._counted = oom_kills(), time.monotonic()

    def prepare(self) -> None:
        """Buries the last policy and forks the process for the next; to be called while there is nothing else to do."""
        if self._prepared is None:
            self._prepared = self._spawn()

    def begin_job(
        self, job: Job, files: messages.BundleFiles | None, environment: Environment, progress: RunningJob
    ) -> None:
        """The policies of this job come from now on. `files`: its bundle."""
        self._job, self._files, self._progress = job, files, progress
        description = environment.description
        self._env_meta = job.env_meta | {
            "obs_space": description.obs_space,
            "action_space": description.action_space,
            "obs_storage": description.obs_storage,
        }
        self._spaces = description.obs_space, description.action_space
        if job.published:
            self._env_meta |= published_forms.described(*self._spaces, description.obs_storage)
            self._env_meta.pop("artifacts", None)
        elif description.reward_components:
            self._env_meta["reward_components"] = dict(description.reward_texts)

    def take_policy(self, k: int, spec: EpisodeSpec) -> PolicyProcess:
        """The policy for the job's k-th episode, before its reset. Raises PolicyFailedError."""
        job, files = self._job, self._files
        assert files is not None
        if self._policy is not None and not (job.policy_every and k % job.policy_every == 0):
            self._policy.begin_episode()
            return self._policy
        self.drop()
        ends = itertools.accumulate(size for _, _, size in files.names)
        places = {name: (end - size, end) for (name, _, size), end in zip(files.names, ends, strict=True)}
        if "policy.py" not in places:
            text = "there is no policy.py in system/; it must hold a top-level class Policy"
            raise PolicyFailedError(PolicyFailure(category="missing_policy", step_index=None, message=text))
        # Where policies have the same folder, whose path is in their code.
        code = self._code(files.data[slice(*places["policy.py"])]) if self._jail.home is not None else b""
        policy = self._policy = self._start()
        policy.seal(files, spec.policy_seed, self._env_meta, job.observations, self._spaces)
        policy.load(code)
        return policy

    def release(self) -> PolicyEnd:
        """The policy's output in the ended episode; a policy for one episode ends with it."""
        policy = self._policy
        if policy is None:
            return PolicyEnd(b"", b"", 0.0)
        if self._job.policy_scope == "submit" and not policy.dead:
            ended = policy.take_output()
            if not policy.dead:
                return ended
        else:
            ended = policy.end()
        self._policy = None
        return ended

    def drop(self) -> None:
        """Ends the policy, if there is one; the next episode gets another one."""
        if self._policy is not None:
            policy, self._policy = self._policy, None
            policy.kill()
            # The job itself has already reported a fault of the sandbox.
            with contextlib.suppress(EvopolicyError):
                policy.end()

    def _start(self) -> PolicyProcess:
        child, self._prepared = self._prepared or self._spawn(), None
        self._n_policies += 1
        folder = self._scratch / "policies" / str(self._n_policies)
        if self._jail.home is None:
            self._folders.append(folder)
        own = self._job.limits, str(folder), self._oom_kills
        self._progress.policy = PolicyProcess(self._zygote, child, self._monitor, self._jail, *own)
        return self._progress.policy

    def _spawn(self) -> ForkedPolicy:
        """A process for the next policy, once those of the policies so far are gone with their folders."""
        self._zygote.bury()
        while self._folders:
            remove_tree(self._folders.pop())
        child = self._zygote.spawn()
        now = time.monotonic()
        if now - self._counted > _COUNT_S:
            self._oom_kills, self._counted = oom_kills(), now
        return child

    def _code(self, source: bytes) -> bytes:
        """The code of this `policy.py`, compiled once for all episodes by a process of its own.

        All policies load the same code, the first too, which could otherwise tell by its memory that it is the first.
        """
        code = self._codes.get(source)
        if code is None:
            compiler = self._start()
            try:
                code = compiler.compiled(source, self._env_meta)
            finally:
                compiler.end()
            if self._progress.cancelled:
                raise CancelledJobError
            while len(self._codes) >= MAX_CODES:
                del self._codes[next(iter(self._codes))]
            self._codes[source] = code
        return code
