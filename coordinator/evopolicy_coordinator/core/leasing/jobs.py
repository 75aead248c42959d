"""A job as its worker receives it.

Rule that this module owns: a job's content follows from its group and its position, so it is not stored, and every
attempt is the same job, except for the actions that the policy returned in an earlier one (`BegunRow`), and the number
of those that the environment has ended.
"""

from __future__ import annotations

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_coordinator.core.leasing.seeds import policy_seed, reference_seed
from evopolicy_coordinator.core.tables.model import JobState, Template


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
        begun=job.begun,
        environment_faults=job.faults.n,
    )
