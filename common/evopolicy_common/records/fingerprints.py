"""What of two runs' fingerprints must agree for their scores to stand side by side. Pure.

Since fingerprints are of one environment, a run tells its `adapter` (`REVISION+DIGEST`) and its `definition`. The revision
counts; the digest and `evopolicy-worker`, the digest of all of the worker's code, keep workers of one run apart and no more.
Runs from before told the packages of all environments and no adapter: they were played by revision `FIRST`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

FIRST = "1.1"
"""Revision of the adapters that played the runs which tell none."""
_CODE = "evopolicy-worker"


def comparable(fingerprints: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """The parts that count of runs of one environment, in their order; equal dicts may be compared."""
    told = [each for each in fingerprints if "adapter" in each]
    names = {name for each in told for name in each}
    definitions = {each.get("definition", "") for each in told}
    found = []
    for each in fingerprints:
        parts = dict(each)
        if "adapter" in parts:
            del parts[_CODE]
            parts["adapter"] = parts["adapter"].partition("+")[0]
        elif told and parts:
            # Packages of other environments decide nothing here, and a package that is missing here was not told there.
            parts = {name: value for name, value in parts.items() if name in names and name != _CODE}
            parts |= {"adapter": FIRST, "definition": min(definitions)}
        found.append(parts)
    return found
