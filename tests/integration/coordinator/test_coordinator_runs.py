"""Whole runs through a real coordinator process over Zenoh: from the first submit to the finished run."""

from __future__ import annotations

from pathlib import Path

import pytest
from coordinator_harness import (
    Coordinator,
    GatewayClient,
    bundle_of,
    comparable,
    gateway_of,
    operator_of,
    run,
    working,
)


async def play_two_submits(gateway: GatewayClient) -> None:
    for number in range(2):
        accepted = await gateway.submit(bundle_of(f"# policy {number}"), (0, 1, 1, 5), f"submit-{number}")
        assert accepted.submit_index == number
        assert accepted.remaining_budget == 16 - 4 * (number + 1)
        episodes, done = await gateway.results(number)
        assert sorted(episode.index for episode in episodes) == [0, 1, 2, 3]
        assert done.status == "ok"
        assert done.env_instances == (0, 1, 1, 5)


async def test_run_goes_from_submit_to_feedback_to_held_out_score(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator, working(coordinator) as worker:
        created = await operator.create()
        async with gateway_of(coordinator, created) as gateway:
            opened = await gateway.open()
            assert opened.n_env_instances == 64
            assert opened.episode_budget == 16
            assert opened.env.task_text == "# A line"
            await play_two_submits(gateway)
            assert (await operator.progress(created.run, 0.1)).finished is None
            await gateway.close()
            assert (await gateway.state()).is_finalized
        finished = await operator.finished(created.run)
        assert finished.status == "completed"
        assert finished.budget_used == 8
        assert set(finished.val_scores) == {0, 1}
        assert finished.best_submit_index == max(
            finished.val_scores, key=lambda i: (finished.val_scores[i], i)
        )
        assert len(finished.heldout_returns) == 32
        assert finished.final_score == pytest.approx(sum(finished.heldout_returns) / 32)
        assert len(finished.random_heldout_returns) == 32
        assert set(finished.split_hashes) == {"train", "validation", "heldout"}
        assert finished.cases_secret
        by_split = {spec.case.seed for job in worker.jobs for spec in job.episodes}
        assert len(by_split) == 3 + 16 + 32
    assert coordinator.stop() == 0


def test_same_submits_give_the_same_run_whatever_the_workers(tmp_path: Path) -> None:
    """Two coordinators with one secret; one worker of one slot against three of four."""
    seen = []
    (tmp_path / "a").mkdir(mode=0o700)
    for name, workers, slots in (("a", 1, 1), ("b", 3, 4)):
        state = tmp_path / name
        if name == "b":
            state.mkdir(mode=0o700)
            (state / "secret").write_bytes((tmp_path / "a" / "secret").read_bytes())
            (state / "secret").chmod(0o600)
        coordinator = Coordinator(state)

        async def scenario(
            coordinator: Coordinator = coordinator, workers: int = workers, slots: int = slots
        ) -> None:
            async with operator_of(coordinator) as operator:
                tasks = [working(coordinator, f"w-{n}", slots=slots) for n in range(workers)]
                for task in tasks:
                    await task.__aenter__()
                created = await operator.create()
                async with gateway_of(coordinator, created) as gateway:
                    await play_two_submits(gateway)
                    await gateway.close()
                seen.append(comparable(await operator.finished(created.run)))
                for task in tasks:
                    await task.__aexit__(None, None, None)

        try:
            run(scenario)
        finally:
            coordinator.kill()
    assert seen[0] == seen[1]
