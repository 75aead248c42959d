"""Rows for tests, as a core would persist them."""

from __future__ import annotations

import hashlib
from typing import Any

from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.messages.operator import Committed
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_coordinator.core.contract.records import OutcomeRow, RunRow, RunStateRow, SubmitRow

COMMITTED = Committed(commitment="c", epoch="e1", opened=0, opened_head="h")
SETTINGS = RunSettings(env="toy/line", entry="tester", model="none", exp_id="t")


def run_row(run: str = "r-1", **changes: Any) -> RunRow:
    values: dict[str, Any] = {"key": f"key-{run}", "capability": f"capability-{run}", "secret": b"s" * 32}
    values |= {"settings": SETTINGS, "budget": 8, "min_episodes_per_submit": 1, "max_episodes_per_submit": 8}
    values |= {
        "train": (Case(seed=1), Case(seed=2)),
        "validation": (Case(seed=3),),
        "heldout": (Case(seed=4),),
    }
    values |= {"split_hashes": {}, "cases_secret": True, "policy_seeds": "", "epoch": "e1", "salt": b"n" * 32}
    values |= {"max_steps": 0, "allowed_imports": (), "denied_imports": ()}
    return RunRow(run=run, **{**values, **changes})


def state_row(**changes: Any) -> RunStateRow:
    return RunStateRow(**{"run": "r-1", "committed": COMMITTED, **changes})


def submit_row(submit_index: int = 0, **changes: Any) -> SubmitRow:
    values: dict[str, Any] = {"run": "r-1", "key": f"submit-{submit_index}", "env_instances": (0, 1)}
    values |= {"bundle": "b" * 64, "first_global_episode": 0, "remaining_budget": 6, "accepted_at": 1000.0}
    return SubmitRow(submit_index=submit_index, **{**values, **changes})


def blob(data: bytes, *, inline: bool = True) -> BlobRef:
    return BlobRef(digest=hashlib.sha256(data).hexdigest(), size=len(data), inline=data if inline else None)


def outcome_row(group: str, index: int, seq: int, trajectory: BlobRef | None = None) -> OutcomeRow:
    kept = trajectory or blob(b"trajectory %d" % index)
    values = {"episode_return": float(index), "length": 3, "terminated": True, "truncated": False}
    outcome = EpisodeOutcome(index=index, trajectory=kept, **values)
    played = {"job_id": f"{group}/{index}", "attempt": 1, "worker": "w", "fingerprint_class": "c"}
    return OutcomeRow(group=group, index=index, seq=seq, outcome=outcome, at=1001.0, **played)
