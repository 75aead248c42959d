"""Writes synthetic run directories: the real layout, real small policies and real edits, invented scores."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, pstdev
from typing import Any

import msgspec

from evopolicy_common.records.policies import checkpoints
from evopolicy_common.records.policies.bundles import BundleFile, pack
from evopolicy_common.records.policies.checkpoints import CheckpointMeta
from evopolicy_common.records.run_record import (
    Agent,
    Artifacts,
    ExperimentDimensions,
    Outcome,
    ReferenceScore,
    RejectedSubmit,
    Replay,
    RunRecord,
    Timing,
    Tokens,
    Versions,
    encode_run_record,
)
from evopolicy_common.records.summary import SCHEMA_VERSION, Summary, utc_text
from evopolicy_gateway.run_folder.layout import submit_id
from invented.agent_logs import LOGS
from invented.policies import Version

START = 1_760_000_000.0


def write_run(
    runs: Path,
    versions: Sequence[Version],
    *,
    entry: str = "Agent A",
    harness: str = "claude-code",
    env: str = "gym/acrobot",
    exp_id: str = "exp",
    repeat: int = 0,
    budget: int = 128,
    heldout: Sequence[float] | None = None,
    random_mean: float | None = -500.0,
    tokens: Tokens | None = None,
    log: str | None = "claude",
    rejected: int = 0,
    replays: Mapping[str, bytes] | None = None,
    split: str = "split-1",
    fingerprint: Mapping[str, str] | None = None,
    status: str | None = None,
    closed_reason: str | None = None,
    settings: Mapping[str, Any] | None = None,
    change: Mapping[str, Any] | None = None,
    **fields: Any,
) -> Path:
    """Writes one run directory under `runs` and returns it. `heldout` defaults to the best validation score alone.
    `change`: as of `amend`. `fields` of the record or of its dimensions, such as `jail` or `policy_scope`."""
    dimensions = {name: fields.pop(name) for name in ExperimentDimensions.__struct_fields__ if name in fields}
    folder = (
        runs / entry.replace(" ", "-") / env.replace("/", "_") / (exp_id + (f"-{repeat}" if repeat else ""))
    )
    remaining, first, clock = budget, 0, START
    val_scores: dict[str, float] = {}
    for index, version in enumerate(versions):
        clock += 60.0
        remaining -= len(version.returns)
        _write_submit(folder, index, version, env, budget, remaining, first, clock)
        first += len(version.returns)
        clock += 20.0
        if version.status == "ok" and version.val is not None:
            val_scores[str(index)] = version.val
    best = max(val_scores, key=lambda key: (val_scores[key], int(key))) if val_scores else None
    if heldout is None:
        heldout = [val_scores[best]] if best is not None else []
    replay_records = _write_replays(folder, replays or {}, int(best or 0))
    record = RunRecord(
        model=entry,
        env=env,
        exp_id=exp_id,
        repeat=repeat,
        agent=Agent(
            entry=entry,
            harness=harness,
            model_string=entry.lower(),
            settings={"program": ["agent"]} if settings is None else dict(settings),
            turns=len(versions),
            tokens=tokens,
        ),
        sandbox_tier="bwrap",
        **{"jail": "bwrap", "hidden_isolation": "exclusive", **fields},
        experiment_dimensions=ExperimentDimensions(
            episode_budget=budget,
            min_episodes_per_submit=1,
            max_episodes_per_submit=budget,
            n_train=64,
            n_validation=16,
            n_heldout=32,
            **{"policy_scope": "episode", "observations": "arrays", "simulation": "forbidden", **dimensions},
        ),
        timing=Timing(
            start_time=utc_text(START),
            end_time=utc_text(clock + 90.0),
            wall_time_seconds=clock + 90.0 - START,
            agent_s=60.0 * len(versions),
            queue_s=1.5 * len(versions),
            rollout_s=16.0 * len(versions),
            feedback_s=2.5 * len(versions),
            finalise_s=90.0,
        ),
        outcome=Outcome(
            status=status or ("completed" if best is not None else "no_ok_submit"),
            error="worker lost" if status == "error" else None,
            final_score=fmean(heldout) if heldout else None,
            best_submit_index=int(best) if best is not None else None,
            val_scores=val_scores,
            heldout_mean_return=fmean(heldout) if heldout else None,
            heldout_std_return=pstdev(heldout) if heldout else None,
            heldout_returns=tuple(heldout),
            random_reference=(
                ReferenceScore(mean_return=random_mean, std_return=1.0) if random_mean is not None else None
            ),
            closed_reason=closed_reason or ("budget_spent" if remaining == 0 else "agent_stopped"),
            budget_used=budget - remaining,
        ),
        rejected_submits=tuple(
            RejectedSubmit(status="budget_invalid", message="asks for 200 of 128 episodes", after_submits=i)
            for i in range(rejected)
        ),
        artifacts=Artifacts(
            **{name: name for name in ("workspace", "checkpoints")}, logs_agent="logs/agent.jsonl"
        ),
        replays=replay_records,
        versions=Versions(
            harness="0.1.0",
            env=f"{env} (test)",
            agents_md_hash=_sha("agents"),
            data_train_hash=_sha(f"{split} train {env}"),
            data_valid_hash=_sha(f"{split} valid {env}"),
            data_heldout_hash=_sha(f"{split} heldout {env}"),
            fingerprint=dict(fingerprint or {"numpy": "2.4.6"}),
        ),
    )
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    (folder / "logs" / "harness.log").write_text(json.dumps({"event": "run_opened"}) + "\n")
    if log is not None:
        lines = LOGS[log](versions)
        (folder / "logs" / "agent.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "run.json").write_bytes(encode_run_record(record))
    amend(folder, change or {})
    return folder


def amend(folder: Path, change: Mapping[str, Any]) -> None:
    """Puts fields into the run's `run.json`, into nested objects too; the value `...` removes a field."""

    def merged(old: Any, new: Any) -> Any:
        if not isinstance(old, dict) or not isinstance(new, Mapping):
            return new
        whole = old | {key: merged(old.get(key), value) for key, value in new.items()}
        return {key: value for key, value in whole.items() if value is not ...}

    path = folder / "run.json"
    path.write_text(json.dumps(merged(json.loads(path.read_bytes()), change)))


