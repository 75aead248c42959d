"""A finished run as the coordinator tells of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.gateway import EpisodeFeedback
from evopolicy_common.messages.operator import RunFinished, SubmitRecord
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_gateway.run.plan import Plan

SETTINGS = RunSettings(env="toy/line", entry="evolve", model="none", exp_id="t", budget=8)


def plan_in(root: Path, settings: RunSettings = SETTINGS, **more: Any) -> Plan:
    """The plan of a run below `root`, named after its environment."""
    usual: dict[str, Any] = {"agent": "evolve", "runs": root, "started_in": root, "wall_limit_s": 60.0}
    return Plan(name=settings.env, settings=settings, **{**usual, **more})


def played_episode(**more: Any) -> EpisodeFeedback:
    """The result of an episode of one step, without its files."""
    usual: dict[str, Any] = {"index": 0, "episode_return": 0.0, "length": 1, "failure": None}
    usual |= {"reward_components": {}, "trajectory": BlobRef(digest="0" * 64, size=1), "video": None}
    return EpisodeFeedback(**{**usual, "stdout": b"", "stderr": b"", **more})


def finished(**fields: Any) -> RunFinished:
    usual: dict[str, Any] = {
        "run": "r-1",
        "settings": SETTINGS,
        "status": "completed",
        "error": None,
        "closed_reason": "budget_spent",
        "agent": {"turns": 2, "retries": 1, "settings": {"effort": "high"}, "tokens": None},
        "final_score": 2.0,
        "best_submit_index": 1,
        "val_scores": {0: 1.0, 1: 1.5},
        "heldout_returns": (1.0, 3.0),
        "validation_ineligible": {2: "brought its slot down"},
        "policy_failures": {"validation": 0, "heldout": 1},
        "random_heldout_returns": (0.0, 1.0),
        "episode_budget": 8,
        "budget_used": 8,
        "split_hashes": {"train": "a", "validation": "b", "heldout": "c"},
        "split_secret": True,
        "env_version": "line-1",
        "deterministic": True,
        "fingerprint": Fingerprint(code_version="1", python="3.11", packages={"numpy": "2.4"}, cpu="x"),
        "created_at": 100.0,
        "closed_at": 110.0,
        "finished_at": 112.5,
        "submits": (
            SubmitRecord(
                submit_index=0,
                status="ok",
                bundle=None,
                env_instances=(0,),
                remaining_budget=0,
                mean_return=1.0,
                val_mean=1.0,
                started_at=101.0,
                completed_at=102.0,
            ),
        ),
        "wall_s": {"queue": 0.5, "rollout": 3.0, "finalise": 2.5},
        "fingerprint_overrides": ("a → b: the old workers are gone",),
    }
    return RunFinished(**usual | fields)
