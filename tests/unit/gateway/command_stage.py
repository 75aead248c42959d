"""A command agent on a stage of its own, played to its end."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path
from typing import Any

from evopolicy_gateway.harnesses.agent_log import AgentLog
from evopolicy_gateway.harnesses.agent_process import environment_of
from evopolicy_gateway.harnesses.base import Ending, Stage
from evopolicy_gateway.harnesses.command import CommandHarness

PATIENCE_S = 30.0


def play(tmp_path: Path, code: str) -> tuple[Ending, list[dict[str, Any]], list[tuple[int, str]]]:
    """How a Python program with that code ended, its log, and what it said."""
    turns: list[tuple[int, str]] = []
    log = AgentLog(tmp_path / "logs" / "agent.jsonl")
    stage = Stage(
        workspace=tmp_path,
        urls={"EVOPOLICYGYM_INFO_URL": "http://127.0.0.1:9/nobody"},
        environment=environment_of({"EVOPOLICYGYM_INFO_URL": "u"}),
        log=log,
        on_turn=lambda turn, text: turns.append((turn, text)),
    )

    async def main() -> Ending:
        async with asyncio.timeout(PATIENCE_S):
            return await CommandHarness("command", [sys.executable, "-c", code]).play(stage)

    ending = asyncio.run(main())
    log.close()
    lines = (tmp_path / "logs" / "agent.jsonl").read_text().splitlines()
    return ending, [json.loads(line) for line in lines], turns


def play_with_a_child_that_holds_the_pipes(tmp_path: Path) -> Ending:
    """How a program ended that left a child behind which has its standard output open."""
    code = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
open("child", "w").write(str(child.pid))
"""
    try:
        return play(tmp_path, code)[0]
    finally:
        os.kill(int((tmp_path / "child").read_text()), 9)
