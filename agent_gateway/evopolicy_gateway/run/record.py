"""What a finished run leaves: `checkpoints/`, `replays/`, the selected policy in `workspace/system/`; `run.json` comes last.

Holds hidden scores, so it is called only when the agent and all its children are gone.
"""

from __future__ import annotations

import asyncio
import math
import shutil
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast, get_args

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import StorageError
from evopolicy_common.messages.operator import RunFinished, SubmitRecord
from evopolicy_common.processes.scratch import give_back_rights, remove_tree
from evopolicy_common.records import bundles
from evopolicy_common.records.blobs import BlobStore, write_atomically
from evopolicy_common.records.bundles import Bundle
from evopolicy_common.records.run_record import (
    Agent,
    Artifacts,
    CheckpointMetrics,
    ExperimentDimensions,
    Outcome,
    ReferenceScore,
    RejectedStatus,
    RejectedSubmit,
    Replay,
    RunRecord,
    Timing,
    Tokens,
    Versions,
    encode_checkpoint_metrics,
    encode_run_record,
)
from evopolicy_common.records.summary import utc_text
from evopolicy_gateway.operator.operations import Operations
from evopolicy_gateway.run import replays
from evopolicy_gateway.run.layout import RunFolder, Staged
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.submits.formatting import submit_id
from evopolicy_gateway.submits.journal import Journal, Rejected


async def write(
    folder: RunFolder,
    plan: Plan,
    finished: RunFinished,
    operations: Operations,
    times: Times,
    error: str | None = None,
) -> RunRecord:
    """Writes everything and removes the gateway's folder. StorageError when the disk refuses.

    `error` tells why this command gave the run up, when it was not the operator who cancelled it.
    """
    selected: Bundle | None = None
    for submit in finished.submits:
        bundle = None if submit.bundle is None else await _bundle(folder, submit.bundle, operations)
        await asyncio.to_thread(_write_checkpoint, folder, finished, submit, bundle)
        if submit.submit_index == finished.best_submit_index:
            selected = bundle
    if selected is not None:
        await asyncio.to_thread(_put_in_place, folder.system, selected)
    if error is not None and finished.status == "cancelled":
        finished = msgspec.structs.replace(finished, status="error", error=error)
    recorded = await replays.fetch(folder.root, finished, operations)
    return await asyncio.to_thread(_write_record, folder, plan, finished, times, recorded)


def run_record(
    plan: Plan,
    finished: RunFinished,
    staged: Staged | None,
    rejected: Sequence[Rejected],
    times: Times,
    recorded: tuple[Replay, ...] = (),
) -> RunRecord:
    """The record of a finished run; pure. `staged` None: it ended before its workspace was made."""
    settings = finished.settings
    suite = catalogue.suite_of(settings.env)
    heldout = finished.heldout_returns
    return RunRecord(
        model=settings.model,
        env=settings.env,
        exp_id=settings.exp_id,
        repeat=settings.repeat,
        attempt=settings.attempt,
        run=finished.run,
        agent=_agent(plan, finished.agent),
        sandbox_tier=settings.sandbox_tier,
        jail=plan.jail.recorded,
        hidden_isolation=finished.hidden_isolation,
        experiment_dimensions=ExperimentDimensions(
            episode_budget=finished.episode_budget,
            min_episodes_per_submit=staged.min_episodes_per_submit if staged else 0,
            max_episodes_per_submit=staged.max_episodes_per_submit if staged else 0,
            policy_scope=settings.policy_scope,
            observations=settings.observations,
            simulation=settings.simulation,
            n_train=staged.n_train if staged else 0,
            n_validation=settings.n_validation or suite.n_validation,
            n_heldout=len(heldout or finished.random_heldout_returns)
            or settings.n_heldout
            or suite.n_heldout,
            video=settings.video,
            limits=settings.limits,
            finish=settings.finish,
            step_limit=settings.step_limit,
            profile=settings.profile,
            hidden_cases=settings.hidden_cases,
        ),
        timing=Timing(
            started_at=utc_text(finished.created_at),
            finished_at=utc_text(finished.finished_at),
            wall_s=round(finished.finished_at - finished.created_at, 3),
            agent_s=round(max(0.0, times.open_s - times.in_flight_s), 3),
            queue_s=round(finished.wall_s.get("queue", 0.0), 3),
            rollout_s=round(finished.wall_s.get("rollout", 0.0), 3),
            feedback_s=round(times.feedback_s, 3),
            held_s=round(times.held_s, 3),
            permit_s=round(times.permit_s, 3),
            finalise_s=round(finished.wall_s.get("finalise", 0.0), 3),
        ),
        outcome=_outcome(finished),
        rejected_submits=tuple(
            RejectedSubmit(
                status=cast(RejectedStatus, one.status),
                message=one.message,
                at=utc_text(one.at),
                after_submits=one.after_submits,
            )
            for one in rejected
            if one.status in get_args(RejectedStatus)
        ),
        artifacts=Artifacts(
            workspace="workspace" if staged else None,
            checkpoints="checkpoints" if finished.submits else None,
            agent_log="logs/agent.jsonl" if staged else None,
            replays=recorded,
        ),
        versions=_versions(finished, staged),
        audit=finished.audit,
    )


