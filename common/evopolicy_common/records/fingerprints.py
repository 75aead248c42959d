"""The parts of runs' fingerprints that must be equal for their scores to be comparable. Pure.

A run's fingerprint has its environment's `adapter` (`REVISION+DIGEST`) and `definition`. The revision counts here; the
digest and `evopolicy-worker`, the digest of all of the worker's code, only distinguish workers within a run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

_CODE = "evopolicy-worker"


def comparable(fingerprints: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """The relevant parts of fingerprints, in order; runs with equal dicts are comparable."""
    compared = [dict(each) for each in fingerprints]
    for parts in compared:
        if "adapter" in parts:
            del parts[_CODE]
            parts["adapter"] = parts["adapter"].partition("+")[0]
    return compared
