"""A cluster for the tests of the operator's commands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from commands import toy_cluster


@pytest.fixture(scope="module")
def operator_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Credentials for a coordinator with a worker of two slots, up for all tests of a module."""
    with toy_cluster(tmp_path_factory.mktemp("c")) as file:
        yield file
