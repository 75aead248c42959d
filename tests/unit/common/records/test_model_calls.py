"""Calls of a model between submits."""

from __future__ import annotations

from pathlib import Path

from evopolicy_common.records.model_calls import LEDGER, before
from evopolicy_common.records.summary import utc_text

NOON = 1_800_000_000.0


def line(at: float, status: int = 200, more: str = "") -> str:
    usage = (
        '{"input_noncached": 900, "cache_read": 100, "output": 50, "cache_creation": 0, "reasoning": null}'
    )
    return f'{{"at": {at}, "api": "responses", "status": {status}, "usage": {usage}, "whole_s": 2.5{more}}}'


def test_calls_belong_to_the_submit_that_follows_them(tmp_path: Path) -> None:
    starts = [utc_text(NOON + 10), utc_text(NOON + 20), utc_text(NOON + 30)]
    assert before(tmp_path, starts) == ["", "", ""]
    (tmp_path / "logs").mkdir()
    lines = [line(NOON), line(NOON + 9, 429), line(NOON + 25, more=', "broken": true'), line(NOON + 31)]
    lines += ["", "{", line(1e300), '{"at": "x"}']
    (tmp_path / LEDGER).write_text("\n".join(lines))
    assert before(tmp_path, starts) == [
        "2 model calls (1 failed), 2,100 tokens, 5 s",
        "",
        "1 model call (1 failed), 1,050 tokens, 2 s",
    ]
