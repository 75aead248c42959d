"""One turn: reads the API's key and the prompt on stdin, as JSON, works until the model ends its turn, prints events as
JSON lines.

Exit status: 0 the turn is done, 1 it failed; the last event tells which.
"""

from __future__ import annotations

import argparse
import asyncio
import ctypes
import json
import sys
from importlib import metadata
from pathlib import Path

_PR_SET_DUMPABLE = 4


def main() -> int:
    parser = argparse.ArgumentParser(prog="llm")
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--settings", type=json.loads, default={})
    parser.add_argument("--session", default="")
    parser.add_argument("--resume", action="store_true")
    given = parser.parse_args()
    if given.version:
        print(f"pydantic-ai {metadata.version('pydantic-ai-slim')}")
        return 0
    # The model's commands have this process's user: without this they could read its key, and use it uncounted.
    ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    # The import takes seconds, which the version does not need.
    from evopolicy_gateway.agents.llm.agent import EventWriter, Session, play_turn
    from evopolicy_gateway.agents.llm.conversation import ApiError, Conversation, UserError

    session = Session(Path.home() / ".evopolicy-llm" / f"{given.session}.json")
    events = EventWriter(sys.stdout, given.session)
    order = json.load(sys.stdin)
    kept = session.load() if given.resume else b""
    try:
        conversation = Conversation(given.settings, order["key"], kept)
    except UserError as error:  # such as a name of a model that the provider cannot have
        events.failed(ApiError(str(error), 400))
        return 1
    return asyncio.run(play_turn(conversation, order["prompt"], session, events))


if __name__ == "__main__":
    sys.exit(main())
