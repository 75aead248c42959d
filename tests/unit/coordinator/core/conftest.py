"""The core that most of these tests drive."""

from __future__ import annotations

import pytest
from rigs.core_rig import Rig


@pytest.fixture
def rig() -> Rig:
    return Rig()
