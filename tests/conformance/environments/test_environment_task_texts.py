"""The task text of every environment explains all of its observation and its actions, its reward, start and end."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.resources import files

import pytest
from environment_checks import components, selected, table

from evopolicy_common.catalogue import entries
from evopolicy_worker.environments import Environment, offered
from evopolicy_worker.environments.tasks import task_text

IDS = offered()
Warm = Callable[[str], Environment]


@pytest.mark.parametrize("env_id", IDS)
def test_every_observation_component_has_exactly_one_row(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    rows = table(description.task_text, "Observation")
    named = [component for row in rows for component in selected(row[0])]
    assert len(named) == len(set(named)), "a component has two rows"
    assert set(named) == components(description.obs_space)
    assert all(len(row) == 4 and all(row) for row in rows), "a row lacks meaning, unit or range"


@pytest.mark.parametrize("env_id", IDS)
def test_every_action_has_exactly_one_row(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    rows = table(description.task_text, "Action")
    named = [component for row in rows for component in selected(row[0])]
    space = description.action_space
    if space["type"] == "Discrete":
        start = space.get("start", 0)
        assert named == [("", (choice,)) for choice in range(start, start + space["n"])]
        assert all(len(row) == 2 and all(row) for row in rows)
    else:
        assert len(named) == len(set(named))
        assert set(named) == components(space)
        assert all(len(row) == 4 and all(row) for row in rows)


@pytest.mark.parametrize("env_id", IDS)
def test_a_text_has_an_objective_and_all_sections_and_names_the_step_limit(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    text = description.task_text
    assert re.match(r"# .+\n\n[A-Z].{30,}", text), "no title with an objective below it"
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == ["Observation", "Action", "Reward", "Start", "End"]
    assert re.search(rf"runcated after\s+{description.max_episode_steps} steps", text)
    for name in description.reward_components:
        assert f"`{name}`" in text
    assert "include:" not in text


def test_no_text_is_left_without_an_environment() -> None:
    known = {env_id.replace("/", "_") + ".md" for env_id in entries()}
    folder = files("evopolicy_worker.environments.tasks")
    there = {item.name for item in folder.iterdir() if item.name.endswith(".md")}
    included = {name for env_id in IDS for name in _includes(env_id)}
    assert there == known | included


def _includes(env_id: str) -> list[str]:
    raw = (
        files("evopolicy_worker.environments.tasks")
        .joinpath(env_id.replace("/", "_") + ".md")
        .read_text("utf-8")
    )
    return re.findall(r"<!-- include: (\S+) -->", raw)


def test_an_environment_without_a_text_is_an_error() -> None:
    with pytest.raises(FileNotFoundError):
        task_text("gym/no-such")
