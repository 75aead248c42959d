"""A coordinator that was started on an earlier backup gets from a gateway what it has lost."""

from __future__ import annotations

import asyncio
from pathlib import Path

from gateway_double import Served, prepared
from gateway_double import gateway_on as gateway_of

from evopolicy_common.messages.gateway import Submit

IDS = [1, 2, 3]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def state(s: Served) -> tuple[int, int]:
    """Submits and remaining budget of the run at the coordinator."""
    core = s.double.world.service.host.core
    assert core is not None
    run = core.state.runs[s.double.run_id]
    return len(run.submits), run.ledger.available


async def test_lost_submits_are_sent_again_before_the_next_one(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double), gateway_of(folder, double) as s:
        run = double.run_id
        double.back_up(tmp_path / "before")
        for _ in range(2):
            assert (await s.submit(IDS)).status_code == 200
        left, written = state(s)[1], files(folder.feedback)
        await double.restore(tmp_path / "before")
        assert (double.run_id, state(s)[0]) == (run, 0)
        assert (await s.info())["state"]["remaining_budget"] == left
        answer = await s.submit(IDS)
        assert (answer.status_code, answer.json()["submit_id"]) == (200, 2)
        assert state(s) == (3, left - len(IDS))
        assert written.items() <= files(folder.feedback).items()
        assert len({each.key for each in double.submits}) == 3
        assert await s.close()
        assert double.closed is not None
        assert double.closed.after == 3


async def test_the_submit_in_flight_is_played_again_in_another_order(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double), gateway_of(folder, double) as s:
        await s.submit(IDS)
        twin = files(folder.feedback / "submit_000" / "episodes")
        double.back_up(tmp_path / "before")
        double.order = lambda n: [0, 1]
        going = asyncio.create_task(s.submit(IDS))
        while (await s.http.get(f"{s.urls.submit}/1")).json().get("n_done") != 2:
            await asyncio.sleep(0.01)
        double.order = lambda n: [2, 0, 1]
        await double.restore(tmp_path / "before")
        answer = await going
        assert (answer.status_code, answer.json()["status"]) == (200, "ok")
        again = files(folder.feedback / "submit_001" / "episodes")
        assert [data for _, data in sorted(again.items())] == [data for _, data in sorted(twin.items())]


async def test_an_open_submit_of_the_backup_is_read_from_the_start(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double), gateway_of(folder, double) as s:
        double.go.clear()
        going = asyncio.create_task(s.submit(IDS))
        while not double.submits:
            await asyncio.sleep(0.01)
        double.back_up(tmp_path / "before")
        double.order = lambda n: [0, 1]
        double.go.set()
        while (await s.http.get(f"{s.urls.submit}/0")).json().get("n_done") != 2:
            await asyncio.sleep(0.01)
        double.order = lambda n: [2, 0, 1]
        await double.restore(tmp_path / "before")
        answer = await going
        assert (answer.status_code, answer.json()["summary"]["errors"]) == (200, [])
        assert len(list((folder.feedback / "submit_000" / "episodes").iterdir())) == len(IDS)


async def test_a_lost_closing_is_repeated_by_the_next_gateway(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        double.back_up(tmp_path / "before")
        async with gateway_of(folder, double) as s:
            await s.submit(IDS)
            assert await s.close("wall_limit")
        await double.restore(tmp_path / "before")
        double.closed = None
        n_asked = len(double.asked)
        async with gateway_of(folder, double) as s:
            assert await s.task
        assert double.closed is not None
        assert (double.closed.reason, double.closed.after) == ("wall_limit", 1)
        again = [each for each in double.asked[n_asked:] if isinstance(each, Submit)]
        assert {each.key for each in again} == {each.key for each in double.submits}
