"""Writes run directories of the published software: every file and field from `published-protocol.md`, nothing else.

A line of that file is cited where it is followed. Standard library only, and no code of the product: what reads these
directories is tested against the facts, not against our writer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

POLICY = """class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.gain = {gain}

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return 1 if obs[0] * self.gain > 0 {more}else 0
"""
SUBMITS = (
    ("ok", 0.5, "", -300.0),
    ("ok", 1.5, "", -150.0),
    ("init_error", 0.0, "", None),
    ("ok", 1.5, "and obs[1] ", -90.0),
)
"""Status, two parts of the policy, validation mean."""
LOGS = ("harness.log", "agent.jsonl", "env.log")


def write_published_run(
    runs: Path,
    *,
    model: str = "model-a",
    env: str = "gym/acrobot",
    exp_id: str = "exp-1",
    submits: Sequence[Any] = SUBMITS,
) -> Path:
    """One run directory `runs/<model>/<env>/<exp-id>/` (line 17); `submits` of 8 of 32 episodes each."""
    folder = runs / model / env / exp_id
    for name in ("workspace/system", "workspace/feedback", "checkpoints", "logs"):
        (folder / name).mkdir(parents=True)
    (folder / "workspace/AGENTS.md").write_text("the rules\n")
    for name in LOGS:
        (folder / "logs" / name).write_text("")
    metrics: dict[str, Any] = {}
    scores: dict[str, float] = {}
    remaining = 32
    for index, (status, gain, more, score) in enumerate(submits):
        text = POLICY.format(gain=gain, more=more)
        metrics[str(index)] = _checkpoint(folder, index, status, text, remaining)
        remaining -= 8
        _summary(folder, index, status, env, score, remaining)
        if score is not None:
            scores[str(index)] = score
    best = max(scores, key=lambda name: (scores[name], int(name)), default=None)
    if best is not None:
        checkpoint = folder / "checkpoints" / f"submit_{int(best):03d}"
        policy = (checkpoint / "policy.py").read_bytes()
        (folder / "workspace/system/policy.py").write_bytes(policy)  # line 18
    trend = (
        *("source_lines", "python_files", "functions", "classes", "cyclomatic_total", "cyclomatic_max"),
        "tree_hash",
    )
    run = {
        "schema_version": "0.1",  # line 23
        "timing": {
            "start_time": "2026-01-01T00:00:00Z",
            "end_time": "2026-01-01T00:10:00Z",
            "wall_time_seconds": 600.0,
        },
        "outcome": {
            "status": "completed" if best is not None else "no_ok_submit",
            "final_score": scores[best] - 5.0 if best is not None else 0.0,  # line 24
            "best_submit_index": int(best) if best is not None else None,
            "val_scores": scores if best is not None else None,
            "auxiliary": {
                "code_metrics_best": metrics[best] if best is not None else None,
                "code_metrics_by_submit": metrics,
                "code_metrics_trend": {
                    "submits": [int(name) for name in metrics],
                    **{name: [one[name] for one in metrics.values()] for name in trend},
                },
            },
        },
        "artifacts": {
            "workspace": "workspace",
            "feedback": "workspace/feedback",
            "checkpoints": "checkpoints",
            **{f"logs_{name.partition('.')[0]}": f"logs/{name}" for name in LOGS},
        },
        "versions": {
            "harness": "published",
            "env": "Acrobot-v1",
            "agents_md_hash": _hash(b"the rules\n"),
            **{f"data_{split}_hash": _hash(split.encode()) for split in ("train", "valid", "heldout")},
        },
    }
    (folder / "run.json").write_text(json.dumps(run))
    return folder


def _checkpoint(folder: Path, index: int, status: str, text: str, remaining: int) -> dict[str, Any]:
    """`_meta.json` (line 19) and `metrics.json` (lines 20 to 22) beside the policy."""
    checkpoint = folder / "checkpoints" / f"submit_{index:03d}"
    checkpoint.mkdir()
    (checkpoint / "policy.py").write_text(text)
    meta = {
        "schema_version": "0.1",
        "submit_index": index,
        "submit_time": f"2026-01-01T00:0{index}:00Z",
        "n_episodes_requested": 8,
        "remaining_budget_before": remaining,
        "remaining_budget_after": remaining - 8,
        "snapshot_size_bytes": len(text),
        "snapshot_files": 1,
        "import_scan": None,
        "validation_status": status,
    }
    lines = text.splitlines()
    complexity = [1, 1, 3 if " and " in text else 2]
    metrics = {
        "schema_version": "0.1",
        **dict.fromkeys(("files", "python_files", "classes"), 1),
        **dict.fromkeys(("bytes", "policy_bytes"), len(text)),
        "lines": len(lines),
        "source_lines": sum(1 for line in lines if line.strip()),
        "functions": 3,
        "imports": [],
        "import_count": 0,
        "parse_errors": [],
        "test_files": 0,
        "cyclomatic_total": sum(complexity),
        "cyclomatic_max": max(complexity),
        "tree_hash": _hash(b"policy.py\0" + text.encode() + b"\0"),
    }
    (checkpoint / "_meta.json").write_text(json.dumps(meta))
    (checkpoint / "metrics.json").write_text(json.dumps(metrics))
    return metrics


def _summary(folder: Path, index: int, status: str, env: str, score: float | None, remaining: int) -> None:
    """`summary.json` (line 25), with the fields of the published protocol's text."""
    ok = status == "ok"
    returns = [score - 10.0 + step for step in range(8)] if score is not None else None
    summary = {
        "schema_version": "0.1",
        "submit_index": index,
        "env": env,
        "status": status,
        "first_global_episode": 8 * index if ok else None,
        "env_instances": list(range(8)),
        "remaining_budget": remaining,
        "returns": returns,
        "mean_return": sum(returns) / 8 if returns else None,
        "std_return": 0.0 if ok else None,
        "min_return": min(returns) if returns else None,
        "max_return": max(returns) if returns else None,
        "episode_lengths": [500] * 8 if ok else None,
        "mean_episode_length": 500.0 if ok else None,
        "timeouts": [] if ok else None,
        "errors": [] if ok else None,
    }
    target = folder / "workspace/feedback" / f"submit_{index:03d}"
    target.mkdir()
    (target / "summary.json").write_text(json.dumps(summary))


def _hash(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()}"
