"""The bench's agent: a warm-up, then one submit of N episodes; writes how long it took.

`python submit_agent.py N RESULT`, or with `--small`: a submit of N episodes, then the same a few times more. With a
pipe in place of `--small`: a submit for each empty line that comes from it, whose seconds go to RESULT as a line.
"""

from __future__ import annotations

import json
import os
import sys
import time
import urllib.request
from pathlib import Path

from bare_loop import POLICY


def submit(ids: list[int]) -> float:
    """Seconds from POST to answer; the answer comes when the feedback is committed."""
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"],
        data=json.dumps({"env_instances": ids}).encode(),
        headers={"Content-Type": "application/json"},
    )
    started = time.perf_counter()
    with urllib.request.urlopen(request) as answer:
        assert json.load(answer)["status"] == "ok"
    return time.perf_counter() - started


SMALL = 4
"""Submits with `--small`; all but the first count."""


def main(n: int, result: Path, *how: str) -> None:
    (Path("system") / "policy.py").write_text(POLICY)
    if how and how[0] != "--small":
        with open(how[0]) as orders, result.open("w", buffering=1) as answers:
            while orders.readline() == "\n":
                print(submit(list(range(n))), file=answers)
        return
    if how:
        small_s = [submit(list(range(n))) for _ in range(SMALL)]
        result.write_text(json.dumps({"small_s": small_s[1:]}))
        return
    submit([0, 1, 2, 3])
    result.write_text(json.dumps({"submit_s": submit(list(range(n)))}))


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
