"""Slots shared by the whole corpus: each attack meets what the one before has left."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from slots import Slots


@pytest.fixture(scope="session")
def slots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slots]:
    found = Slots(tmp_path_factory.mktemp("hostile"))
    yield found
    found.close()
