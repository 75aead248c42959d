"""The gateway's answers in the published profile, field by field as `published/*.json` has them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from gateway_double import Double, Served, answering, gateway_on, opened, prepare, served

from evopolicy_common.messages.episode import PolicyFailure
from evopolicy_common.records.summary import decode_summary

GOLDEN = Path(__file__).parent / "published"
REQUESTS: dict[str, Any] = json.loads((GOLDEN / "published_requests.json").read_text())
FAILURES: dict[str, Any] = json.loads((GOLDEN / "published_failures.json").read_text())


def double() -> Double:
    return Double(opened(profile="published", policy_scope="submit", n_env_instances=1024))


async def n_submits(s: Served) -> int:
    return int((await s.http.get(s.urls.info)).json()["state"]["n_submits"])


async def check_row(s: Served, row: list[Any]) -> None:
    """Sends one row's body, and compares the answer, the count, and the folder."""
    body, code, status, counts, folder = row
    before = await n_submits(s)
    left = (await s.http.get(s.urls.info)).json()["state"]["remaining_budget"]
    answer = await s.http.post(s.urls.submit, content=body)
    document = answer.json()
    crashes = code is None
    assert (answer.status_code, document["status"]) == (
        (400, "bad_request") if crashes else (code, status)
    ), row
    assert await n_submits(s) == before + counts, row
    place = s.folder.feedback / f"submit_{before:03d}"
    assert place.exists() is folder, row
    if code == 200:
        assert document["submit_id"] == before
        assert document["summary"]["env_instances"] == expanded(json.loads(body)["env_instances"])
        return
    state = (await s.http.get(s.urls.info)).json()["state"]
    assert state["remaining_budget"] == left, row
    if not folder:
        assert sorted(document) == ["error", "status"], row
        assert list(document["error"]) == ["message"], row
        return
    rejected = REQUESTS["rejected"]
    assert sorted(document) == rejected["answer"], row
    assert document["submit_id"] == before
    assert sorted(path.name for path in place.rglob("*") if path.is_file()) == rejected["files"], row
    summary = json.loads((place / "summary.json").read_text())
    assert document["summary"] == summary
    assert {name: summary[name] for name in rejected["summary"]} == rejected["summary"], row
    assert summary["status"] == status
    assert summary["env_instances"] == expanded(json.loads(body)["env_instances"])
    (line,) = (place / "errors.txt").read_text().splitlines()
    assert (json.loads(line)["category"], json.loads(line)["traceback"]) == (status, None), row


def expanded(value: Any) -> list[Any]:
    """The ids of a text of ranges; a list as it is, `true` included."""
    if isinstance(value, list):
        return value
    parts = [part.strip().split("-") for part in value.split(",")]
    return [number for part in parts for number in range(int(part[0]), int(part[-1]) + 1)]


async def test_odd_requests_have_the_published_answers_counts_and_folders(tmp_path: Path) -> None:
    async with served(tmp_path, double()) as s:
        for row in REQUESTS["before"]:
            await check_row(s, row)
        assert (await s.http.get(s.urls.info)).json()["state"]["is_finalized"]
        for row in REQUESTS["after"]:
            await check_row(s, row)


async def test_a_body_that_is_not_utf8_is_a_clear_bad_request(tmp_path: Path) -> None:
    async with served(tmp_path, double()) as s:
        answer = await s.http.post(s.urls.submit, content=b'{"env_instances": "\xff"}')
        assert (answer.status_code, answer.json()["status"]) == (400, "bad_request")
        assert await n_submits(s) == 0


async def test_echoed_true_is_played_as_the_train_id_one(tmp_path: Path) -> None:
    async with served(tmp_path, double()) as s:
        document = (await s.http.post(s.urls.submit, json={"env_instances": [True]})).json()
        assert document["summary"]["env_instances"] == [True]
        assert document["summary"]["env_instances"][0] is True
        assert document["summary"]["returns"] == [-4.0]
        data = (s.folder.feedback / "submit_000/summary.json").read_bytes()
        assert decode_summary(data).env_instances == (True,)


