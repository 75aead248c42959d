"""An agent that is started by someone else, in a container or on another host; this harness only waits.

It ends when the budget is spent, when its time is up, or when the operator runs `evopolicy finish RUN_DIRECTORY`.
"""

from __future__ import annotations

from evopolicy_gateway.harnesses.interface.base import Harness, Stage
from evopolicy_gateway.processes.child_messages import AgentEnded
from evopolicy_gateway.run_folder.layout import RunFolder

_POLL_S = 0.5


class RemoteHarness(Harness):
    """`remote`: we do not control the agent, nor what it may see and reach."""

    name = "remote"
    resumable = True

    async def play(self, stage: Stage) -> AgentEnded:
        finish = RunFolder(stage.workspace.parent).finish
        while not finish.exists() and not stage.over.is_set():
            await stage.sleep(_POLL_S)
        return AgentEnded(reason="agent_stopped", facts={"settings": {"started_by": "the operator"}})
