"""One turn: reads the API's key and the prompt on stdin, as JSON, works until the model ends its turn, prints events as
JSON lines.

Exit status: 0 the turn is done, 1 it failed; the last event tells which.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import json
import sys
from importlib import metadata
from pathlib import Path

from evopolicy_gateway.agents.llm.agent import Events, Session, play_turn
from evopolicy_gateway.agents.llm.apis import APIS, open_api

_PR_SET_DUMPABLE = 4


def main() -> int:
    parser = argparse.ArgumentParser(prog="llm")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--settings", type=json.loads, default={})
    parser.add_argument("--session", default="")
    parser.add_argument("--resume", action="store_true")
    given = parser.parse_args()
    if given.version:
        installed = [name for name in APIS if importlib.util.find_spec(name) is not None]
        print(", ".join(f"{name} {metadata.version(name)}" for name in installed))
        return 0
    # The model's commands have this process's user: without this they could read its key, and use it uncounted.
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    session = Session(Path.home() / ".evopolicy-llm" / f"{given.session}.json")
    events = Events(sys.stdout, given.session)
    order = json.load(sys.stdin)
    api = open_api(given.settings, order["key"], session.load() if given.resume else [])
    return play_turn(api, order["prompt"], session, events)


if __name__ == "__main__":
    sys.exit(main())
