"""A client and a checker written from the published protocol alone: plain blocking HTTP, files read by their names."""

from __future__ import annotations

import asyncio
import json
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

from gateway_double import Double, opened, served

from evopolicy_common.messages.episode import PolicyFailure

SUMMARY_FIELDS = [
    *("schema_version", "submit_index", "env", "status", "n_episodes", "first_global_episode"),
    "env_instances",
    *("remaining_budget", "submit_started_at", "submit_completed_at", "wall_time_seconds", "returns"),
    *("mean_return", "std_return", "min_return", "max_return", "episode_lengths", "mean_episode_length"),
    *("timeouts", "errors"),
]
ROW_FIELDS = ["t", "obs", "action", "reward", "terminated", "truncated", "info"]
ERROR_FIELDS = {"schema_version", "timestamp", "category", "message", "traceback"}


def post(url: str, body: Any) -> tuple[int, dict[str, Any]]:
    request = urllib.request.Request(url, data=json.dumps(body).encode(), method="POST")
    request.add_header("Content-Type", "application/json")
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, json.load(error)


def check_submit(folder: Path, answer: dict[str, Any]) -> None:
    """What an artifact checker asks of one submit's folder."""
    summary = json.loads((folder / "summary.json").read_bytes())
    assert summary == answer["summary"]
    assert answer["submit_id"] == summary["submit_index"]
    assert folder.name == f"submit_{answer['submit_id']:03d}"
    assert answer["feedback"] == f"feedback/{folder.name}"
    assert list(summary)[: len(SUMMARY_FIELDS)] == SUMMARY_FIELDS
    assert (folder / "errors.txt").exists() == (summary["status"] != "ok")
    if summary["status"] != "ok":
        for line in (folder / "errors.txt").read_text().splitlines():
            assert set(json.loads(line)) >= ERROR_FIELDS
        return
    n = summary["n_episodes"]
    assert len(summary["returns"]) == len(summary["episode_lengths"]) == len(summary["env_instances"]) == n
    names = [f"ep_{summary['first_global_episode'] + i:03d}" for i in range(n)]
    assert sorted(path.name for path in (folder / "episodes").iterdir()) == names
    for index, name in enumerate(names):
        episode = folder / "episodes" / name
        rows = [json.loads(line) for line in (episode / "trajectory.jsonl").read_text().splitlines()]
        assert len(rows) == summary["episode_lengths"][index]
        assert [row["t"] for row in rows] == list(range(len(rows)))
        assert all(list(row) == ROW_FIELDS for row in rows)
        assert {"stdout.txt", "stderr.txt"} <= {path.name for path in episode.iterdir()}
        assert (episode / "error.txt").exists() == (index in summary["errors"])
        if index in summary["errors"]:
            assert set(json.loads((episode / "error.txt").read_text())) >= ERROR_FIELDS | {"step_index"}


async def test_a_client_of_the_published_protocol_works_unchanged(tmp_path: Path) -> None:
    double = Double(opened())
    double.failures = {1: PolicyFailure(category="act_error", step_index=1, message="m", traceback="t")}

    def client(environment: dict[str, str], workspace: Path) -> None:
        with urllib.request.urlopen(environment["EVOPOLICYGYM_API"] + "/info") as answer:
            info = json.load(answer)
        assert info["protocol_version"] == "protocol/v2.0-draft"
        assert info["state"]["remaining_budget"] == info["episode_budget"] == 12
        with urllib.request.urlopen(environment["EVOPOLICYGYM_TASK_URL"]) as answer:
            assert answer.read().decode().startswith("#")
        submit = environment["EVOPOLICYGYM_SUBMIT_URL"]
        for body in ({"env_instances": [5, 1, 1]}, {"env_instances": "0-1,7"}):
            status, document = post(submit, body)
            assert status == 200
            assert {"submit_id", "status", "summary"} <= set(document)
            assert document["is_finalized"] is False
            check_submit(workspace / document["feedback"], document)
            assert document["policy_failures"] == len(document["summary"]["errors"]) == 1
            assert "1 of 3 episodes" in document["warning"]
            with urllib.request.urlopen(environment["EVOPOLICYGYM_INFO_URL"]) as answer:
                assert json.load(answer)["last_warning"] == document["warning"]
        for body, wanted in (
            ({"env_instances": []}, "budget_invalid"),
            ({"env_instances": [99]}, "invalid_env_instance"),
        ):
            status, document = post(submit, body)
            assert (status, document["status"]) == (400, wanted)
            assert document["error"]["message"]
        double.failures = {
            0: PolicyFailure(category="init_error", step_index=None, message="no", traceback="tb")
        }
        status, document = post(submit, {"env_instances": [0]})
        assert (status, document["status"]) == (200, "init_error")
        check_submit(workspace / document["feedback"], document)
        left = document["summary"]["remaining_budget"]
        status, document = post(
            submit, {"env_instances": [0] * left, "comment": "an unknown field is ignored"}
        )
        assert (status, document["is_finalized"]) == (200, True)
        with urllib.request.urlopen(environment["EVOPOLICYGYM_INFO_URL"]) as answer:
            assert json.load(answer)["state"]["is_finalized"] is True
        status, document = post(submit, {"env_instances": [0]})
        assert (status, document["status"]) == (409, "run_closed")
        assert post(submit.removesuffix("submit") + "finalize", {})[0] == 405

    async with served(tmp_path, double) as s:
        await asyncio.to_thread(client, s.urls.environment(), s.folder.workspace)
