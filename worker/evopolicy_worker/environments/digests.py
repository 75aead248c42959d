"""Writes the digests of all shipped definitions: `python -m evopolicy_worker.environments.digests FILE`.

An environment that cannot be made here keeps its digest from the file. Run it with the versions of `constraints.txt`
whenever a definition or a task text changes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from evopolicy_common import catalogue
from evopolicy_common.messages.worker import DEFINITION_DIGITS
from evopolicy_worker.environments import registry


def digests(known: dict[str, str]) -> dict[str, str]:
    """The first `DEFINITION_DIGITS` digits of each shipped definition's digest, by environment id. `known`: the
    previous ones."""
    offered = set(registry.offered())
    found = {
        env_id: registry.describe(env_id).digest()[:DEFINITION_DIGITS]
        if env_id in offered
        else known.get(env_id)
        for env_id in catalogue.entries()
    }
    return {env_id: digest for env_id, digest in found.items() if digest}


def main() -> None:
    """Rewrites the file that the first argument names."""
    file = Path(sys.argv[1])
    known = json.loads(file.read_text()) if file.exists() else {}
    file.write_text(json.dumps(digests(known), indent=0) + "\n")


if __name__ == "__main__":
    main()
