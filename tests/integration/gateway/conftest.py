"""A cluster for the tests of the operator's commands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import Plays, Ran, agent, ran_on, toy_cluster


@pytest.fixture(scope="module")
def operator_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Credentials for a coordinator with a worker of two slots, up for all tests of a module."""
    with toy_cluster(tmp_path_factory.mktemp("c")) as file:
        yield file


@pytest.fixture
def ran(operator_file: Path, tmp_path: Path) -> Plays:
    """Plays a run on that cluster by a program with that code; more arguments as for `ran_on`."""

    def play(code: str, *more: str, ends: int = 0) -> Ran:
        return ran_on(operator_file, tmp_path, agent(tmp_path, code), *more, ends=ends)

    return play
