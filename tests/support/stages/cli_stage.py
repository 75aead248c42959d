"""A stage for a coding agent's CLI without a cluster: a gateway that only counts, a log, and the fake CLIs on the
PATH."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from machines.own_processes import only_what_starts_inside

from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.agent_supervisor.supervisor import secrets_in
from evopolicy_gateway.harnesses import make
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.harnesses.interface.base import Stage
from evopolicy_gateway.processes.agent_process import AgentLog
from evopolicy_gateway.processes.child_messages import AgentDoing, AgentEnded
from evopolicy_gateway.processes.clock import AgentClock
from stages.loopback import serving_json

FAKES = Path(__file__).parents[1] / "fake_clis"
TIMEOUT_S = 300.0
PATH_TOKEN = "0123456789abcdef0123456789abcdef"


@contextmanager
def counting_gateway(budget: int, asked_in_flight: int = 0) -> Iterator[dict[str, str]]:
    """The three URLs of a gateway that answers every submit with `ok` and counts the budget down."""
    remaining, in_flight = [budget], [asked_in_flight]

    def answer(path: str, headers: Mapping[str, str], body: Any) -> tuple[int, Any]:
        if body is None:
            state = {"remaining_budget": remaining[0], "n_submits": 0, "is_finalized": remaining[0] <= 0}
            # The first answers of `in_flight` tell of a submit that still runs.
            running = {"submit_id": "submit_000"} if in_flight[0] > 0 else None
            in_flight[0] -= 1
            return 200, {"state": state, "submit_in_flight": running}
        if in_flight[0] > 0:
            return 200, {"status": "conflict"}
        remaining[0] -= len(body["env_instances"])
        return 200, {"status": "ok", "submit_id": "submit_000", "summary": {}}

    with serving_json(answer) as url:
        yield {
            f"EVOPOLICYGYM_{name.upper()}_URL": f"{url}/{PATH_TOKEN}/{name}"
            for name in ("info", "task", "submit")
        }


class Played:
    """The result of playing an agent."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ending: AgentEnded
        self.turns: list[tuple[int, str]] = []
        self.doings: list[AgentDoing] = []

    @property
    def outcome(self) -> tuple[str, int, int]:
        """Why it ended, its turns, and its retries."""
        return self.ending.reason, self.ending.turns, self.ending.retries

    @property
    def text(self) -> str:
        return (self.folder / "agent.jsonl").read_text()

    @property
    def log(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.text.splitlines()]

    @property
    def prompts(self) -> list[dict[str, Any]]:
        return [line for line in self.log if line.get("type") == "prompt"]

    @property
    def starts(self) -> list[list[str]]:
        """Arguments of each start of the fake."""
        return [json.loads(line) for line in (self.folder / "fake" / "starts").read_text().splitlines()]


def thinks_without_end(played: Played) -> bool:
    """The scenario `work,endless` is in its second turn."""
    return len(played.turns) == 1 and any(doing.action == "still thinking" for doing in played.doings)


def settings(harness: str, **more: Any) -> AgentConfig:
    """For tests: nothing waits long."""
    usual: dict[str, Any] = {"backoff_s": 0.001, "pause_s": 0.01, "reprompts": 3}
    return AgentConfig(harness=harness, **(usual | more))


def play(
    folder: Path,
    config: AgentConfig,
    scenario: str,
    budget: int = 4,
    over_when: Callable[[Played], bool] | None = None,
    asked_in_flight: int = 0,
    **env: str,
) -> Played:
    """Plays the agent to its end, or until its time is over: when `over_when` says so."""
    workspace = folder / "workspace"
    (workspace / "system").mkdir(parents=True, exist_ok=True)
    played = Played(folder)
    with counting_gateway(budget, asked_in_flight) as urls, only_what_starts_inside():
        environment = {
            "PATH": f"{FAKES}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(folder),
            "FAKE_SCENARIO": scenario,
            "FAKE_STATE": str(folder / "fake"),
            **urls,
            **env,
        }
        log = AgentLog(folder / "agent.jsonl", Redaction.of(secrets_in(environment, config), urls))
        stage = Stage(
            workspace=workspace,
            urls=urls,
            environment=environment,
            log=log,
            on_turn=lambda turn, text: played.turns.append((turn, text)),
            session_file=folder / "session.json",
            on_doing=played.doings.append,
            clock=AgentClock(3600.0),
        )

        async def main() -> AgentEnded:
            async with asyncio.timeout(TIMEOUT_S):
                playing = asyncio.create_task(make(config.harness, folder, config).run_agent(stage))
                if over_when is not None:
                    while not playing.done() and not over_when(played):
                        await asyncio.sleep(0.05)
                    stage.over.set()
                    # As the agent supervisor does it, whose only descendants are the agent's.
                    for pid in stage.started:
                        if not playing.done():
                            with suppress(ProcessLookupError):
                                os.kill(pid, 9)
                return await playing

        try:
            played.ending = asyncio.run(main())
        finally:
            log.close()
    return played
