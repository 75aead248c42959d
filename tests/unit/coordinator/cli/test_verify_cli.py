"""`evopolicy verify`: how it ends."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from typer.testing import CliRunner

from evopolicy_results.cli import verify


def test_verify_ended_by_a_signal_says_so_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ended() -> None:
        raise asyncio.CancelledError

    monkeypatch.setattr(verify, "end_on_sigterm", ended)
    result = CliRunner().invoke(verify.app, [str(tmp_path)])
    assert (result.exit_code, result.output.split()) == (130, ["error:", "interrupted"])
