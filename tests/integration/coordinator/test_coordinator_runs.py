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
    play,
    run,
    working,
)

from evopolicy_common.errors import RefusedError


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
        assert finished.split_secret
        by_split = {spec.case.seed for job in worker.jobs for spec in job.episodes}
        assert len(by_split) == 3 + 16 + 32
    assert coordinator.stop() == 0


async def test_feedback_is_what_was_handed_in_and_nothing_more(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator, working(coordinator) as worker:
        created = await operator.create()
        async with gateway_of(coordinator, created) as gateway:
            bundle = bundle_of("# policy")
            await gateway.submit(bundle, tuple(range(16)), "only")
            episodes, done = await gateway.results(0)
            expected = {
                spec.index: play(job, spec)
                for job in worker.jobs
                for spec in job.episodes
                if job.record == "full"
            }
            assert done.n_kept == 16
            for episode in episodes:
                outcome = expected[episode.index]
                assert episode.episode_return == outcome.episode_return
                assert episode.trajectory == outcome.trajectory
                assert episode.stdout == b"hello"
            again, _ = await gateway.results(0)
            assert again == episodes


async def test_repeated_keys_charge_once_and_make_one_run(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator, working(coordinator):
        created = await operator.create()
        assert await operator.create() == created
        async with gateway_of(coordinator, created) as gateway:
            first = await gateway.submit(bundle_of("# policy"), (0, 1), "same")
            assert await gateway.submit(bundle_of("# policy"), (0, 1), "same") == first
            await gateway.results(0)
            assert (await gateway.state()).remaining_budget == 14


async def test_rejected_requests_cost_no_budget(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator, working(coordinator):
        created = await operator.create()
        async with gateway_of(coordinator, created) as gateway:
            bundle = bundle_of("# policy")
            for ids, status in (
                ((0,) * 17, "budget_invalid"),
                ((), "budget_invalid"),
                ((64,), "invalid_env_instance"),
            ):
                with pytest.raises(RefusedError) as refused:
                    await gateway.submit(bundle, ids, f"key-{ids}")
                assert refused.value.status == status, (ids, refused.value)
            with pytest.raises(RefusedError) as refused:
                await gateway.submit_digest("0" * 64, (0,), "nothing")
            assert refused.value.status == "missing_bundle"
            state = await gateway.state()
            assert (state.remaining_budget, state.n_submits) == (16, 0)


async def test_two_workers_share_a_submit(coordinator: Coordinator) -> None:
    async with (
        operator_of(coordinator) as operator,
        working(coordinator, "w-1", slots=1) as first,
        working(coordinator, "w-2", slots=1) as second,
    ):
        created = await operator.create(budget=64)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.open()
            await gateway.submit(bundle_of("# policy"), tuple(range(64)), "wide")
            await gateway.results(0)
        assert len({job.job_id for job in first.jobs + second.jobs}) >= 64
        assert first.jobs
        assert second.jobs


async def test_evaluation_plays_cases_outside_any_run(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator, working(coordinator):
        bundle = bundle_of("# policy")
        await operator.ask.upload("operator", operator.token, bundle.digest, bundle.packed)
        tried = await operator.evaluate(
            "try", bundle=bundle.digest, split="train", cases=(3, 3, 1), sandbox_tier="bwrap"
        )
        assert sorted(outcome.index for outcome in tried) == [0, 1, 2]
        returns = {outcome.index: outcome.episode_return for outcome in tried}
        assert returns[0] == returns[1] != returns[2]
        reference = await operator.evaluate(
            "random", bundle=None, split="heldout", cases=None, record="actions"
        )
        assert len(reference) == 32
        with pytest.raises(RefusedError, match="case 64 of toy/line"):
            await operator.evaluate("wrong", bundle=None, split="train", cases=(64,))


async def test_worker_that_comes_late_finds_the_submit_waiting(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as operator:
        created = await operator.create()
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("# policy"), (0, 1), "early")
            in_flight = (await gateway.state()).in_flight
            assert in_flight is not None
            assert in_flight.n_done == 0
            assert in_flight.waits_for
            async with working(coordinator):
                _, done = await gateway.results(0)
            assert done.status == "ok"


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
