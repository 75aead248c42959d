"""The rules of a published world: which candidates the fixed order allows, and what stays the publisher's word."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from evopolicy_common.messages.environment import Case
from evopolicy_results.publish import fields, run_rules
from evopolicy_results.publish.findings import History

ROOT, TRIALS = "ab" * 16, "cd" * 32


def run(env: str, *keys: str, trials: str = TRIALS) -> Any:
    cases = tuple(Case(seed=n, options={"world": key} if key else None) for n, key in enumerate(keys))
    opening = SimpleNamespace(settings=SimpleNamespace(env=env), trials=trials, train=cases)
    return SimpleNamespace(opening=opening, cases=lambda split: cases)


def faults(of: Any) -> list[str]:
    return list(run_rules._worlds(of, History([], [])))


@pytest.mark.parametrize(
    ("env", "number", "trials", "told"),
    [
        ("gym/acrobot@w1", 977, TRIALS, "has candidate 977; its trials allow 0 to 15"),
        ("gym/acrobot@w1", 16, TRIALS, "has candidate 16; its trials allow 0 to 15"),
        ("gym/acrobot@w3", 1, TRIALS, "has candidate 1; its trials allow 2 to 15"),
        ("gym/acrobot@w1", 5, "", "has candidate 5; without trials it has 0"),
    ],
)
def test_a_candidate_that_the_order_does_not_allow_fails(
    env: str, number: int, trials: str, told: str
) -> None:
    """Attack: an operator chooses the rules of a world by a journal of trials that is written by hand."""
    (fault,) = faults(run(env, f"{ROOT}-{number}", trials=trials))
    assert told in fault


def test_cases_of_one_world_have_one_key() -> None:
    assert faults(run("gym/acrobot@w1", f"{ROOT}-0", f"{ROOT}-1")) == [
        "the cases of gym/acrobot@w1 have other keys of a world"
    ]
    assert len(faults(run("gym/acrobot@w1", ""))) == 1


@pytest.mark.parametrize(
    ("of", "told"),
    [
        (run("gym/acrobot", ""), ""),
        (
            run("gym/acrobot@w1", f"{ROOT}-15"),
            f"candidate 15 of 16: its publisher's trials chose it (SHA-256 {TRIALS})",
        ),
        (run("gym/acrobot@w2", f"{ROOT}-1", trials=""), "candidate 1 of 16: it was not tried"),
        (run("gym/acrobot@w1", ROOT, trials=""), "rules of its publisher's choice, from case files"),
    ],
)
def test_what_is_the_publishers_choice_is_told_with_its_number(of: Any, told: str) -> None:
    assert faults(of) == []
    text = run_rules._chosen_world(of)
    assert (told in text) if told else text == ""


def test_model_tokens_jail_and_isolation_are_listed_as_the_publishers_word() -> None:
    named = (
        "agent.harness",
        "agent.model_string",
        "agent.tokens",
        "agent.model_use",
        "jail",
        "hidden_isolation",
        "outcome.heldout_successes",
        "submits.status",
    )
    assert set(named) <= set(fields.TOLD)
