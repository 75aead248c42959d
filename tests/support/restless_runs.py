"""A run whose workers come and go, and a calm one beside it: both must come to the same."""

from __future__ import annotations

from pathlib import Path

from commands import record_in

from evopolicy_common.records.summary import decode_summary

N_SUBMITS = 3
BUDGET = 20
SIZE = ("--budget", str(BUDGET), "--validation", "4", "--heldout", "4")


def agent_code(pause_s: float) -> str:
    """An agent for `toy/line` that makes three submits; each episode begins with a pause, so that the second takes a
    while."""
    return f'''
open("system/policy.py", "w").write("""
import time

class Policy:
    def __init__(self, *spaces):
        pass

    def reset(self, episode_index):
        time.sleep({pause_s})

    def act(self, obs):
        return [float(obs[2] - obs[0]) / 3]
""")
submit([0, 1])
submit(list(range(16)))
submit([2, 3])
'''


def assert_same(root: Path, restless: str, calm: str) -> None:
    """The runs of these names below `root/runs` are whole, and equal in all hidden and train returns."""
    one, two = (folder_of(root, name) for name in (restless, calm))
    first, second = record_in(one).outcome, record_in(two).outcome
    assert (first.status, first.budget_used) == ("completed", BUDGET)
    assert first.heldout_returns == second.heldout_returns
    assert first.val_scores == second.val_scores
    for index in range(N_SUBMITS):
        path = f"workspace/feedback/submit_{index:03d}/summary.json"
        document, other = (decode_summary((folder / path).read_bytes()) for folder in (one, two))
        assert document.returns == other.returns
        assert document.errors == other.errors == ()


def folder_of(root: Path, name: str) -> Path:
    """The directory of the run with this `--exp-id`."""
    (found,) = (root / "runs").glob(f"*/toy_line/{name}")
    return found
