"""The stage of a sweep, whose pauses are short."""

from __future__ import annotations

from pathlib import Path

import pytest
from stages.sweep_stage import HEAD, Stage, Staged

from evopolicy_gateway.suite import claimed, sweep


@pytest.fixture
def staged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Staged:
    """Makes the stage of the sweep whose file begins with `HEAD`."""
    monkeypatch.setattr(sweep, "POLL_S", 0.01)
    monkeypatch.setattr(claimed, "_ASK_AGAIN_S", 0.01)
    return lambda *texts: Stage(tmp_path, "".join((HEAD, *texts)), monkeypatch)
