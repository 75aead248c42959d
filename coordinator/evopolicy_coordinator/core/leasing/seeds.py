"""Seeds of policy processes: keyed hashes that are reproducible and reveal neither the case's seed nor the split.

policy_seed = HMAC-SHA256(run secret, submit index | split | case id | occurrence)[:16]

The uniform-random reference has no policy. Its actions follow from the split and the case alone, so that every run on a
split, and `evopolicy random`, get the same returns:

reference_seed = SHA-256("evopolicy random reference" NUL JSON of [split, case seed, options, occurrence])[:16]
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Iterable

from evopolicy_common.messages.environment import Case


def policy_seed(secret: bytes, submit_index: int, split: str, case_id: int, occurrence: int) -> bytes:
    """Returns 16 bytes for the `occurrence`-th (from 0) time that a submit plays `case_id` of `split`.

    `submit_index` is −1 for evaluations outside runs.
    """
    text = f"{submit_index}|{split}|{case_id}|{occurrence}".encode()
    return hmac.digest(secret, text, hashlib.sha256)[:16]


def reference_seed(split: str, case: Case, occurrence: int) -> bytes:
    """Returns 16 bytes for the `occurrence`-th (from 0) time that uniform random actions play `case` of `split`."""
    # An environment cannot distinguish missing options from empty ones.
    text = json.dumps([split, case.seed, case.options or None, occurrence], sort_keys=True)
    return hashlib.sha256(b"evopolicy random reference\0" + text.encode()).digest()[:16]


def occurrences(case_ids: Iterable[int]) -> tuple[int, ...]:
    """Returns, for each position, how often its case id occurs earlier in the list."""
    seen: dict[int, int] = {}
    counts: list[int] = []
    for case_id in case_ids:
        count = seen.get(case_id, 0)
        counts.append(count)
        seen[case_id] = count + 1
    return tuple(counts)
