"""Every command of the staged AGENTS.md is executed as it stands."""

from __future__ import annotations

import asyncio
import json
import re
import sys
from pathlib import Path

from gateway_double import Served, opened, served
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_gateway.submits.submit_request import Bounds, parse
from evopolicy_gateway.workspace.agents_md import NO_URLS, agents_md

TIMEOUT_S = 30.0


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


async def output(program: list[str], cwd: Path) -> str:
    process = await asyncio.create_subprocess_exec(
        *program, cwd=cwd, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    async with asyncio.timeout(TIMEOUT_S):
        out, err = await process.communicate()
    assert process.returncode == 0, err.decode()
    return out.decode()


async def test_every_command_in_the_rules_runs_as_it_stands(tmp_path: Path) -> None:
    async def script(s: Served) -> None:
        workspace = s.folder.workspace
        text = (workspace / "AGENTS.md").read_text()
        shell = blocks(text, "bash")
        task, info, submit, read = [
            await output(["bash", "-euo", "pipefail", "-c", one], workspace) for one in shell
        ]
        assert task.startswith("# A line")
        assert json.loads(info)["state"]["remaining_budget"] == 12
        answer = json.loads(submit)
        assert answer["status"] == "ok"
        summary, _, rows = read.partition("\n}\n")
        assert json.loads(summary + "\n}") == answer["summary"]
        assert [json.loads(row)["t"] for row in rows.splitlines()] == [0, 1]
        program, interface = blocks(text, "python")
        assert (await output([sys.executable, "-c", program], workspace)).startswith(
            "feedback/submit_001 ok -3.5"
        )
        scope: dict[str, type] = {}
        exec(interface, scope)
        assert {"__init__", "reset", "act"} <= set(vars(scope["Policy"]))

    async with served(tmp_path) as service:
        await script(service)


async def test_every_path_in_the_rules_exists_after_a_submit(tmp_path: Path) -> None:
    async with served(tmp_path) as s:
        await s.http.post(s.urls.submit, json={"env_instances": [0]})
        text = (s.folder.workspace / "AGENTS.md").read_text()
        for path in ("system/", "feedback/", "AGENTS.md"):
            assert f"`{path}`" in text
            assert (s.folder.workspace / path).exists()


def test_rules_forbid_every_rollout_outside_a_submit_unless_the_run_allows_it() -> None:
    text = agents_md(opened(), NO_URLS)
    rule = text.partition("## The rule of the budget")[2].partition("\n## ")[0]
    forbidden, _, allowed = rule.partition("Allowed:")
    for word in ("Gymnasium", "MuJoCo", "dynamics", "reward", "simulator"):
        assert word in forbidden
    for word in ("Unit tests", "`feedback/`", "recorded observations"):
        assert word in allowed
    assert "as many experiments" not in text
    free = agents_md(opened(simulation="allowed"), NO_URLS)
    assert "rule of the budget" not in free
    assert "simulations of your own" in free


def test_rules_say_whether_the_whole_budget_must_be_spent() -> None:
    assert "the budget is spent or you stop" in agents_md(opened(), NO_URLS)
    rules = agents_md(opened(finish="budget"), NO_URLS)
    assert "Spend the whole budget" in rules
    assert "or you stop" not in rules


@given(data=st.data(), n_ids=st.integers(1, 70), budget=st.integers(1, 300))
def test_every_example_request_is_accepted_in_a_run_of_any_size(
    data: st.DataObject, n_ids: int, budget: int
) -> None:
    least = data.draw(st.integers(1, budget))
    most = data.draw(st.integers(least, 300))
    sizes = {"min_episodes_per_submit": least, "max_episodes_per_submit": most}
    text = agents_md(opened(n_env_instances=n_ids, episode_budget=budget, **sizes), NO_URLS)
    listed, ranges = re.findall(r"train ids from 0 to \d+, `(.*?)` or `(.*?)`", text)[0]
    (posted,) = re.findall(r"-d '(.*?)' 'SUBMIT_URL'", text)
    (submitted,) = re.findall(r"^answer = submit\((.*)\)$", text, re.MULTILINE)
    bounds = Bounds(
        n_env_instances=n_ids, min_episodes=least, max_episodes=min(most, budget), remaining_budget=budget
    )
    bodies = [posted, *(f'{{"env_instances": {ids}}}' for ids in (listed, ranges, submitted))]
    assert all(parse(body.encode(), bounds) for body in bodies)
