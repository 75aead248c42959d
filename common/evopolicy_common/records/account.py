"""The one account of a run: `run.json` follows from what was opened, what resulted, and the gateway's claims. Pure.

The gateway writes `run.json` with `run_record`; `evopolicy check` and `evopolicy verify` call the same functions with
the committed documents and compare. `Claims` lists all that neither document decides.
"""

from __future__ import annotations

import msgspec

from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.operator import RunFinished, RunResult
from evopolicy_common.messages.run_settings import AllConditions
from evopolicy_common.records import run_record as schema
from evopolicy_common.records.aggregates import mean, std
from evopolicy_common.records.code_metrics import TREND, CodeMetrics
from evopolicy_common.records.run_record import RunRecord, sha256_text
from evopolicy_common.records.summary import utc_text

_COUNTED = ("steps", "action_invalid")
"""Names in `auxiliary.transitions`."""


class Told(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A gateway's own facts about its run, which it sends when it closes it: fixed from then on."""

    agent: schema.Agent
    """Without `entry` and `prompts`, which the settings decide."""
    jail: str
    agents_md_hash: str = ""
    rules_hash: str = ""
    initial_policy_hash: str | None = None


class Claims(Told, frozen=True, kw_only=True):
    """The fields of `run.json` that only the gateway's side knows."""

    harness: str = ""
    agent_s: float = 0.0
    feedback_s: float = 0.0
    held_s: float = 0.0
    permit_s: float = 0.0
    error: str | None = None
    """Why the status is `error` or `cancelled`."""
    gave_up: bool = False
    """The run's command gave up a run that counts as `cancelled` at the coordinator: its status is `error`."""
    code: dict[int, CodeMetrics | None] = {}
    """By submit, in their order. `check` computes it from the published policies."""
    transitions: dict[str, int] | None = None
    rejected_submits: tuple[schema.RejectedSubmit, ...] = ()
    artifacts: schema.Artifacts = schema.Artifacts()
    replays: tuple[schema.Replay, ...] = ()


def claims_in(record: RunRecord) -> Claims:
    """The claims of a written record. Raises msgspec.ValidationError for metrics of code in another form."""
    timing, versions, outcome = record.timing, record.versions, record.outcome
    code = outcome.auxiliary.get("code_metrics_by_submit", {})
    counted = msgspec.convert(outcome.auxiliary.get("transitions"), dict[str, int] | None)
    return Claims(
        agent=record.agent,
        jail=record.jail,
        harness=versions.harness,
        agents_md_hash=versions.agents_md_hash,
        rules_hash=versions.rules_hash,
        initial_policy_hash=versions.initial_policy_hash,
        agent_s=timing.agent_s,
        feedback_s=timing.feedback_s,
        held_s=timing.held_s,
        permit_s=timing.permit_s,
        error=outcome.error,
        gave_up=outcome.status == "error",
        code=msgspec.convert(code, dict[int, CodeMetrics | None], strict=False),
        transitions=counted and {name: counted[name] for name in _COUNTED if name in counted},
        rejected_submits=record.rejected_submits,
        artifacts=record.artifacts,
        replays=record.replays,
    )


def run_record(finished: RunFinished, claims: Claims) -> RunRecord:
    """The record of a finished run."""
    settings, wall_s, fingerprint = finished.settings, finished.wall_s, finished.fingerprint
    hashes = {name: sha256_text(digest) for name, digest in finished.split_hashes.items()}
    cases: dict[Split, str] = {split: hashes.get(split, "") for split in ("train", "validation", "heldout")}
    conditions = {name: getattr(settings, name) for name in AllConditions.__struct_fields__}
    prompts = sha256_text(settings.prompts)
    return RunRecord(
        model=settings.model,
        env=settings.env,
        env_title=finished.env_title,
        env_family=finished.env_family,
        exp_id=settings.exp_id,
        repeat=settings.repeat,
        attempt=settings.attempt,
        run=finished.run,
        agent=msgspec.structs.replace(claims.agent, entry=settings.entry, prompts=prompts),
        sandbox_tier=settings.sandbox_tier,
        jail=claims.jail,
        hidden_isolation=finished.hidden_isolation,
        experiment_dimensions=schema.ExperimentDimensions(
            **conditions,
            episode_budget=finished.budget,
            min_episodes_per_submit=finished.min_episodes_per_submit,
            max_episodes_per_submit=finished.max_episodes_per_submit,
            n_train=finished.n_train,
            n_validation=finished.n_validation,
            n_heldout=finished.n_heldout,
            limits=settings.limits,
            agents_md=sha256_text(settings.agents_md),
        ),
        timing=schema.Timing(
            start_time=utc_text(finished.created_at),
            end_time=utc_text(finished.finished_at),
            wall_time_seconds=round(finished.finished_at - finished.created_at, 3),
            agent_s=round(claims.agent_s, 3),
            queue_s=round(wall_s.get("queue", 0.0), 3),
            rollout_s=round(wall_s.get("rollout", 0.0), 3),
            feedback_s=round(claims.feedback_s, 3),
            held_s=round(claims.held_s, 3),
            permit_s=round(claims.permit_s, 3),
            finalise_s=round(wall_s.get("finalise", 0.0), 3),
        ),
        outcome=outcome(finished, claims),
        rejected_submits=claims.rejected_submits,
        artifacts=claims.artifacts,
        replays=claims.replays,
        versions=schema.Versions(
            harness=claims.harness,
            env=finished.env_version,
            agents_md_hash=claims.agents_md_hash,
            data_train_hash=hashes.get("train.json", cases["train"]),
            data_valid_hash=hashes.get("valid.json", cases["validation"]),
            data_heldout_hash=hashes.get("heldout.json", cases["heldout"]),
            rules_hash=claims.rules_hash,
            cases_hashes=cases,
            fingerprint={} if fingerprint is None else fingerprint.flat(),
            installations=finished.installations,
            fingerprint_overrides=finished.fingerprint_overrides,
            data_secret=finished.cases_secret,
            initial_policy_hash=claims.initial_policy_hash,
            env_deterministic=finished.deterministic,
        ),
        committed=finished.committed,
        start=settings.start,
        replay_of=settings.replay_of,
        trees={str(submit.submit_index): submit.tree for submit in finished.submits if submit.tree},
    )


def outcome(result: RunResult, claims: Claims) -> schema.Outcome:
    """The outcome in `run.json`. As published, a run without an ok submit has the score 0.0."""
    completed, code = result.status == "completed", claims.code
    heldout, reference = result.heldout_returns, result.random_heldout_returns
    best = result.best_submit_index if completed else None
    auxiliary: dict[str, object] = {
        "code_metrics_best": None if best is None else code.get(best),
        "code_metrics_by_submit": {str(index): metrics for index, metrics in code.items()},
        "code_metrics_trend": {
            "submits": list(code),
            **{name: [getattr(metrics, name, None) for metrics in code.values()] for name in TREND},
        },
        "policy_failures": dict(result.policy_failures),
        "infrastructure_retries": result.infrastructure_retries,
        "nondeterministic_results": result.nondeterministic_results,
    }
    if claims.transitions is not None:
        auxiliary["transitions"] = claims.transitions
    random = None
    if reference:
        random = schema.ReferenceScore(
            mean_return=mean(reference), std_return=std(reference), returns=reference
        )
    return schema.Outcome(
        status="error" if result.status == "cancelled" and claims.gave_up else result.status,
        error=claims.error,
        final_score=result.final_score if completed else 0.0 if result.status == "no_ok_submit" else None,
        best_submit_index=best,
        val_scores={str(index): score for index, score in result.val_scores.items()} if completed else None,
        heldout_mean_return=result.final_score if completed else None,
        heldout_std_return=std(heldout) if completed and heldout else None,
        heldout_returns=heldout if completed else (),
        heldout_successes=result.heldout_successes if completed else (),
        quarantined_submits=result.validation_ineligible,
        random_reference=random,
        closed_reason=result.closed_reason,
        budget_used=result.budget_used,
        auxiliary=auxiliary,
    )