def _write_submit(
    folder: Path,
    index: int,
    version: Version,
    env: str,
    budget: int,
    remaining: int,
    first: int,
    clock: float,
) -> None:
    ok = version.status == "ok"
    returns = tuple(float(value) for value in version.returns)
    summary = Summary(
        schema_version=SCHEMA_VERSION,
        submit_index=index,
        env=env,
        status=version.status,
        n_episodes=len(returns),
        first_global_episode=first if ok else None,
        env_instances=tuple(range(len(returns))),
        remaining_budget=remaining,
        submit_started_at=utc_text(clock),
        submit_completed_at=utc_text(clock + 20.0),
        wall_time_seconds=20.0,
        returns=returns if ok else None,
        mean_return=fmean(returns) if ok else None,
        std_return=pstdev(returns) if ok else None,
        min_return=min(returns) if ok else None,
        max_return=max(returns) if ok else None,
        episode_lengths=(100,) * len(returns) if ok else None,
        mean_episode_length=100.0 if ok else None,
        timeouts=() if ok else None,
        errors=tuple(version.failed) if ok else None,
    )
    feedback = folder / "workspace" / "feedback" / submit_id(index, budget)
    feedback.mkdir(parents=True)
    (feedback / "summary.json").write_bytes(msgspec.json.encode(summary))
    checkpoint = folder / "checkpoints" / submit_id(index, budget)
    files = {**{name: text.encode() for name, text in version.files.items()}, **version.images}
    meta = CheckpointMeta(
        submit_index=index,
        submit_time=utc_text(clock),
        n_episodes_requested=len(returns),
        remaining_budget_before=remaining + len(returns),
        remaining_budget_after=remaining,
        validation_status=version.status,
        mean_return=summary.mean_return,
        val_mean=version.val,
    )
    bundle = pack([BundleFile(name, False, data) for name, data in files.items()])
    checkpoints.write(checkpoint, meta, bundle, checkpoints.measured(bundle))


def _write_replays(folder: Path, replays: Mapping[str, bytes], best: int) -> tuple[Replay, ...]:
    out: list[Replay] = []
    for number, (name, data) in enumerate(replays.items()):
        path = folder / "replays" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        known = {"path": f"replays/{name}", "split": "heldout", "submit_index": best, "length": 100}
        out.append(Replay(episode=number, episode_return=-80.0 - number, **known))
    return tuple(out)


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
