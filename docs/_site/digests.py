"""Writes the digests of shipped definitions: `python docs/_site/digests.py [ID…]`.

An environment that cannot be made here, or that is not among the ids (suites, globs), keeps its digest.
Run it with the versions of `constraints.txt` whenever a definition or a task text changes, and for a family in a
virtual environment of its own with that one's interpreter.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path

from evopolicy_common import catalogue
from evopolicy_common.messages.worker import DEFINITION_DIGITS
from evopolicy_worker.environments import registry

FILE = Path(__file__).parents[2] / "common" / "evopolicy_common" / "catalogue" / "digests.json"


def digests(env_ids: Iterable[str]) -> dict[str, str]:
    """The first `DEFINITION_DIGITS` digits of each shipped definition's digest, by environment id. `env_ids`: those
    that are made."""
    known = catalogue.digests()
    chosen = set(registry.offered()) & set(env_ids)
    made = {env_id: registry.describe(env_id).digest()[:DEFINITION_DIGITS] for env_id in chosen}
    return {env_id: (known | made)[env_id] for env_id in catalogue.entries() if env_id in known | made}


if __name__ == "__main__":
    chosen = catalogue.resolve(sys.argv[1:]) or catalogue.entries()
    FILE.write_text(json.dumps(digests(chosen), indent=0) + "\n")
