"""Fixtures that several of the integration tests share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from coordinator_harness import Coordinator


@pytest.fixture
def coordinator(tmp_path: Path) -> Iterator[Coordinator]:
    """A coordinator's process of the test's own."""
    coordinator = Coordinator(tmp_path / "state")
    yield coordinator
    coordinator.kill()
