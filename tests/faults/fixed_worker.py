"""The worker's command, of one code version through all its restarts, also where its files are edited meanwhile: a run
is pinned to the version it began with, and would rightly wait for it."""

from __future__ import annotations

import msgspec

from evopolicy_worker import cli
from evopolicy_worker.environments.interface.fingerprint import fingerprint

if __name__ == "__main__":
    fixed = msgspec.structs.replace(fingerprint(), code_version="faults")
    cli.fingerprint = lambda: fixed  # type: ignore[attr-defined]
    cli.main()