def _agent(plan: Plan, told: dict[str, Any]) -> Agent:
    tokens = told.get("tokens")
    return Agent(
        entry=plan.settings.entry,
        harness=told.get("harness") or plan.agent.partition(":")[0],
        cli_version=told.get("cli_version"),
        model_string=told.get("model_string"),
        settings={
            "agent": plan.agent,
            "wall_limit_s": plan.wall_limit_s,
            "silence_limit_s": plan.silence_s,
            **({"jail": plan.jail.chosen()} if plan.jail.chosen() else {}),
            **told.get("settings", {}),
        },
        retries=int(told.get("retries", 0)),
        turns=int(told.get("turns", 0)),
        tokens=None if tokens is None else msgspec.convert(tokens, Tokens),
    )


def _outcome(finished: RunFinished) -> Outcome:
    heldout, reference = finished.heldout_returns, finished.random_heldout_returns
    completed = finished.status == "completed"
    error = finished.error
    if finished.status == "cancelled" and error is None:
        error = "cancelled by the operator"
    auxiliary: dict[str, Any] = {
        "policy_failures": dict(finished.policy_failures),
        "infrastructure_retries": finished.infrastructure_retries,
        "nondeterministic_results": finished.nondeterministic_results,
    }
    return Outcome(
        status=finished.status,
        error=error,
        final_score=finished.final_score if completed else None,
        best_submit_index=finished.best_submit_index if completed else None,
        val_scores={str(index): mean for index, mean in finished.val_scores.items()} if completed else {},
        heldout_mean_return=finished.final_score if completed else None,
        heldout_std_return=_std(heldout) if completed and heldout else None,
        heldout_returns=heldout if completed else (),
        quarantined_submits=tuple(sorted(finished.validation_ineligible)),
        random_reference=ReferenceScore(
            mean_return=math.fsum(reference) / len(reference),
            std_return=_std(reference),
            returns=reference,
            seeded_by="case" if finished.reference_by_case else "run",
        )
        if reference
        else None,
        closed_reason=finished.close_reason,
        budget_used=finished.budget_used,
        auxiliary=auxiliary,
    )


def _versions(finished: RunFinished, staged: Staged | None) -> Versions:
    fingerprint = finished.fingerprint
    return Versions(
        harness=f"evopolicy {version('evopolicy')}",
        env=finished.env_version,
        agents_md_hash=staged.agents_md_hash if staged else "",
        data_train_hash=finished.split_hashes.get("train", ""),
        data_valid_hash=finished.split_hashes.get("validation", ""),
        data_heldout_hash=finished.split_hashes.get("heldout", ""),
        fingerprint={} if fingerprint is None else fingerprint.flat(),
        fingerprint_overrides=finished.fingerprint_overrides,
        data_secret=finished.split_secret,
        initial_policy_hash=staged.initial_policy_hash if staged else None,
        env_deterministic=finished.deterministic,
    )


def _std(values: Sequence[float]) -> float:
    """Population standard deviation."""
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - mean) * (value - mean) for value in values) / len(values))


async def _bundle(folder: RunFolder, digest: str, operations: Operations) -> Bundle:
    """From the gateway's own store, or else from the coordinator."""
    if folder.blobs.is_dir():
        try:
            return bundles.load(await asyncio.to_thread(BlobStore(folder.blobs).read, digest), digest)
        except StorageError:
            pass
    return bundles.load(await operations.download(digest), digest)


def _write_checkpoint(
    folder: RunFolder, finished: RunFinished, submit: SubmitRecord, bundle: Bundle | None
) -> None:
    """`checkpoints/submit_NNN/`: the policy as it was submitted, unchangeable, and its numbers."""
    target = folder.checkpoints / submit_id(submit.submit_index, finished.episode_budget)
    if target.exists():
        shutil.rmtree(target)
    target.mkdir(parents=True)
    files = () if bundle is None else bundle.files
    if bundle is not None:
        bundles.unpack(bundle, target / "system")
        for path in (target / "system").rglob("*"):
            if path.is_file():
                path.chmod(path.stat().st_mode & 0o555)
    metrics = CheckpointMetrics(
        submit_index=submit.submit_index,
        status=submit.status,
        digest=submit.bundle or "",
        n_episodes=len(submit.env_instances),
        consumed_budget=finished.episode_budget - submit.remaining_budget,
        mean_return=submit.mean_return,
        val_mean=submit.val_mean,
        policy_files=len(files),
        policy_bytes=sum(len(file.data) for file in files),
    )
    write_atomically(target / "metrics.json", encode_checkpoint_metrics(metrics))


def _put_in_place(system: Path, bundle: Bundle) -> None:
    """Replaces `system`, whatever its agent has left there, by the bundle."""
    give_back_rights(system.parent)
    # Only a folder is removed as one: to open a pipe would wait for its other end.
    if system.is_dir() and not system.is_symlink():
        remove_tree(system)
    else:
        system.unlink(missing_ok=True)
    bundles.unpack(bundle, system)


def _write_record(
    folder: RunFolder,
    plan: Plan,
    finished: RunFinished,
    times: Times,
    recorded: tuple[Replay, ...],
) -> RunRecord:
    staged = None
    if folder.staged.exists():
        staged = msgspec.json.decode(folder.staged.read_bytes(), type=Staged)
    rejected: list[Rejected] = []
    if folder.journal.exists():
        journal = Journal(folder.journal)
        rejected = [entry for entry in journal.entries if isinstance(entry, Rejected)]
        journal.close()
    done = run_record(plan, finished, staged, rejected, times, recorded)
    write_atomically(folder.run_json, encode_run_record(done))
    remove_tree(folder.state)
    return done
