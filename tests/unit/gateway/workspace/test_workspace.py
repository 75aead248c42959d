"""The staged workspace: rules, the first policy, and the task's text."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from gateway_double import LINE, opened

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import ResourceLimits
from evopolicy_common.records.blobs import digest_of
from evopolicy_gateway.http.service import info_document
from evopolicy_gateway.http.task import task_markdown
from evopolicy_gateway.run_folder.layout import RunFolder, run_folder
from evopolicy_gateway.submits.tickets import TicketMachine
from evopolicy_gateway.workspace.agents_md import NO_URLS, PLACEHOLDERS, agents_md, urls_below
from evopolicy_gateway.workspace.prompts import check_text
from evopolicy_gateway.workspace.staging import constant_action, initial_policy, stage

URLS = urls_below("http://127.0.0.1:4711", "ab" * 16)


def folder_at(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "run")
    folder.state.mkdir(parents=True)
    return folder


def test_a_workspace_is_staged_once(tmp_path: Path) -> None:
    folder = folder_at(tmp_path)
    staged = stage(folder, opened(), URLS)
    rules = folder.workspace / "AGENTS.md"
    assert URLS.submit in rules.read_text()
    assert rules.stat().st_mode & 0o777 == 0o444
    assert digest_of((folder.system / "policy.py").read_bytes()) == staged.initial_policy_hash
    assert list(folder.feedback.iterdir()) == []
    (folder.system / "policy.py").write_text("mine")
    assert stage(folder, opened(), URLS) == staged
    assert (folder.system / "policy.py").read_text() == "mine"


def test_equal_rules_have_equal_hashes_whatever_the_urls(tmp_path: Path) -> None:
    one = stage(folder_at(tmp_path / "a"), opened(), URLS)
    two = stage(folder_at(tmp_path / "b"), opened(), urls_below("http://127.0.0.1:1", "cd" * 16))
    other = stage(folder_at(tmp_path / "c"), opened(episode_budget=99), URLS)
    assert one.rules_hash == two.rules_hash == digest_of(agents_md(opened(), NO_URLS).encode())
    assert other.rules_hash != one.rules_hash


SPACES: list[tuple[dict[str, Any], Any]] = [
    ({"type": "Discrete", "n": 3}, 0),
    ({"type": "Discrete", "n": 3, "start": -1}, -1),
    ({"type": "Box", "shape": [2], "dtype": "float32", "low": [-1.0, 0.5], "high": [1.0, 2.0]}, [0.0, 0.5]),
    ({"type": "Box", "shape": [1], "dtype": "float64", "low": ["-inf"], "high": [-3.0]}, [-3.0]),
    ({"type": "Box", "shape": [], "dtype": "float32", "low": 1.0, "high": "inf"}, 1.0),
    ({"type": "Box", "shape": [2, 20], "dtype": "int64", "min": 1, "max": 9}, [[1] * 20] * 2),
    ({"type": "Image", "shape": [1, 1, 3], "dtype": "uint8", "value_range": [0, 255]}, [[[0, 0, 0]]]),
    ({"type": "MultiDiscrete", "nvec": [2, 3]}, [0, 0]),
    ({"type": "MultiDiscrete", "nvec": [[2], [3]], "start": [[1], [2]]}, [[1], [2]]),
    ({"type": "MultiBinary", "n": 3}, [0, 0, 0]),
    ({"type": "MultiBinary", "n": [1, 2]}, [[0, 0]]),
    ({"type": "Text", "min_length": 2, "max_length": 5}, "aa"),
    ({"type": "Tuple", "spaces": [{"type": "Discrete", "n": 2}]}, (0,)),
    ({"type": "Dict", "spaces": {"a": {"type": "MultiBinary", "n": 1}}}, {"a": [0]}),
]


@pytest.mark.parametrize(("space", "action"), SPACES)
def test_the_first_policy_runs_and_returns_a_valid_action(space: dict[str, Any], action: Any) -> None:
    assert constant_action(space) == action
    scope: dict[str, Any] = {}
    exec(initial_policy(space), scope)
    policy = scope["Policy"]({}, space, {})
    assert policy.reset(0) is None
    assert policy.act(np.zeros(3)) == action


def test_the_rules_name_every_file_verdict_and_bound() -> None:
    text = agents_md(opened(episode_budget=128, max_episodes_per_submit=500, min_episodes_per_submit=4), URLS)
    for needed in (
        *("trajectory.jsonl", "observations.npz", "error.txt", "errors.txt", "summary.json", "video.mp4"),
        *("missing_policy", "denied_import", "import_error", "init_error", "rollout_timeout"),
        *(
            "budget_invalid",
            "invalid_env_instance",
            "128 episodes",
            "Idempotency-Key",
            "submit_000",
            "ep_000",
        ),
        "has 4\nto 128 episodes",
    ):
        assert needed in text
    assert not re.search(r"\$[a-z_]+", text)


def test_an_operators_text_replaces_or_extends_the_rules(tmp_path: Path) -> None:
    text = "Budget $budget, $$5.\n\n$standard\nSubmit to $submit_url."
    staged = stage(folder_at(tmp_path), opened(), URLS, text)
    written = (tmp_path / "run/workspace/AGENTS.md").read_text()
    assert written == f"Budget 12, $5.\n\n{agents_md(opened(), URLS)}\nSubmit to {URLS.submit}."
    assert staged.rules_hash != stage(folder_at(tmp_path / "b"), opened(), URLS).rules_hash


@pytest.mark.parametrize(
    ("text", "fault"),
    [("", "is empty"), ("costs 5$", "write \\$\\$"), ("$seed", "unknown placeholder \\$seed")],
)
def test_a_text_that_cannot_be_filled_in_is_refused(text: str, fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        check_text("rules.md", text, PLACEHOLDERS)


def test_the_task_says_what_differs_between_runs() -> None:
    run = opened(
        policy_scope="submit",
        observations="lists",
        limits=ResourceLimits(act_wall_s=3.0, submit_wall_s=60.0),
        env=msgspec.structs.replace(LINE, deterministic=False, obs_storage="npz"),
        denied_imports=("socket",),
    )
    text = task_markdown(run)
    for needed in (
        "scope `submit`",
        "nested lists",
        "| 3 s |",
        "whole submit | 60 s",
        "**not** deterministic",
    ):
        assert needed in text
    assert "observations.npz" in text
    assert "`denied_import`: `socket`" in text
    assert "scope `episode`" in task_markdown(opened())


def test_the_tasks_schemas_are_json() -> None:
    space = {
        "type": "Dict",
        "spaces": {
            "a": {"type": "Box", "shape": [40], "dtype": "float32", "min": "-inf", "max": "inf"},
            "b": {"type": "Discrete", "n": 4},
        },
    }
    text = task_markdown(opened(env=msgspec.structs.replace(LINE, obs_space=space)))
    blocks = [json.loads(block) for block in re.findall(r"```json\n(.*?)```", text, re.DOTALL)]
    assert blocks == [space, LINE.action_space]


def test_info_has_the_protocols_fields_and_no_more_of_the_cluster() -> None:
    machine = TicketMachine(opened())
    document = info_document(machine)
    assert {
        *("protocol_version", "state", "env_meta", "episode_budget", "min_episodes_per_submit"),
        *("max_episodes_per_submit", "resource_limits", "allowed_imports", "denied_imports"),
    } <= set(document)
    assert set(document["state"]) == {"remaining_budget", "n_submits", "is_finalized"}
    assert {"rollout_wall_s", "memory_bytes"} <= set(document["resource_limits"])
    assert json.loads(json.dumps(document)) == document
    machine.close()
    assert info_document(machine)["state"]["is_finalized"] is True


def test_a_runs_folder_has_no_surprises_in_its_name(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "GPT-5.5 (Codex)/../x", "gym/acrobot", "first")
    assert folder.root == tmp_path / "GPT-5.5 (Codex)_.._x-e5823f47" / "gym_acrobot" / "first"
    assert (
        run_folder(tmp_path, "e", "my_env:Glider-v0", "a").root == tmp_path / "e" / "my_env_Glider-v0" / "a"
    )
    for entry, exp_id in (("..", "a"), ("", "a"), ("a", "../b"), ("a", ""), ("a", ".hidden")):
        with pytest.raises(ConfigError):
            run_folder(tmp_path, entry, "e", exp_id)
    assert os.fspath(run_folder(Path("runs"), "e", "a/b", "c").root).startswith("/")
