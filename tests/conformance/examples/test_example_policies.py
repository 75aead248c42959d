"""The example policies played by sandboxed slots: clearly better than random where they say so."""

from __future__ import annotations

import asyncio
import csv
from importlib.resources import files
from pathlib import Path

import pytest

from evopolicy_common import catalogue
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import EpisodeSpec, Job
from evopolicy_worker.slots.slot import Slot

POLICIES = Path(__file__).parents[3] / "examples" / "policies"
CORE16 = catalogue.suites()["core16"].environments
N_CASES = 2


def paper_returns() -> dict[str, tuple[float, float]]:
    """Random's and the best agent's held-out mean by environment (Table 1 of the paper)."""
    text = files("evopolicy_results").joinpath("data/table1_heldout_returns.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    return {
        env: (
            next(float(row[env]) for row in rows if row["entry"] == "Random policy"),
            max(float(row[env]) for row in rows if row["entry"] != "Random policy"),
        )
        for env in CORE16
    }


async def play(slot: Slot, env: str) -> float:
    """Mean return over a few cases; an assertion fails when the policy does."""
    job = Job(
        job_id=f"example {env}",
        env=env,
        bundle="0" * 64,
        env_meta={"env": env},
        episodes=tuple(
            EpisodeSpec(index=i, episode_index=i, case=Case(seed=31_000 + i), policy_seed=bytes([i] * 16))
            for i in range(N_CASES)
        ),
    )
    outcomes = await slot.play_job(job, catalogue.policy_folder(POLICIES, env), lambda done, steps: None)
    assert [outcome.failure for outcome in outcomes] == [None] * N_CASES, env
    return sum(outcome.episode_return for outcome in outcomes) / N_CASES


@pytest.mark.system
def test_examples_reach_half_of_the_papers_best_on_twelve_of_sixteen(tmp_path: Path) -> None:
    async def scenario() -> dict[str, float]:
        slot = Slot(None, "bwrap", tmp_path / "slot")
        await slot.start()
        try:
            return {env: await play(slot, env) for env in CORE16}
        finally:
            await slot.close()

    returns = asyncio.run(scenario())
    paper = paper_returns()
    scores = {env: (returns[env] - paper[env][0]) / (paper[env][1] - paper[env][0]) for env in CORE16}
    assert sum(score >= 0.5 for score in scores.values()) >= 12, scores
