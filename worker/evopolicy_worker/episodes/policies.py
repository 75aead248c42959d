"""The policies of a slot, one process after another: forked in advance, their `policy.py` compiled once.

Rules:
- No policy's process serves two policies, and none learns how many there were before it.
- All policies of the same `policy.py` load the same code.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.episode import EpisodeSpec, Job, PolicyFailure, ResourceLimits
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_worker.environments import Environment
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policy_process import (
    BundleFiles,
    Ended,
    PolicyFailedError,
    PolicyProcess,
    oom_kills,
)
from evopolicy_worker.episodes.progress import CancelledJobError, Progress
from evopolicy_worker.sandbox.jail import Jail
from evopolicy_worker.sandbox.zygote import Child, Zygote

MAX_CODES = 8
"""Policies whose compiled code is kept, at most 1 MiB each."""
_COUNT_S = 1.0
"""Interval at which the processes are counted that the machine ended for want of memory. The kernel's list of counters
takes it 50 µs and more."""


class Policies:
    """Starts the processes of a slot's policies, and removes what is left of them."""

    def __init__(self, zygote: Zygote, jail: Jail, monitor: Monitor, scratch: Path) -> None:
        self._zygote = zygote
        self._jail = jail
        self._monitor = monitor
        self._scratch = scratch
        self._prepared: Child | None = None
        self._codes: dict[bytes, bytes] = {}
        self._n_policies = 0
        self._folders: list[Path] = []
        self._oom_kills, self._counted = oom_kills(), time.monotonic()

    def prepare(self) -> None:
        """Bury the last policy and fork the process for the next; to be called while there is nothing else to do."""
        if self._prepared is None:
            self._prepared = self._spawn()

    def start(self, limits: ResourceLimits) -> PolicyProcess:
        """The process of the next policy."""
        child, self._prepared = self._prepared, None
        if child is None:
            child = self._spawn()
        self._n_policies += 1
        folder = self._scratch / "policies" / str(self._n_policies)
        if self._jail.home is None:
            self._folders.append(folder)
        own = str(folder), self._oom_kills
        return PolicyProcess(self._zygote, child, self._monitor, self._jail, limits, *own)

    def _spawn(self) -> Child:
        self._bury()
        child = self._zygote.spawn()
        now = time.monotonic()
        if now - self._counted > _COUNT_S:
            self._oom_kills, self._counted = oom_kills(), now
        return child

    @property
    def compiles(self) -> bool:
        """Whether policies have the same folder, whose path is in their code."""
        return self._jail.home is not None

    def code(
        self, source: bytes, limits: ResourceLimits, env_meta: dict[str, Any], progress: Progress
    ) -> bytes:
        """The code of this `policy.py`, compiled once for all episodes by a process of its own.

        All policies load the same code, the first too, which could otherwise tell by its memory that it is the first.
        """
        code = self._codes.get(source)
        if code is None:
            compiler = progress.policy = self.start(limits)
            try:
                code = compiler.compiled(source, env_meta)
            finally:
                compiler.end()
            if progress.cancelled:
                raise CancelledJobError
            while len(self._codes) >= MAX_CODES:
                del self._codes[next(iter(self._codes))]
            self._codes[source] = code
        return code

    def _bury(self) -> None:
        """The processes of the policies so far are gone after this, and so are their folders."""
        self._zygote.bury()
        while self._folders:
            remove_tree(self._folders.pop())

    def close(self) -> None:
        self._zygote.close()


class JobPolicies:
    """The policy of each episode of a job: its own, or one for several."""

    def __init__(
        self, policies: Policies, job: Job, files: BundleFiles | None, environment: Environment
    ) -> None:
        self._policies = policies
        self._job = job
        self._files = files
        description = environment.description
        self._env_meta = job.env_meta | {
            "obs_space": description.obs_space,
            "action_space": description.action_space,
            "obs_storage": description.obs_storage,
        }
        if description.reward_components:
            self._env_meta["reward_components"] = dict(description.reward_texts)
        self._policy: PolicyProcess | None = None

    def take(self, k: int, spec: EpisodeSpec, progress: Progress) -> PolicyProcess:
        """The policy for the job's k-th episode, before its reset. Raises PolicyFailedError."""
        job, files = self._job, self._files
        assert files is not None
        if self._policy is not None and not (job.policy_every and k % job.policy_every == 0):
            self._policy.begin_episode()
            return self._policy
        self.drop()
        source = files.policy()
        if source is None:
            raise PolicyFailedError(
                PolicyFailure(
                    category="missing_policy",
                    step_index=None,
                    message="there is no policy.py in system/; it must hold a top-level class Policy",
                )
            )
        policies, limits = self._policies, job.limits
        code = policies.code(source, limits, self._env_meta, progress) if policies.compiles else b""
        policy = self._policy = progress.policy = policies.start(limits)
        policy.seal(files, spec.policy_seed, self._env_meta, job.observations)
        policy.load(code)
        return policy

    def release(self) -> Ended:
        """The policy's output in the ended episode; a policy for one episode ends with it."""
        policy = self._policy
        if policy is None:
            return Ended(b"", b"", 0.0)
        if self._job.policy_scope == "submit" and not policy.dead:
            ended = policy.take_output()
            if not policy.dead:
                return ended
        else:
            ended = policy.end()
        self._policy = None
        return ended

    def close(self, progress: Progress) -> None:
        progress.policy = None
        self.drop()

    def drop(self) -> None:
        """Ends the policy, if there is one; the next episode gets another one."""
        if self._policy is not None:
            policy, self._policy = self._policy, None
            policy.kill()
            # The job itself has already reported a fault of the sandbox.
            with contextlib.suppress(EvopolicyError):
                policy.end()
