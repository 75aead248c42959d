"""Shared by both fake CLIs: a scenario with the faults of each start, and an agent that submits.

`FAKE_SCENARIO`: names joined by commas, one for each start of the program; the last holds for all further ones.
`FAKE_STATE`: a folder where starts are counted and sessions are kept.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

STATE = Path(os.environ.get("FAKE_STATE", ".fake"))


def scenario() -> str:
    """The part of the scenario for this start."""
    names = os.environ.get("FAKE_SCENARIO", "work").split(",")
    STATE.mkdir(parents=True, exist_ok=True)
    starts = STATE / "starts"
    with starts.open("a") as file:
        file.write(json.dumps(sys.argv[1:]) + "\n")
    return names[min(len(starts.read_text().splitlines()), len(names)) - 1]


def emit(event: dict[str, Any], *, torn: bool = False) -> None:
    """One line; `torn`: in two writes with a pause between them, as pipes do."""
    line = json.dumps(event) + "\n"
    if torn:
        sys.stdout.write(line[: len(line) // 2])
        sys.stdout.flush()
        time.sleep(0.05)
        line = line[len(line) // 2 :]
    sys.stdout.write(line)
    sys.stdout.flush()


def submit(n: int) -> dict[str, Any]:
    """Submits up to `n` cases, as many as the budget lets; an answer of the gateway, or what stands for one."""
    import urllib.error
    import urllib.request  # takes a while, and most starts do not need it

    url = os.environ.get("EVOPOLICYGYM_SUBMIT_URL")
    if not url:
        return {"status": "nowhere"}
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(os.environ["EVOPOLICYGYM_INFO_URL"]) as answer:
        left = json.load(answer)["state"]["remaining_budget"]
    body = json.dumps({"env_instances": list(range(min(n, left)))}).encode()
    try:
        with opener.open(urllib.request.Request(url, data=body)) as answer:
            return dict(json.load(answer))
    except urllib.error.HTTPError as error:
        return dict(json.load(error))


def edit() -> None:
    """Changes the policy a little."""
    policy = Path("system/policy.py")
    if policy.is_file():
        policy.write_text(policy.read_text() + f"\n# edited {time.time_ns()}\n")


def read(path: str) -> str:
    """A file of the workspace."""
    return Path(path).read_text()


def change(turns: int) -> None:
    """Another function at every odd turn, another constant in the last one at every even turn after the first."""
    policy = Path("system/policy.py")
    if turns % 2:
        policy.write_text(policy.read_text() + f"\n\ndef term_{turns}(x):\n    return {turns}.0 * x\n")
    elif turns:
        policy.write_text(
            policy.read_text().replace(f"return {turns - 1}.0 * x", f"return {turns - 1}.5 * x")
        )
