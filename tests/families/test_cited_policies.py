"""Policies that are written from task texts alone: each cites the text for every component that it reads and every
action that it takes. The citations stand in the text at these components, nothing else is read, and each policy beats
random."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import proofs
import pytest
from task_tables import selected, table

from evopolicy_common.messages.environment import Case, SpaceSchema
from evopolicy_worker.environments import Environment, make

pytestmark = pytest.mark.families

FOLDER = Path(__file__).parent / "cited"
IDS = sorted(each.stem.replace("_", "/", 1) for each in FOLDER.glob("*.py"))
N_CASES = 16
Place = tuple[str, tuple[int, ...]]


def policy(env_id: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location("cited", FOLDER / f"{env_id.replace('/', '_')}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def places(cited: dict[str, str]) -> list[Place]:
    return [place for selector in cited for place in selected(selector)]


def read(obs: Any, place: Place) -> float:
    path, index = place
    return float((obs[path] if path else obs)[index])


def uncited(text: str, heading: str, cited: dict[str, str]) -> dict[str, str]:
    """The citations that do not stand in the row of their component."""
    rows = {place: row[1] for row in table(text, heading) for place in selected(row[0])}
    return {
        at: words
        for at, words in cited.items()
        if any(words not in rows.get(each, "") for each in selected(at))
    }


@pytest.mark.parametrize("env_id", IDS)
def test_each_citation_stands_in_the_text_at_its_component(env_id: str) -> None:
    environment, rules = make(env_id), policy(env_id)
    text = environment.description.task_text
    environment.close()
    assert uncited(text, "Observation", rules.SEEN) == {}
    assert uncited(text, "Action", rules.DONE) == {}
    # It would be told.
    first = next(iter(rules.SEEN))
    assert uncited(text, "Observation", rules.SEEN | {first: "no such words"}) == {first: "no such words"}


def play(environment: Environment, seed: int, rules: ModuleType | None) -> float:
    obs, total, rng = environment.reset(Case(seed=seed)), 0.0, np.random.default_rng(seed)
    seen = places(rules.SEEN) if rules else []
    while True:
        action = environment.action_codec.sample(rng)
        if rules is not None:
            given = rules.act([read(obs, place) for place in seen])
            space: SpaceSchema = environment.description.action_space
            taken = [str(given)] if space["type"] == "Discrete" else [str(k) for k in range(len(given))]
            assert set(taken) <= rules.DONE.keys(), "an action without a citation"
            action, invalid = environment.action_codec.repair(given)
            assert not invalid
        step = environment.step(action)
        obs, total = step.obs, total + step.reward
        if step.terminated or step.truncated:
            return total


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("env_id", IDS)
def test_a_policy_from_the_text_alone_beats_random_on_drawn_cases(env_id: str) -> None:
    environment = make(env_id)
    seeds = proofs.drawn(f"cited {env_id}")[:N_CASES]
    ours, random = (
        np.array([play(environment, seed, each) for seed in seeds]) for each in (policy(env_id), None)
    )
    environment.close()
    told = f"{env_id}: {ours.mean():.4g} beside {random.mean():.4g}, better on {(ours > random).sum()} of {N_CASES}"
    print(told)
    # Returns of random actions can have long tails: signs count. A policy no better than random gets there once in 478
    # times.
    assert (ours > random).sum() >= 14, told


def test_there_are_ten_of_them() -> None:
    assert len(IDS) == 10
