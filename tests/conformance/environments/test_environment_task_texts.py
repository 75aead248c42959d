"""The task text of every environment explains all of its observation and its actions, its reward, start and end."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.resources import files

import pytest
from environment_checks import IDS, components, selected, table

from evopolicy_common.catalogue import families, suites
from evopolicy_worker.environments import Environment
from evopolicy_worker.environments.tasks import written

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
def test_a_text_has_objective_sections_and_step_limit(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    text = description.task_text
    assert re.match(r"# .+\n\n[A-Z].{30,}", text), "no title with an objective below it"
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == ["Observation", "Action", "Reward", "Start", "End"]
    assert re.search(rf"runcated after\s+{description.max_episode_steps} steps", text)
    for name in description.reward_components:
        assert f"`{name}`" in text
    assert "include:" not in text


EQUATIONS = {
    "an assignment": r"←|:=",
    "a difference, sum or root": r"[ΔΣ√∫]|\w′|\w''",
    "a power": r"[\w)]\s?(²|³|\^)",
    "a function of a variable": r"\b(cos|sin|tan|atan|exp|sqrt)\b ?[(\w]",
    "a weight before a variable": r"\d\.\d+ ?[·*×]|\d\.\d+ (?![msN]\b)[a-zA-Zθωφ][ᵢⱼ\d]?\b",
}
"""Signs that a text gives equations of motion or a reward's formula."""
IN_CODE = {"arithmetic": r"[\w)\]] [+*/×÷−<>] [\w(]|\w[*/+]\w", "a norm": r"\|.+ − .+\|"}
"""The same within backticks."""
CONSTANTS = {
    "mass, inertia, damping or gravity": r"\bkg\b|N m s|\bg = |inertia \d|damping \d|gravity \d|m/s²",
    "an integrator or its time step": r"Runge|Euler(?! angles)|\d\.\d+ s\)|\d+ × \d\.\d+ s|\d/\d+ s",
    "a distribution of the start": r"standard deviation|[Nn]ormal(ly)? with|uniform (in|over)",
}


def flags(text: str) -> list[str]:
    """Which signs of equations and constants stand in a text, tables of observations aside: they give units and scales."""
    head, _, rest = text.partition("## Observation")
    observation, _, rest = rest.partition("## Action")
    prose = "\n".join(line for line in observation.splitlines() if not line.startswith("|"))
    parts = (head, prose, rest)
    code = [span for part in parts for span in re.findall(r"`([^`\n]+)`", part)]
    searches = [(EQUATIONS | CONSTANTS, parts), (IN_CODE, code)]
    return [
        f"{kind}: {found[0]!r}"
        for signs, texts in searches
        for kind, sign in signs.items()
        for text in texts
        if (found := re.search(sign, text))
    ]


@pytest.mark.parametrize("env_id", IDS)
def test_text_describes_dynamics_and_reward_in_words(env_id: str, warm: Warm) -> None:
    # The rule of the budget: nobody can simulate the environment from its text.
    assert flags(warm(env_id).description.task_text) == []


@pytest.mark.parametrize(
    "text",
    [
        "One step: `v ← v + 0.0015 a − 0.0025 cos(3x)`, held within ±0.07.",
        "Each step `Δx / 0.05 − 0.1 Σ aᵢ²`, Δx being the way forward.",
        "Each step `−|cylinder − goal| − 0.5 |cylinder − wrist|`.",
        "`1 − 0.9 t / 2560` on the step t that steps on the goal.",
        "θ2'' = (a + d2/d1 φ1 − 0.5 ω1² sin θ2 − φ2) / (1.25 − d2²/d1)",
        "Both links: length 1 m, mass 1 kg; g = 9.8 m/s²; no friction.",
        "One step is 0.2 s, one fourth-order Runge–Kutta step.",
        "three times 1/15 s of `β = atan(tan(δ)/2)`",
        "Terminates when `−cos θ1 − cos(θ1 + θ2) > 1`.",
        "All positions are uniform in ±0.1, all velocities normal with standard deviation 0.1.",
        "fingertip = (0.1 cos θ1 + 0.11 cos(θ1 + θ2), 0.1 sin θ1 + 0.11 sin(θ1 + θ2)).",
        "Each joint has damping 1 N m s/rad and armature inertia 1 kg m².",
    ],
)
def test_equation_or_constant_in_a_text_is_found(text: str) -> None:
    assert flags(f"# Title\n\n## Observation\n\n{text}\n\n## Action\n")
    assert flags(f"# Title\n\n## Observation\n\n## Action\n\n## Reward\n\n{text}\n")


def test_no_text_is_left_without_an_environment() -> None:
    known = {env_id.replace("/", "_") + ".md" for env_id in IDS} | {
        f"family_{name}.md" for name in families()
    }
    folder = files("evopolicy_worker.environments.tasks")
    there = {item.name for item in folder.iterdir() if item.name.endswith(".md")}
    included = {name for env_id in IDS for name in _includes(env_id)}
    assert there <= known | included


def _includes(env_id: str) -> list[str]:
    raw = (
        files("evopolicy_worker.environments.tasks")
        .joinpath(env_id.replace("/", "_") + ".md")
        .read_text("utf-8")
    )
    return re.findall(r"<!-- include: (\S+) -->", raw)


def test_core16_and_the_toys_have_texts_that_are_written_for_them() -> None:
    for env_id in (*suites()["core16"].environments, *suites()["toy"].environments):
        assert written(env_id), env_id
    assert written("gym/no-such") is None
