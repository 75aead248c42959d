"""The parts of runs' fingerprints that must be equal for their scores to be comparable. Pure.

A run's fingerprint has its environment's `adapter` (`REVISION+DIGEST`) and `definition`. The revision counts here; the
digest and `evopolicy-worker`, the digest of all of the worker's code, only distinguish workers within a run. Runs of
earlier versions list the packages of all environments and no adapter: revision `FIRST` played them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

FIRST = "1.1"
"""Revision of the adapters of runs that list none."""
_CODE = "evopolicy-worker"


def comparable(fingerprints: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """The relevant parts of fingerprints of runs of one environment, in order; runs with equal dicts are comparable."""
    detailed = [each for each in fingerprints if "adapter" in each]
    names = {name for each in detailed for name in each}
    definitions = {each.get("definition", "") for each in detailed}
    compared = []
    for each in fingerprints:
        parts = dict(each)
        if "adapter" in parts:
            del parts[_CODE]
            parts["adapter"] = parts["adapter"].partition("+")[0]
        elif detailed and parts:
            # Packages of other environments are irrelevant here, and the older run did not list what is missing here.
            parts = {name: value for name, value in parts.items() if name in names and name != _CODE}
            parts |= {"adapter": FIRST, "definition": min(definitions)}
        compared.append(parts)
    return compared
