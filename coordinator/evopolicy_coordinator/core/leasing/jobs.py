"""A job as its worker gets it, and the jobs that a group is cut into.

Rules that this module owns:
- A group is a list of episodes with indexes 0 … n − 1, cut into jobs; each index gets exactly one outcome.
- A job's content follows from its group and its position, so it need not be stored, and every attempt of it is the same job,
  but for what the policy returned in an earlier one (`BegunRow`).
- Of a finished episode only its mark is kept, and only while the group is open.
"""

from __future__ import annotations

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_coordinator.core.model import JobGroup, JobState, Mark, Template
from evopolicy_coordinator.core.records import OutcomeHead

from .seeds import policy_seed, reference_seed


def open_jobs(group: JobGroup, heads: list[OutcomeHead], attempts: int, now: float) -> list[JobState]:
    """Fill in `group.marks` from the stored heads and `group.jobs` with what is left to play, in order.

    A job of several episodes is stored whole or not at all.
    """
    for head in sorted(heads, key=lambda head: head.seq):
        group.marks[head.index] = Mark(head.episode_return, head.length, head.failure, head.trajectory)
    per_job = group.template.per_job
    for first in range(0, group.n, per_job):
        if first in group.marks:
            continue
        group.jobs[first] = JobState(
            job_id=f"{group.id}/{first}",
            group=group,
            first=first,
            n=min(per_job, group.n - first),
            attempts=attempts,
            priority=group.priority,
            since=now,
        )
    return list(group.jobs.values())


def _seed(template: Template, index: int) -> bytes:
    occurrence = template.occurrences[index]
    if template.secret is None:
        return reference_seed(template.split, template.cases[index], occurrence)
    case_id = template.case_ids[index]
    return policy_seed(template.secret, template.submit_index, template.split, case_id, occurrence)


def build(job: JobState, description: EnvironmentDescription) -> Job:
    """The job as a worker gets it."""
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
        video=video,
        video_episodes=1 if template.video == "first" else 0,
        tier=template.tier,
        limits=template.limits,
        max_steps=template.max_steps,
        begun=job.begun,
    )
