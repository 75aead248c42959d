"""One builder of job groups, and a table of the differences between their kinds (`KINDS`).

    kind        cases                    plays                record    video              priority
    train       those of the submit      its bundle           full      the run's          TRAIN
    validation  all of the split         the submit's bundle  actions   off                EARLY_VALIDATION, closed
    HELDOUT heldout     all of the split         the submit's bundle  actions   recorded_heldout   HELDOUT random
    held-out                 random actions       actions   off                REFERENCE evaluation  as requested
    as requested         requested off                REFERENCE, hidden HELDOUT audit       the audited episode      its
    actions          as above  off                AUDIT, hidden HIDDEN_AUDIT

Rule that this module owns: a group follows from stored rows alone, so it is the same after a restart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from evopolicy_common.messages.environment import Case, FailedEpisodes, ObservationForm, PolicyScope
from evopolicy_common.messages.episode import BlobRef, Record, ResourceLimits, Tier
from evopolicy_common.messages.gateway import VideoOption
from evopolicy_common.messages.operator import PlayedAs
from evopolicy_coordinator.core.contract.records import (
    AuditRow,
    EvaluationRow,
    SubmitRow,
    evaluation_group,
    heldout_group,
    random_group,
    train_group,
    validation_group,
)
from evopolicy_coordinator.core.leasing.seeds import occurrences
from evopolicy_coordinator.core.tables.model import (
    AUDIT,
    EARLY_VALIDATION,
    HELDOUT,
    HIDDEN_AUDIT,
    REFERENCE,
    TRAIN,
    Evaluation,
    GroupKind,
    JobGroup,
    Run,
    Template,
)

RANDOM = -1
"""Submit index of the random reference."""

HIDDEN_SPLITS = ("validation", "heldout")


class _Parts(NamedTuple):
    """The fields that differ between kinds of groups."""

    id: str
    submit_index: int
    cases: tuple[Case, ...]
    priority: int
    stimulus_id: str
    env_meta: dict[str, Any]
    bundle: str | None = None
    split: str = ""
    """Split in the policy seeds; the kind if it is empty."""
    keyed: bool = True
    """Whether seeds are derived from the run's or evaluation's secret."""
    case_ids: tuple[int, ...] | None = None
    """None: 0 … number of cases − 1."""
    occurrences: tuple[int, ...] | None = None
    """None: each case for the first time."""
    modulo: int | None = None
    """None: the number of cases."""
    scope: PolicyScope = "episode"
    record: Record = "actions"
    video: VideoOption = "off"
    replays: tuple[BlobRef, ...] = ()
    indexes: tuple[int, ...] = ()
    created_at: float | None = None
    """None: now."""
    not_on: frozenset[str] = frozenset()
    not_of: frozenset[str] = frozenset()
    numerics: str | None = None


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


# ---- the kinds ----


def _train(run: Run, row: SubmitRow, _stimulus_id: str) -> _Parts:
    return _Parts(
        id=train_group(run.id, row.submit_index),
        submit_index=row.submit_index,
        cases=tuple(run.row.train[case_id] for case_id in row.env_instances),
        priority=TRAIN,
        stimulus_id=row.stimulus_id,
        env_meta=env_meta(run, row),
        bundle=row.bundle,
        case_ids=row.env_instances,
        occurrences=occurrences(row.env_instances),
        scope=run.row.settings.policy_scope,
        record="full",
        video=run.row.settings.video,
        created_at=row.accepted_at,
    )


def _validation(run: Run, row: SubmitRow, _stimulus_id: str) -> _Parts:
    pool = run.row.settings.hidden_evaluation == "pool"
    return _Parts(
        id=validation_group(run.id, row.submit_index),
        submit_index=row.submit_index,
        cases=run.row.validation,
        priority=EARLY_VALIDATION if run.state.phase == "open" else HELDOUT,
        stimulus_id=row.stimulus_id,
        env_meta=env_meta(run, row) | ({"remaining_budget_after": 0} if pool else {}),
        bundle=row.bundle,
        modulo=None if pool else len(row.env_instances),
        scope=run.row.settings.policy_scope,
    )


def _heldout(run: Run, row: SubmitRow, stimulus_id: str) -> _Parts:
    return _validation(run, row, stimulus_id)._replace(
        id=heldout_group(run.id, row.submit_index),
        cases=run.row.heldout,
        priority=HELDOUT,
        video=run.row.settings.recorded_heldout,
    )


def _random(run: Run, _row: None, _stimulus_id: str) -> _Parts:
    return _Parts(
        id=random_group(run.id),
        submit_index=RANDOM,
        cases=run.row.heldout,
        priority=REFERENCE,
        stimulus_id=run.row.stimulus_id,
        env_meta={"env": run.row.settings.env},
        split="heldout" if run.row.reference_by_case else "random",
        keyed=not run.row.reference_by_case,
    )


def _evaluation(evaluation: Evaluation, row: EvaluationRow, _stimulus_id: str) -> _Parts:
    # A replayed list keeps its position in its run; any other is a list of its own.
    place = row.as_in or _alone(row)
    counts = occurrences(place.env_instances)
    pool = row.split in HIDDEN_SPLITS and place.hidden_evaluation == "pool"
    return _Parts(
        id=evaluation_group(row.evaluation),
        submit_index=place.submit_index,
        cases=row.cases,
        priority=HELDOUT if hidden_evaluation(row) else REFERENCE,
        stimulus_id=row.stimulus_id,
        env_meta={
            "env": row.env,
            "submit_index": max(0, place.submit_index),
            "n_episodes_this_submit": place.modulo,
            "remaining_budget_after": 0 if pool else place.remaining_budget_after,
        },
        bundle=row.bundle,
        split=row.split,
        keyed=row.bundle is not None,
        case_ids=row.case_ids,
        occurrences=tuple(counts[index] for index in place.indexes),
        modulo=len(place.env_instances) if pool else place.modulo,
        scope=place.policy_scope if row.bundle is not None else "episode",
        record=row.record,
        replays=row.replays,
        indexes=place.indexes,
        created_at=row.created_at,
    )


def _alone(row: EvaluationRow) -> PlayedAs:
    n = len(row.cases)
    return PlayedAs(
        run="",
        submit_index=-1,
        env_instances=row.case_ids,
        indexes=tuple(range(n)),
        modulo=n,
        remaining_budget_after=0,
    )


def _audit(run: Run, row: AuditRow, stimulus_id: str) -> _Parts:
    assert row.actions is not None
    if row.kind == "train":
        case = run.row.train[run.submits[row.submit_index].env_instances[row.index]]
    else:
        case = (run.row.validation if row.kind == "validation" else run.row.heldout)[row.index]
    return _Parts(
        id=f"{row.audit}.{len(row.replayed_by) + 1}",
        submit_index=row.submit_index,
        cases=(case,),
        priority=HIDDEN_AUDIT if row.kind in HIDDEN_SPLITS else AUDIT,
        stimulus_id=stimulus_id,
        env_meta={"env": run.row.settings.env},
        case_ids=(row.index,),
        record="full" if row.kind == "train" else "actions",
        replays=(row.actions,),
        not_on=frozenset((row.player, *row.replayed_by)),
        not_of=frozenset(row.machines),
        numerics=row.numerics,
    )


KINDS: Mapping[GroupKind, Callable[[Any, Any, str], _Parts]] = {
    "train": _train,
    "validation": _validation,
    "heldout": _heldout,
    "random": _random,
    "evaluation": _evaluation,
    "audit": _audit,
}
"""Builds the fields of each kind, from their owner (a run or an evaluation) and the row to play."""


# ---- the builder ----


def build(
    kind: GroupKind,
    owner: Run | Evaluation,
    row: SubmitRow | EvaluationRow | AuditRow | None,
    now: float,
    stimulus_id: str,
) -> JobGroup:
    """The group of that kind for `row` (None for the random reference), without jobs yet."""
    parts = KINDS[kind](owner, row, stimulus_id)
    observations, tier, limits, failed_episodes = _conditions(owner)
    n = len(parts.cases)
    modulo = n if parts.modulo is None else parts.modulo
    template = Template(
        env=owner.flow.env,
        bundle=parts.bundle,
        cases=parts.cases,
        case_ids=tuple(range(n)) if parts.case_ids is None else parts.case_ids,
        occurrences=(0,) * n if parts.occurrences is None else parts.occurrences,
        secret=owner.row.secret if parts.keyed else None,
        split=parts.split or kind,
        submit_index=parts.submit_index,
        modulo=modulo,
        per_job=modulo if parts.scope == "submit" else 1,
        scope=parts.scope,
        env_meta=parts.env_meta,
        observations=observations,
        record=parts.record,
        video=parts.video,
        tier=tier,
        limits=limits,
        max_steps=owner.row.max_steps,
        failed_episodes=failed_episodes,
        replays=parts.replays,
        indexes=parts.indexes,
    )
    return JobGroup(
        id=parts.id,
        kind=kind,
        run=owner.flow.id,
        submit_index=-1 if kind == "evaluation" else parts.submit_index,
        flow=owner.flow,
        template=template,
        stimulus_id=parts.stimulus_id,
        priority=parts.priority,
        created_at=now if parts.created_at is None else parts.created_at,
        not_on=parts.not_on,
        not_of=parts.not_of,
        numerics=parts.numerics,
    )


def _conditions(
    owner: Run | Evaluation,
) -> tuple[ObservationForm, Tier, ResourceLimits, FailedEpisodes]:
    """How all episodes of a run or an evaluation are played."""
    if isinstance(owner, Run):
        settings = owner.row.settings
        return settings.observations, settings.sandbox_tier, settings.limits, settings.failed_episodes
    row = owner.row
    place = row.as_in or _alone(row)
    return place.observations, row.tier, row.limits, place.failed_episodes
