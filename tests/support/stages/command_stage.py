"""A command agent on a stage of its own, played to its end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from evopolicy_gateway.harnesses.command import CommandHarness
from evopolicy_gateway.harnesses.interface.base import Stage
from evopolicy_gateway.processes.agent_process import AgentLog, environment_of
from evopolicy_gateway.processes.child_messages import AgentEnded
from evopolicy_gateway.processes.clock import Activity

TIMEOUT_S = 30.0


def play(
    tmp_path: Path, code: str, silence_s: float | None = None, info: str = "http://127.0.0.1:9/nobody"
) -> tuple[AgentEnded, list[dict[str, Any]], list[tuple[int, str]]]:
    """How a Python program with that code ended, its log, and what it said."""
    turns: list[tuple[int, str]] = []
    log_file = tmp_path.with_name(f"{tmp_path.name}-log") / "agent.jsonl"
    log = AgentLog(log_file)
    stage = Stage(
        workspace=tmp_path,
        urls={"EVOPOLICYGYM_INFO_URL": info},
        environment=environment_of({"EVOPOLICYGYM_INFO_URL": "u"}),
        log=log,
        activity=None if silence_s is None else Activity(silence_s, tmp_path),
        on_turn=lambda turn, text: turns.append((turn, text)),
    )

    async def main() -> AgentEnded:
        async with asyncio.timeout(TIMEOUT_S):
            ending = await CommandHarness("command", [sys.executable, "-c", code]).run_agent(stage)
            for pid in stage.started if ending.reason == "silent" else ():  # an agent supervisor would end it
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(pid, signal.SIGKILL)
                while Path(f"/proc/{pid}").exists():  # asyncio takes its status
                    await asyncio.sleep(0.02)
            return ending

    ending = asyncio.run(main())
    log.close()
    lines = log_file.read_text().splitlines()
    return ending, [json.loads(line) for line in lines], turns


def play_with_a_child_that_holds_the_pipes(tmp_path: Path) -> AgentEnded:
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
