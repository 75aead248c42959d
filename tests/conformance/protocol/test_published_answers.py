"""The gateway's answers in the published profile, field by field as `published/*.json` has them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from gateway_double import Double, opened, served

from evopolicy_common.messages.episode import PolicyFailure

GOLDEN = Path(__file__).parent / "published"
FAILURES: dict[str, Any] = json.loads((GOLDEN / "published_failures.json").read_text())


def double() -> Double:
    return Double(opened(profile="published", policy_scope="submit", n_env_instances=1024))


NOT_PLAYED = (
    ("POST", "/submit", b"", 400, "budget_invalid"),
    ("POST", "/submit", b'{"env_instances": [5000]}', 400, "invalid_env_instance"),
    ("POST", "/submit", b'{"env_instances": "3-0"}', 400, "invalid_env_instance"),
    ("POST", "/submit", b'{"env_instances": []}', 400, "budget_invalid"),
    ("POST", "/finalize", b"", 405, "method_not_allowed"),
    ("GET", "/elsewhere", b"", 404, "not_found"),
)
"""Method, path, body, and the answer's code and status."""


async def test_what_is_not_played_has_a_status_and_changes_nothing(tmp_path: Path) -> None:
    async with served(tmp_path, double()) as s:
        before = (await s.http.get(s.urls.info)).json()["state"]
        for method, path, body, code, status in NOT_PLAYED:
            answer = await s.http.request(method, s.urls.api + path, content=body)
            document = answer.json()
            assert (answer.status_code, document["status"]) == (code, status), path
            assert list(document["error"]) == ["message"]
        assert (await s.http.get(s.urls.info)).json()["state"] == before
        assert not [*s.folder.feedback.glob("submit_*")]


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
