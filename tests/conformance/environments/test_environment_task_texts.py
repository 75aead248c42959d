"""The task text of every environment explains all of its observation and its actions, its reward, start and end."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Callable
from importlib.resources import files

import pytest
from environment_checks import IDS
from text_checks import borrowed, flags, marks, uncovered

from evopolicy_common.catalogue import entries, families, suites
from evopolicy_worker.environments import Environment
from evopolicy_worker.environments.tasks import template, written

Warm = Callable[[str], Environment]


@pytest.mark.parametrize("env_id", IDS)
def test_every_component_of_core16_has_exactly_one_row(env_id: str, warm: Warm) -> None:
    description = warm(env_id).description
    assert uncovered(description.task_text, "Observation", description.obs_space) == []
    assert uncovered(description.task_text, "Action", description.action_space) == []


TEXT = """# A\n\n## Observation\n\n| Component | Meaning | Unit | Range |\n|---|---|---|---|\n| 0 | x | m | 0 to 1 |\n| 1–2 | speeds | m/s | about ±1 |
\n## Action\n\n| Choice | Meaning |\n|---|---|\n| 0 | left |\n| 1 | right |\n\n## Reward\n"""  # noqa: E501


@pytest.mark.parametrize(
    ("shape", "n", "text", "fault"),
    [
        (3, 2, TEXT, ""),
        (4, 2, TEXT, "Observation without"),
        (2, 2, TEXT, "Observation beyond"),
        (3, 3, TEXT, "Action without"),
        (3, 1, TEXT, "Action beyond"),
        (3, 2, TEXT.replace("1–2", "0–2"), "several rows"),
        (3, 2, TEXT.replace("| m |", "| |"), "empty cell"),
        (3, 2, "# A\n\n## Observation\n\nA state.\n\n## Action\n\n| 0 | left |\n", "widths under"),
    ],
)
def test_a_table_that_lacks_a_component_is_found(shape: int, n: int, text: str, fault: str) -> None:
    found = uncovered(text, "Observation", {"type": "Box", "shape": [shape]})
    found += uncovered(text, "Action", {"type": "Discrete", "n": n})
    assert any(fault in each for each in found) if fault else found == []


class _Base:
    """Superclass for all robots of this world."""

    def __init__(self, reset_noise_scale: float = 0.1) -> None: ...


@pytest.mark.parametrize(
    "text",
    [
        "Superclass for all robots of this world.",
        "It may be moved by `reset_noise_scale`.",
        "The goal is :attr:`goal`, of ``GoalEnv``.",
        "See Gymnasium's env for more information.",
        "From [a paper](https://example.org).",
    ],
)
def test_words_of_a_library_in_a_text_are_found(text: str) -> None:
    assert marks(text) + borrowed(text, _Base())
    assert not marks("See-saws move.") + borrowed("A robot walks.", _Base())


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
        f"family_{name}.{kind}" for name in families() for kind in ("md", "toml")
    }
    there = {
        item.name: item.read_text("utf-8")
        for item in files("evopolicy_worker.environments.tasks").iterdir()
        if item.name.endswith((".md", ".toml"))
    }
    taken = set(re.findall(r"<!-- include: (\S+) -->", "".join(there.values())))
    read_by_families = {
        name for name in there if re.fullmatch(r"[a-z_]+_(games|tasks|words|rooms|scenarios)\.toml", name)
    }
    assert there.keys() <= known | taken | read_by_families


def test_every_pattern_of_a_family_matches_an_id() -> None:
    ids = {str(each.gymnasium_id) for each in entries().values()}
    patterns = {pattern for name in families() for group in template.groups(name) for pattern in group["ids"]}
    assert [each for each in sorted(patterns) if not fnmatch.filter(ids, each)] == []


def test_core16_and_the_toys_have_texts_that_are_written_for_them() -> None:
    for env_id in (*suites()["core16"].environments, *suites()["toy"].environments):
        assert written(env_id), env_id
    assert written("gym/no-such") is None
