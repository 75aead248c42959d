"""Builds the groups of jobs of each kind. A function for each kind states the differences from the usual group.

Rule that this module owns: a group follows from stored rows alone, so it is the same after a restart.
"""

from __future__ import annotations

from typing import Literal

from evopolicy_common.messages.environment import Case, PolicyScope
from evopolicy_common.messages.episode import RANDOM, BlobRef, Record
from evopolicy_common.messages.gateway import Conditions, VideoOption
from evopolicy_common.messages.operator import PlayedAs
from evopolicy_coordinator.core.contract.records import (
    EvaluationRow,
    RunRow,
    SubmitRow,
    evaluation_group,
    random_group,
    submit_group,
)
from evopolicy_coordinator.core.leasing.jobs import occurrences
from evopolicy_coordinator.core.tables.model import (
    HIDDEN,
    REFERENCE,
    TRAIN,
    Evaluation,
    GroupKind,
    JobGroup,
    Run,
    Template,
)
from evopolicy_coordinator.core.tables.step import CoreStep

HIDDEN_SPLITS = ("validation", "heldout")


def train(run: Run, row: SubmitRow, step: CoreStep) -> JobGroup:
    return _group(
        "train",
        run,
        tuple(run.row.train[case_id] for case_id in row.env_instances),
        step,
        id=submit_group(run.id, row.submit_index, "train"),
        submit_index=row.submit_index,
        priority=TRAIN,
        stimulus_id=row.stimulus_id,
        created_at=row.accepted_at,
        env_meta=env_meta(run, row),
        secret=run.row.secret,
        bundle=row.bundle,
        case_ids=row.env_instances,
        occurrences=occurrences(row.env_instances),
        scope=run.row.settings.policy_scope,
        record="full",
        video=run.row.settings.video,
    )


def hidden(split: Literal["validation", "heldout"], run: Run, row: SubmitRow, step: CoreStep) -> JobGroup:
    """A checkpoint on all cases of a hidden split."""
    settings, cases = run.row.settings, run.row.cases(split)
    pool = settings.hidden_evaluation == "pool"
    return _group(
        split,
        run,
        cases,
        step,
        id=submit_group(run.id, row.submit_index, split),
        submit_index=row.submit_index,
        priority=HIDDEN,
        stimulus_id=row.stimulus_id,
        env_meta=env_meta(run, row) | ({"remaining_budget_after": 0} if pool else {}),
        secret=run.row.secret,
        bundle=row.bundle,
        modulo=len(cases) if pool else len(row.env_instances),
        scope=settings.policy_scope,
        video=settings.recorded_heldout if split == "heldout" else "off",
    )


def random(run: Run, step: CoreStep) -> JobGroup:
    """Uniform random actions on all held-out cases."""
    return _group(
        "random",
        run,
        run.row.heldout,
        step,
        id=random_group(run.id),
        submit_index=RANDOM,
        priority=REFERENCE,
        stimulus_id=run.row.stimulus_id,
        env_meta={"env": run.row.settings.env},
        split="heldout",
        secret=None,
    )


def evaluation(of: Evaluation, step: CoreStep) -> JobGroup:
    """The episodes that an operator requested."""
    # A replayed list keeps its position in its run; any other is a list of its own.
    row, place = of.row, _place(of.row)
    counts = occurrences(place.env_instances)
    pool = row.split in HIDDEN_SPLITS and place.conditions.hidden_evaluation == "pool"
    return _group(
        "evaluation",
        of,
        row.cases,
        step,
        id=evaluation_group(row.evaluation),
        submit_index=place.submit_index,
        priority=HIDDEN if hidden_evaluation(row) else REFERENCE,
        stimulus_id=row.stimulus_id,
        created_at=row.created_at,
        env_meta={
            "env": row.env,
            "submit_index": max(0, place.submit_index),
            "n_episodes_this_submit": place.modulo,
            "remaining_budget_after": 0 if pool else place.remaining_budget_after,
        },
        bundle=row.bundle,
        split=row.split,
        secret=None if row.bundle is None else row.secret,
        case_ids=row.case_ids,
        occurrences=tuple(counts[index] for index in place.indexes),
        modulo=len(place.env_instances) if pool else place.modulo,
        scope=place.conditions.policy_scope if row.bundle is not None else "episode",
        record=row.record,
        replays=row.replays,
        indexes=place.indexes,
    )


def _group(
    kind: GroupKind,
    owner: Run | Evaluation,
    cases: tuple[Case, ...],
    step: CoreStep,
    *,
    id: str,
    submit_index: int,
    priority: int,
    stimulus_id: str,
    created_at: float | None = None,
    secret: bytes | None,
    env_meta: dict[str, object],
    split: str = "",
    bundle: str | None = None,
    case_ids: tuple[int, ...] = (),
    occurrences: tuple[int, ...] = (),
    modulo: int = 0,
    scope: PolicyScope = "episode",
    record: Record = "actions",
    video: VideoOption = "off",
    replays: tuple[BlobRef, ...] = (),
    indexes: tuple[int, ...] = (),
) -> JobGroup:
    """A group without jobs yet. Left out: its kind is the split, its cases are in order, each of them once."""
    row, n = owner.row, len(cases)
    how: Conditions
    if isinstance(row, RunRow):
        how, tier, limits = row.settings, row.settings.sandbox_tier, row.settings.limits
    else:
        how, tier, limits = _place(row).conditions, row.tier, row.limits
    template = Template(
        env=owner.flow.env,
        bundle=bundle,
        cases=cases,
        case_ids=case_ids or tuple(range(n)),
        occurrences=occurrences or (0,) * n,
        secret=secret,
        split=split or kind,
        submit_index=submit_index,
        modulo=modulo or n,
        scope=scope,
        env_meta=env_meta,
        observations=how.observations,
        record=record,
        video=video,
        tier=tier,
        limits=limits,
        max_steps=row.max_steps,
        failed_episodes=how.failed_episodes,
        published=how.profile != "own",
        replays=replays,
        indexes=indexes,
    )
    return JobGroup(
        id=id,
        kind=kind,
        run=owner.flow.id,
        submit_index=-1 if kind == "evaluation" else submit_index,
        flow=owner.flow,
        template=template,
        stimulus_id=stimulus_id,
        priority=priority,
        created_at=step.now if created_at is None else created_at,
    )


def env_meta(run: Run, row: SubmitRow) -> dict[str, object]:
    """Metadata that a submit's policies receive; the worker adds the spaces."""
    return {
        "env": run.row.settings.env,
        "submit_index": row.submit_index,
        "n_episodes_this_submit": len(row.env_instances),
        "remaining_budget_after": row.remaining_budget,
    }


def hidden_evaluation(row: EvaluationRow) -> bool:
    """Whether an evaluation is hidden work: a policy's present or recorded actions on hidden cases. Random
    actions reveal nothing."""
    return row.split in HIDDEN_SPLITS and (row.bundle is not None or bool(row.replays))


def _place(row: EvaluationRow) -> PlayedAs:
    """The list of episodes that an evaluation's cases were taken from; by themselves if from none."""
    n = len(row.cases)
    return row.as_in or PlayedAs(
        run="",
        submit_index=-1,
        env_instances=row.case_ids,
        indexes=tuple(range(n)),
        modulo=n,
        remaining_budget_after=0,
    )
