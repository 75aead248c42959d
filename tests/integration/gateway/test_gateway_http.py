"""The agent's HTTP service against a coordinator over real Zenoh: answers, refusals, feedback tree."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from gateway_double import Double, opened, served

from evopolicy_common.messages.episode import PolicyFailure
from evopolicy_common.messages.worker import BlobPut
from evopolicy_common.records.summary import decode_summary
from evopolicy_gateway.submits.submit_request import MAX_BODY_BYTES


def files_below(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


async def test_a_submit_leaves_its_feedback_and_answers_with_the_summary_files_bytes(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        answer = await s.submit([3, 0, 3])
        assert answer.status_code == 200
        document = answer.json()
        folder = s.folder.feedback / "submit_000"
        on_disk = (folder / "summary.json").read_bytes()
        assert on_disk in answer.content
        assert document["submit_id"] == 0
        assert document["status"] == "ok"
        assert document["summary"] == json.loads(on_disk)
        summary = decode_summary(on_disk)
        assert summary.env_instances == (3, 0, 3)
        assert summary.returns == (-6.0, -3.0, -6.0)
        assert summary.mean_return == -5.0
        assert summary.std_return == pytest.approx(2**0.5)
        assert summary.remaining_budget == 9
        assert summary.wall_time_seconds > 0.0
        names = ("stderr.txt", "stdout.txt", "trajectory.jsonl")
        episodes = [f"episodes/ep_00{i}/{name}" for i in range(3) for name in names]
        assert files_below(folder) == [*episodes, "summary.json"]
        rows = (folder / "episodes/ep_000/trajectory.jsonl").read_text().splitlines()
        assert json.loads(rows[0]) == {
            "t": 0,
            "obs": [3.1, 0.0, -0.5],
            "action": [0.25],
            "reward": -1.0,
            "terminated": False,
            "truncated": False,
            "info": {"reward_distance": -1.0},
        }
        assert list(s.folder.feedback.iterdir()) == [folder]


async def test_info_tells_the_run_and_the_submit_that_runs(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        before = await s.info()
        assert before["state"] == {"remaining_budget": 12, "n_submits": 0, "is_finalized": False}
        assert before["env_meta"]["n_env_instances"] == 8
        assert before["env_meta"]["obs_space"]["type"] == "Box"
        assert before["resource_limits"]["rollout_wall_s"] == 600.0
        assert before["submit_in_flight"] is None
        s.double.go.clear()
        assert (await s.submit([1, 2], wait=False)).status_code == 202
        during = await s.info()
        assert during["state"]["remaining_budget"] == 10
        assert during["submit_in_flight"] == {
            "submit_id": 0,
            "status": "running",
            "n_episodes": 2,
            "n_done": 0,
            "waits_for": "a free slot",
            "held_s": 0.0,
        }


async def test_an_unwaited_submit_is_asked_for_until_it_is_done(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        s.double.go.clear()
        first = await s.submit("0-2", wait=False)
        assert first.status_code == 202
        assert first.json()["status"] == "running"
        s.double.go.set()
        while (answer := await s.http.get(f"{s.urls.submit}/{first.json()['submit_id']}")).status_code == 202:
            await asyncio.sleep(0.02)
        assert answer.json()["summary"]["env_instances"] == [0, 1, 2]
        assert (await s.http.get(f"{s.urls.submit}/submit_001")).status_code == 404
        assert (await s.http.get(f"{s.urls.submit}/../info")).status_code in (200, 404)


async def test_a_second_submit_is_a_conflict_that_names_the_first(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        s.double.go.clear()
        await s.submit([0], wait=False)
        second = await s.submit([1])
        assert second.status_code == 409
        assert second.json()["submit_id"] == 0
        assert "submit_000" in second.json()["error"]["message"]
        s.double.go.set()
        await s.pipeline.idle()
        assert (await s.submit([1])).json()["submit_id"] == 1
    assert len(s.double.submits) == 2


async def test_the_same_key_with_another_body_is_a_conflict(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        s.double.go.clear()
        both = [asyncio.create_task(s.submit([2], key="k-1")) for _ in "ab"]
        await asyncio.sleep(0.1)
        s.double.go.set()
        first, again = [await one for one in both]
        assert first.status_code == again.status_code == 200
        assert first.content == again.content
        assert (await s.submit([2], key="k-1")).content == first.content
        other = await s.submit([3], key="k-1")
        assert other.status_code == 409
        assert "another body" in other.json()["error"]["message"]
    assert len(s.double.submits) == 1


async def test_a_client_that_hangs_up_loses_nothing(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        s.double.go.clear()
        request = asyncio.create_task(s.submit([0, 1]))
        while s.pipeline.machine.in_flight is None:
            await asyncio.sleep(0.01)
        request.cancel()
        await asyncio.gather(request, return_exceptions=True)
        s.double.go.set()
        await s.pipeline.idle()
        assert (s.folder.feedback / "submit_000" / "summary.json").is_file()
        assert (await s.http.get(f"{s.urls.submit}/submit_000")).json()["status"] == "ok"


REJECTED = [
    (b"{", "budget_invalid"),
    (b'{"env_instances": []}', "budget_invalid"),
    (b'{"env_instances": {"a": 1}}', "budget_invalid"),
    (b'{"env_instances": "0-6"}', "budget_invalid"),
    (b'{"env_instances": [8]}', "invalid_env_instance"),
    (b'{"env_instances": "5-2"}', "invalid_env_instance"),
    (b'{"env_instances": [0.5]}', "invalid_env_instance"),
    (b'{"env_instances": "0-999999999999"}', "invalid_env_instance"),
]


async def test_a_rejected_request_costs_no_budget_and_changes_nothing(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        for number, (body, status) in enumerate(REJECTED, start=1):
            answer = await s.http.post(s.urls.submit, content=body)
            assert answer.status_code == 400
            assert answer.json()["status"] == status
            assert answer.json()["error"]["message"]
            state = (await s.info())["state"]
            assert state == {"remaining_budget": 12, "n_submits": 0, "is_finalized": False}
            assert files_below(s.folder.feedback) == []
            assert s.pipeline.machine.n_rejected == number
    assert s.double.submits == []
    assert not any(isinstance(message, BlobPut) for message in s.double.asked)


async def test_a_body_of_100_megabytes_is_refused_and_the_refusal_is_heard(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        huge = b'{"env_instances": "' + b"0," * 50_000_000 + b'0"}'
        answer = await s.http.post(s.urls.submit, content=huge)
        assert answer.status_code == 400
        assert answer.json()["status"] == "budget_invalid"
        assert "100,000,0" in answer.json()["error"]["message"]

        async def unannounced() -> object:
            for _ in range(3 * MAX_BODY_BYTES // 65536):
                yield b" " * 65536

        chunked = await s.http.post(s.urls.submit, content=unannounced())
        assert chunked.status_code == 400
        assert chunked.json()["status"] == "budget_invalid"
        assert (await s.submit([0])).status_code == 200


async def test_headers_without_end_are_cut_off(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        address = urlsplit(s.urls.info)
        reader, writer = await asyncio.open_connection(address.hostname, address.port)
        writer.write(f"GET {address.path} HTTP/1.1\r\nHost: x\r\n".encode() + b"X-A: " + b"a" * (1 << 20))
        # Closed with what it sent unread, a client may see the refusal or only the reset.
        with contextlib.suppress(ConnectionResetError):
            answer = await asyncio.wait_for(reader.read(), 20)
            assert answer == b"" or answer.startswith(b"HTTP/1.1 400")
        assert (await s.http.get(s.urls.info)).status_code == 200
        writer.close()


async def test_a_verdict_without_a_policy_is_charged_and_told(tmp_path: Path) -> None:
    cause = PolicyFailure(
        category="import_error", step_index=None, message="No module named 'torch'", traceback="Traceback …\n"
    )
    double = Double(opened())
    double.failures = {0: cause, 1: cause}
    async with served(tmp_path, double) as s:
        answer = (await s.submit([0, 1])).json()
        assert answer["status"] == "import_error"
        summary = answer["summary"]
        assert summary["n_episodes"] == 2
        assert summary["remaining_budget"] == 10
        arrays = ["returns", "mean_return", "episode_lengths", "errors", "timeouts", "max_return"]
        assert all(summary[name] is None for name in arrays)
        assert summary["env_instances"] == [0, 1]
        folder = s.folder.feedback / "submit_000"
        assert files_below(folder) == ["errors.txt", "summary.json"]
        line = json.loads((folder / "errors.txt").read_text())
        assert line["category"] == "import_error"
        assert "torch" in line["message"]
        assert set(line) == {"schema_version", "timestamp", "category", "message", "traceback"}


async def test_an_episode_that_failed_has_its_error_file_and_is_listed(tmp_path: Path) -> None:
    double = Double(opened())
    double.failures = {
        1: PolicyFailure(category="act_error", step_index=2, message="boom", traceback="tb"),
        2: PolicyFailure(category="act_timeout", step_index=0, message="slow", limit=20.0, used=20.1),
    }
    async with served(tmp_path, double) as s:
        summary = (await s.submit([4, 4, 5])).json()["summary"]
        assert summary["errors"] == [1, 2]
        assert summary["timeouts"] == [2]
        episodes = s.folder.feedback / "submit_000" / "episodes"
        assert not (episodes / "ep_000" / "error.txt").exists()
        line = json.loads((episodes / "ep_001" / "error.txt").read_text())
        assert (line["category"], line["step_index"]) == ("act_error", 2)
        assert json.loads((episodes / "ep_002" / "error.txt").read_text())["limit"] == 20.0


async def test_a_submit_timeout_keeps_the_episodes_before_the_first_unfinished(tmp_path: Path) -> None:
    double = Double(opened())
    double.order = lambda n: [0, 3, 1]
    async with served(tmp_path, double) as s:
        answer = (await s.submit([0, 1, 2, 3])).json()
        assert answer["status"] == "rollout_timeout"
        episodes = s.folder.feedback / "submit_000" / "episodes"
        assert sorted(path.name for path in episodes.iterdir()) == ["ep_000", "ep_001"]


async def test_the_budget_is_spent_to_the_last_episode_and_then_refused(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        for _ in range(2):
            assert (await s.submit("0-5")).status_code == 200
        assert s.pipeline.machine.spent
        answer = await s.submit([0])
        assert answer.status_code == 409
        assert answer.json()["status"] == "run_closed"
        assert "spent" in answer.json()["error"]["message"]
        assert sorted(path.name for path in s.folder.feedback.iterdir()) == ["submit_000", "submit_001"]
        names = sorted(path.name for path in (s.folder.feedback / "submit_001/episodes").iterdir())
        assert names == [f"ep_{i:03d}" for i in range(6, 12)]


async def test_the_service_listens_on_loopback_only(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        port = urlsplit(s.urls.info).port
        assert urlsplit(s.urls.info).hostname == "127.0.0.1"
        with socket.socket() as probe:
            probe.settimeout(2)
            assert probe.connect_ex(("127.0.0.2", port)) != 0


async def test_each_of_quick_submits_is_reported_with_its_budget(tmp_path: Path) -> None:
    async with served(tmp_path) as service:
        for case in range(4):
            await service.submit([case])
    first: dict[str | None, int] = {}
    for progress in service.progress:
        first.setdefault(progress.last_submit_id, progress.remaining_budget)
    assert [*first.values()] == [12, 11, 10, 9, 8]
