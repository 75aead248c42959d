"""A finished run as the coordinator tells of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec.structs import replace

from evopolicy_common.messages.episode import BlobRef
from evopolicy_common.messages.gateway import EpisodeFeedback
from evopolicy_common.messages.operator import Committed, CreateRun, RunFinished, SubmitResult
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_common.records.account import run_record
from evopolicy_common.records.run_record import RunRecord
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.record import claims
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.run_folder.layout import RunFolder, Staged, save

SETTINGS = RunSettings(env="toy/line", entry="evolve", model="none", exp_id="t", budget=8)


def plan_in(root: Path, settings: RunSettings = SETTINGS, **more: Any) -> Plan:
    """The plan of a run below `root`, named after its environment."""
    usual: dict[str, Any] = {"agent": "evolve", "runs": root, "started_in": root, "wall_limit_s": 60.0}
    return Plan(name=settings.env, settings=settings, **{**usual, **more})


def mark_opened(folder: RunFolder, run: str = "r-1", settings: RunSettings = SETTINGS) -> None:
    """The folder says that the cluster has opened the run."""
    save(folder.intended, CreateRun(key="k", settings=settings, run=run))


def played_episode(**more: Any) -> EpisodeFeedback:
    """The result of an episode of one step, without its files."""
    usual: dict[str, Any] = {"index": 0, "episode_return": 0.0, "length": 1, "failure": None}
    usual |= {"reward_components": {}, "trajectory": BlobRef(digest="0" * 64, size=1), "video": None}
    return EpisodeFeedback(**{**usual, "stdout": b"", "stderr": b"", **more})


def played_submit(**fields: Any) -> SubmitResult:
    usual: dict[str, Any] = {"submit_index": 0, "status": "ok", "bundle": None, "env_instances": (0,)}
    usual |= {"remaining_budget": 0, "mean_return": 1.0, "val_mean": 1.0}
    return SubmitResult(**usual | {"started_at": 101.0, "completed_at": 102.0} | fields)


def finished(**fields: Any) -> RunFinished:
    usual: dict[str, Any] = {"run": "r-1", "settings": SETTINGS, "status": "completed", "error": None}
    usual["agent"] = {"turns": 2, "retries": 1, "settings": {"effort": "high"}, "tokens": None}
    usual |= {"closed_reason": "budget_spent", "final_score": 2.0, "best_submit_index": 1}
    usual |= {"heldout_returns": (1.0, 3.0), "heldout_successes": (), "random_heldout_returns": (0.0, 1.0)}
    usual |= {"validation_ineligible": (2,), "policy_failures": {"validation": 0, "heldout": 1}}
    usual |= {"budget": 8, "min_episodes_per_submit": 1, "max_episodes_per_submit": 8, "budget_used": 8}
    usual |= {"n_train": 64, "n_validation": 2, "n_heldout": 2, "cases_secret": True}
    usual["split_hashes"] = {"train": "a", "validation": "b", "heldout": "c"}
    usual |= {"env_version": "line-1", "deterministic": True, "env_title": "", "env_family": ""}
    usual["fingerprint"] = Fingerprint(code_version="1", python="3.11", packages={"numpy": "2.4"}, cpu="x")
    usual |= {"n_overrides": 1, "fingerprint_overrides": ("a → b: the old workers are gone",)}
    usual |= {"created_at": 100.0, "finished_at": 112.5}
    usual["wall_s"] = {"queue": 0.5, "rollout": 3.0, "finalise": 2.5}
    usual["submits"] = (played_submit(), played_submit(submit_index=1, val_mean=1.5))
    usual |= {"infrastructure_retries": 0, "nondeterministic_results": 0, "installations": ()}
    usual |= {"hidden_isolation": "unknown", "record": {}}
    usual["committed"] = Committed(commitment="c", epoch="e1", opened=0, opened_head="h")
    return RunFinished(**usual | fields)


def record_in(
    plan: Plan, done: RunFinished, staged: Staged | None = None, times: Times | None = None, **more: Any
) -> RunRecord:
    """The record of a run that the plan's command has played. `more`: of its `Claims`."""
    return run_record(done, replace(claims(plan, done.agent, staged, times or Times()), **more))