@pytest.mark.parametrize("row", REQUESTS["urls"], ids=lambda row: f"{row[0]} {row[1]}")
async def test_odd_urls_and_methods_have_the_published_answers(tmp_path: Path, row: list[Any]) -> None:
    method, path, code, wanted = row

    async with served(tmp_path, double()) as s:
        answer = await s.http.request(method, s.urls.api + path)
        assert answer.status_code == code
        if isinstance(wanted, dict):
            document = answer.json()
            assert list(document) == ["status", "error"]
            assert {name: document[name] for name in wanted} == wanted
        else:
            assert answer.text.startswith(wanted or "")
            assert answer.headers["content-type"] == "text/html;charset=utf-8"
            assert bool(answer.content) is (wanted is not None)


async def test_a_failed_episode_has_the_published_summary(tmp_path: Path) -> None:
    failing = double()
    failing.failures[1] = PolicyFailure(category="act_error", step_index=2, message="no", traceback="T")

    async with served(tmp_path, failing) as s:
        answer = await s.http.post(s.urls.submit, json={"env_instances": [0, 1, 2]})
        document = answer.json()
        assert answer.status_code == 200
        assert {name: document[name] for name in FAILURES["answer"]} == FAILURES["answer"]
        summary = document["summary"]
        assert {name: summary[name] for name in FAILURES["summary"]} == FAILURES["summary"]
        assert all(summary[name] is not None for name in FAILURES["played"])
        assert summary["returns"] == [-3.0, -4.0, -5.0]
        (line,) = (s.folder.feedback / "submit_000/errors.txt").read_text().splitlines()
        wanted = FAILURES["errors_txt"]
        assert {name: json.loads(line)[name] for name in wanted} == wanted
        assert (await s.http.get(s.urls.info)).json()["state"]["remaining_budget"] == 9


POLICIES = {
    "": "missing_policy",
    "from other import Policy\n": "missing_policy",
    "Policy = type('Policy', (), {})\n": "missing_policy",
    "if True:\n    class Policy: pass\n": "missing_policy",
    "def Policy(*spaces): pass\n": "missing_policy",
    "class Policy: pass\nclass Policy(\n": "import_error",
    "class Policy: pass\n": "ok",
}


@pytest.mark.parametrize(("source", "status"), POLICIES.items())
async def test_a_policy_is_missing_without_a_class_statement(
    tmp_path: Path, source: str, status: str
) -> None:
    async with served(tmp_path, double()) as s:
        system = s.folder.system
        system.mkdir(exist_ok=True)
        (system / "policy.py").write_text(source)
        answer = await s.http.post(s.urls.submit, json={"env_instances": [0]})
        assert (answer.status_code, answer.json()["status"]) == (200, status)
        assert (await s.http.get(s.urls.info)).json()["state"]["remaining_budget"] == 11


async def test_a_syntax_error_in_any_file_is_an_import_error(tmp_path: Path) -> None:
    async with served(tmp_path, double()) as s:
        (s.folder.system / "unused.py").write_text("def (\n")
        answer = await s.http.post(s.urls.submit, json={"env_instances": [0]})
        assert answer.json()["status"] == "import_error"
        assert "system/unused.py" in (s.folder.feedback / "submit_000/errors.txt").read_text()


async def test_counted_requests_keep_their_indices_after_a_restart_of_the_gateway(tmp_path: Path) -> None:
    coordinator = double()
    async with answering(tmp_path, coordinator) as found:
        folder = prepare(tmp_path / "run", found, coordinator)
        async with gateway_on(folder, coordinator) as s:
            for body in ({"env_instances": "a"}, {"env_instances": [5000]}):
                assert (await s.http.post(s.urls.submit, json=body)).status_code == 400
        async with gateway_on(folder, coordinator) as s:
            assert await n_submits(s) == 2
            answer = await s.http.post(s.urls.submit, json={"env_instances": [0]})
            assert (answer.status_code, answer.json()["submit_id"]) == (200, 2)
