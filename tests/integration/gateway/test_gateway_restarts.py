"""A gateway that dies, a coordinator that is away: nothing is lost, nothing charged twice."""

from __future__ import annotations

import asyncio
import gc
import shutil
import socket
import tracemalloc
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from edits import overwrite
from gateway_double import Double, gateway_on, opened, prepared, served

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.gateway import CloseRun, Submit
from evopolicy_gateway.http import server
from evopolicy_gateway.submits import pipeline as submits
from evopolicy_gateway.submits.feedback import SubmitTree

IDS = [1, 2, 3]


async def test_a_restarted_gateway_has_the_same_urls_and_completes_the_feedback(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        async with gateway_on(folder, double) as s:
            urls = s.urls
            rules = (folder.workspace / "AGENTS.md").read_bytes()
            double.go.clear()
            await s.submit(IDS, wait=False, key="mine")
            (folder.system / "policy.py").write_text("class Policy: 'edited meanwhile'\n")
        assert not (folder.feedback / "submit_000").exists()
        double.go.set()
        async with gateway_on(folder, double) as s:
            assert s.urls == urls
            assert (folder.workspace / "AGENTS.md").read_bytes() == rules
            again = await s.submit(IDS, key="mine")
            assert again.status_code == 200
            assert (folder.feedback / "submit_000" / "summary.json").read_bytes() in again.content
            assert (await s.submit(IDS)).json()["submit_id"] == 1
    assert [submit.env_instances for submit in double.submits] == [(1, 2, 3), (1, 2, 3)]
    assert double.submits[0].bundle != double.submits[1].bundle


async def test_an_answer_survives_a_restart_and_a_changed_file(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        async with gateway_on(folder, double) as s:
            before = await s.submit(IDS)
        overwrite(folder.feedback / "submit_000" / "summary.json", "{}")
        async with gateway_on(folder, double) as s:
            after = await s.http.get(f"{s.urls.submit}/submit_000")
            assert after.content == before.content


async def test_a_submit_waits_for_a_coordinator_that_is_away(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        double = s.double
        double.up = False
        request = asyncio.create_task(s.submit(IDS))
        info = await s.http.get(s.urls.info)
        assert info.status_code == 200
        assert info.json()["state"]["n_submits"] == 0
        await asyncio.sleep(0.3)
        assert not request.done()
        double.up = True
        assert (await request).status_code == 200
    keys = {message.key for message in double.asked if isinstance(message, Submit)}
    assert len(keys) == 1


async def test_a_request_written_down_but_never_sent_is_sent_after_the_restart(tmp_path: Path) -> None:
    async with prepared(tmp_path) as (folder, double):
        async with gateway_on(folder, double) as s:
            double.up = False
            request = asyncio.create_task(s.submit(IDS))
            while not folder.journal.read_bytes():
                await asyncio.sleep(0.01)
        request.cancel()
        assert double.submits == []
        double.up = True
        async with gateway_on(folder, double) as s:
            await s.pipeline.idle()
            assert (folder.feedback / "submit_000" / "summary.json").is_file()


async def test_feedback_is_written_once_the_disk_takes_it(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(submits, "DISK_PAUSE_S", 0.01)
    failures = iter([OSError(28, "No space left on device")] * 3)
    real = SubmitTree.put_episode

    def put_episode(self: SubmitTree, name: str, files: dict[str, bytes]) -> None:
        if name == "ep_001" and (error := next(failures, None)):
            raise error
        real(self, name, files)

    monkeypatch.setattr(SubmitTree, "put_episode", put_episode)

    async with served(tmp_path) as s:
        assert (await s.submit(IDS)).status_code == 200
        episodes = s.folder.feedback / "submit_000" / "episodes"
        assert sorted(path.name for path in episodes.iterdir()) == ["ep_000", "ep_001", "ep_002"]


async def test_feedback_tampered_with_while_written_comes_out_whole(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    async with served(tmp_path) as s:
        feedback = s.folder.feedback
        shutil.rmtree(feedback)
        feedback.symlink_to(outside)
        await s.submit(IDS)
        assert not feedback.is_symlink()
        (feedback / "submit_001").mkdir()
        (feedback / "submit_001" / "forged").write_text("x")
        (feedback / "submit_001.partial").symlink_to(outside)
        await s.submit(IDS)
        assert {path.name for path in (feedback / "submit_001").iterdir()} == {"episodes", "summary.json"}
    assert list(outside.iterdir()) == []


async def test_a_coordinator_that_refuses_for_want_of_disk_is_asked_again(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        double = s.double
        double.world.full = True
        request = asyncio.create_task(s.submit(IDS))
        await asyncio.sleep(0.2)
        assert not request.done()
        double.world.full = False
        assert (await request).status_code == 200


async def test_a_run_that_the_operator_cancelled_takes_no_more_submits(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        double = s.double
        await double.cancel()
        for _ in range(2):
            answer = await s.submit(IDS)
            assert answer.status_code == 409
            assert answer.json()["status"] == "cancelled"
            assert "cancelled" in answer.json()["error"]["message"]
            assert double.run_id not in answer.text
        assert s.pipeline.machine.spent
        assert (await s.info())["state"]["is_finalized"] is True


async def test_closing_finishes_the_submit_in_flight_first(tmp_path: Path) -> None:
    double = Double(opened())
    double.go.clear()
    async with served(tmp_path, double) as s:
        await s.submit(IDS, wait=False)
        closing = asyncio.create_task(s.close("wall_limit"))
        await asyncio.sleep(0.1)
        assert double.closed is None
        double.go.set()
        assert await closing
        assert double.closed is not None
        assert double.closed.reason == "wall_limit"
        assert (s.folder.feedback / "submit_000" / "summary.json").is_file()
    assert isinstance(double.asked[-1], CloseRun)


async def test_a_port_that_somebody_else_has_taken_is_reported(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(server, "_REBIND_TRIES", 2)
    monkeypatch.setattr(server, "_REBIND_PAUSE_S", 0.01)

    async with prepared(tmp_path) as (folder, double):
        async with gateway_on(folder, double) as s:
            port = urlsplit(s.urls.info).port
        with socket.socket() as thief:
            thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            thief.bind(("127.0.0.1", port))
            thief.listen()
            with pytest.raises(ConfigError, match=f"port {port}"):
                async with gateway_on(folder, double):
                    pass


def test_a_gateway_stopped_in_a_submit_shows_no_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def main() -> None:
        async with prepared(tmp_path) as (folder, double):
            double.go.clear()
            async with gateway_on(folder, double) as s:
                request = asyncio.create_task(s.submit(IDS, key="mine"))
                while not double.submits:
                    await asyncio.sleep(0.01)
                s.gateway.tell(None)
                answer = await request
                assert answer.status_code == 503
                assert answer.json()["status"] == "closed"
                assert "Idempotency-Key" in answer.json()["error"]["message"]
            double.go.set()
            async with gateway_on(folder, double) as s:
                assert (await s.submit(IDS, key="mine")).status_code == 200

    asyncio.run(main())
    assert [record.message for record in caplog.records if record.exc_info] == []


@pytest.mark.system
async def test_a_gateway_keeps_nothing_of_the_episodes_that_it_has_answered(tmp_path: Path) -> None:
    n, cases = 100, tuple(range(1001, 1201, 2))

    budget = 30 * n
    run = opened(n_env_instances=2000, episode_budget=budget, max_episodes_per_submit=n)
    async with served(tmp_path, Double(run)) as s:

        async def play(submits: int) -> int:
            """Bytes that the gateway's modules hold afterwards."""
            for _ in range(submits):
                assert (await s.submit(cases)).status_code == 200
            gc.collect()
            allocations = tracemalloc.take_snapshot().statistics("filename")
            return sum(each.size for each in allocations if "evopolicy_gateway" in each.traceback[0].filename)

        tracemalloc.start()
        try:
            before = await play(4)
            after = await play(12)
        finally:
            tracemalloc.stop()
        first = await s.http.get(f"{s.urls.submit}/submit_0000")
        assert len(first.json()["summary"]["returns"]) == n
    assert (after - before) / (12 * n) < 20.0, "bytes for each episode"
