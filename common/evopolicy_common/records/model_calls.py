"""The calls of an agent's model before each submit, in words, from the relay's ledger `logs/model_requests.jsonl`."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS
from evopolicy_common.records.run_record import Tokens
from evopolicy_common.records.summary import utc_text
from evopolicy_common.regular_files import read_regular
from evopolicy_common.terminal import counted

LEDGER = "logs/model_requests.jsonl"
_MAX_BYTES = 64 << 20


class _Call(msgspec.Struct, frozen=True, kw_only=True):
    at: float
    status: int
    usage: Tokens
    broken: bool = False
    whole_s: float = 0.0


_decoder = msgspec.json.Decoder(_Call)


def before(folder: Path, starts: Sequence[str]) -> list[str]:
    """For each submit of the run at `folder`, the calls since the one before; empty without any, or a ledger.
    `starts`: the submits' `submit_started_at`, in their order."""
    calls: list[list[_Call]] = [[] for _ in range(len(starts) + 1)]
    try:
        lines = read_regular(folder / LEDGER, _MAX_BYTES).splitlines()
    except OSError:
        lines = []
    for line in lines:
        try:
            call = _decoder.decode(line)
            calls[bisect.bisect_right(starts, utc_text(call.at))].append(call)
        except (*DECODE_ERRORS, OverflowError, OSError):
            continue
    return [_words(some) if some else "" for some in calls[:-1]]


def _words(calls: Sequence[_Call]) -> str:
    failed = sum(not 200 <= call.status < 300 or call.broken for call in calls)
    return (
        f"{counted(len(calls), 'model call')}{f' ({failed:,} failed)' if failed else ''},"
        f" {sum(call.usage.total for call in calls):,} tokens, {sum(call.whole_s for call in calls):,.0f} s"
    )
