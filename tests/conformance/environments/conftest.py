"""Environments are made once per test run and shared: reuse is what is being tested."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from evopolicy_worker.environments import Environment, make


@pytest.fixture(scope="session")
def warm() -> Iterator[Callable[[str], Environment]]:
    """The shared environment of an id, used by many tests one after another."""
    made: dict[str, Environment] = {}

    def get(env_id: str) -> Environment:
        if env_id not in made:
            made[env_id] = make(env_id)
        return made[env_id]

    yield get
    for environment in made.values():
        environment.close()
