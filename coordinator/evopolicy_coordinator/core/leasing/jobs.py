"""A job as its worker receives it, and the seeds of its policy processes.

Rule that this module owns: a job's content follows from its group and its position, so it is not stored, and every
attempt is the same job, except for the actions that the policy returned in an earlier one (`BegunRow`), and the number
of those that the environment has ended.

Seeds are keyed hashes that are reproducible and reveal neither the case's seed nor the split:

policy_seed = HMAC-SHA256(run secret, submit index | split | case id | occurrence)[:16]

The uniform-random reference has no policy. Its actions follow from the split and the case alone, so that every run on a
split get the same returns:

reference_seed = SHA-256("evopolicy random reference" NUL JSON of [split, case seed, options, occurrence])[:16]

Rules of a retry (`decide`):
- Only infrastructure failures are retried, without limit. A policy's failure is a result and never handled here.
- Only an environment that keeps ending the same job is given up: after `FAULTS_MAX` attempts in at least
  `CoreSettings.environment_wait_s`, on two machines if two can play it, so that no machine's word alone ends a run.
- A job that is given back (drained, cancelled) has not failed: no delay, no blame.
- The jobs that ran on a lost worker become suspects and rerun alone. The jobs that waited there behind them just return
  to the queue.
"""

from __future__ import annotations

import hashlib
import hmac
import itertools
import json
from collections import defaultdict
from collections.abc import Iterable
from typing import Literal, NamedTuple

from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.tables.model import EnvironmentFaults, JobState, Template


def _seed(template: Template, index: int) -> bytes:
    occurrence = template.occurrences[index]
    if template.secret is None:
        return reference_seed(template.split, template.cases[index], occurrence)
    case_id = template.case_ids[index]
    return policy_seed(template.secret, template.submit_index, template.split, case_id, occurrence)


def build(job: JobState, description: EnvironmentDescription) -> Job:
    template = job.group.template
    video = template.video == "all" or (template.video == "first" and job.first == 0)
    episodes = tuple(
        EpisodeSpec(
            index=index,
            episode_index=(template.indexes[index] if template.indexes else index) % template.modulo,
            case=template.cases[index],
            policy_seed=_seed(template, index),
            replay=template.replays[index] if template.replays else None,
        )
        for index in range(job.first, job.first + job.n)
    )
    return Job(
        job_id=job.job_id,
        env=template.env,
        bundle=template.bundle,
        episodes=episodes,
        policy_scope=template.scope,
        policy_every=template.modulo if template.scope == "submit" else 0,
        env_meta={
            **template.env_meta,
            "max_episode_steps": template.max_steps or description.max_episode_steps,
            "obs_storage": description.obs_storage,
        },
        observations=template.observations,
        record=template.record,
        render=job.group.kind == "train",
        video=video,
        video_episodes=1 if template.video == "first" else 0,
        tier=template.tier,
        limits=template.limits,
        max_steps=template.max_steps,
        failed_episodes=template.failed_episodes,
        published=template.published,
        begun=job.begun,
        environment_faults=job.faults.n,
    )


def policy_seed(secret: bytes, submit_index: int, split: str, case_id: int, occurrence: int) -> bytes:
    """Returns 16 bytes for the `occurrence`-th (from 0) time that a submit plays `case_id` of `split`.

    `submit_index` is −1 for evaluations outside runs.
    """
    text = f"{submit_index}|{split}|{case_id}|{occurrence}".encode()
    return hmac.digest(secret, text, hashlib.sha256)[:16]


def reference_seed(split: str, case: Case, occurrence: int) -> bytes:
    """Returns 16 bytes for the `occurrence`-th (from 0) time that uniform random actions play `case` of `split`."""
    # An environment cannot distinguish missing options from empty ones.
    text = json.dumps([split, case.seed, case.options or None, occurrence], sort_keys=True)
    return hashlib.sha256(b"evopolicy random reference\0" + text.encode()).digest()[:16]


def occurrences(case_ids: Iterable[int]) -> tuple[int, ...]:
    """Returns, for each position, how often its case id occurs earlier in the list."""
    seen: dict[int, itertools.count[int]] = defaultdict(itertools.count)
    return tuple(next(seen[case_id]) for case_id in case_ids)


FAULTS_MAX = 5

JobFailure = Literal["returned", "unlisted", "failed", "worker_lost", "overdue"]
"""returned: given back unfinished, without a failure. unlisted: its worker is alive but does not know the lease,
which never arrived. failed: the worker's own fault. worker_lost: its worker went silent. overdue: played for longer
than any episode may take."""


class Retry(NamedTuple):
    """How a job goes back into the queue."""

    delay_s: float
    avoid: bool
    """Keep it from the same worker for a while."""
    alone: bool
    """It is suspected of crashing workers: it reruns with no other job beside it."""
    counted: bool
    """It counts as an infrastructure failure: in the back-off, and in the operator's figures."""


def backoff_s(settings: CoreSettings, failures: int) -> float:
    """Returns the back-off in seconds after the `failures`-th infrastructure failure (from 1): doubles,
    up to `retry_max_s`."""
    return min(settings.retry_max_s, settings.retry_base_s * 2.0 ** min(failures - 1, 30))


def in_vain(settings: CoreSettings, faults: EnvironmentFaults, able: set[str], now: float) -> bool:
    """Whether another attempt at a job would only meet the same fault of its environment. `able`: machines that can
    play it."""
    lasted = now - faults.since >= settings.environment_wait_s
    return faults.n >= FAULTS_MAX and lasted and len(faults.on) >= min(2, len(able))


def decide(settings: CoreSettings, failure: JobFailure, *, failures: int, ran: bool) -> Retry:
    """Returns the retry of a job after `failure`. `failures` includes this one; `ran`: whether the
    job was being played."""
    if failure == "returned":
        return Retry(0.0, avoid=False, alone=False, counted=False)
    if failure == "unlisted" or (failure == "worker_lost" and not ran):
        return Retry(0.0, avoid=False, alone=False, counted=True)
    delay_s = backoff_s(settings, failures)
    return Retry(delay_s, avoid=True, alone=failure == "worker_lost", counted=True)
