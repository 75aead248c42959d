"""A real worker process with an old version: `old_worker.py HOW OPTIONS…`, the options being the worker's own.

HOW: `current`; `old-code` reports another code version and another adapter; `old-protocol` speaks another wire version.
The first reports the same fingerprint, whatever is edited meanwhile.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import msgspec

from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.wire import codec
from evopolicy_worker import cli
from evopolicy_worker.environments.interface.fingerprint import fingerprint
from evopolicy_worker.slots.slot import Slot


class OldSlot(Slot):
    """Describes environments as an older adapter does."""

    async def describe(self, env_ids: Sequence[str]) -> tuple[EnvironmentDescription, ...]:
        described = await super().describe(env_ids)
        return tuple(msgspec.structs.replace(each, adapter="1.1+old") for each in described)


if __name__ == "__main__":
    HOW = sys.argv.pop(1)
    forged = msgspec.structs.replace(fingerprint(), code_version="old" if HOW == "old-code" else "current")
    cli.fingerprint = lambda: forged  # type: ignore[attr-defined]
    if HOW == "old-code":
        cli.Slot = OldSlot  # type: ignore[attr-defined]
    if HOW == "old-protocol":
        codec.WIRE_VERSION = 0
    cli.main()
