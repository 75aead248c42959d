"""Published results that several modules check and change."""

from __future__ import annotations

import pytest
from publications import Results


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return Results(tmp_path_factory.mktemp("published"))
