"""An agent that somebody else starts, in a container or on another host: there is nothing to start here, only to wait.

It ends when the budget is spent, when its time is over, or when the operator says `evopolicy finish RUN_DIRECTORY`.
"""

from __future__ import annotations

from evopolicy_gateway.harnesses.base import Harness, Stage
from evopolicy_gateway.operator.child_messages import AgentEnded
from evopolicy_gateway.run.layout import RunFolder

_LOOK_S = 0.5


class RemoteHarness(Harness):
    """`remote`: it is not in our hands, so neither is what it may see and reach."""

    name = "remote"
    resumable = True

    async def play(self, stage: Stage) -> AgentEnded:
        finish = RunFolder(stage.workspace.parent).finish
        while not finish.exists() and not stage.over.is_set():
            await stage.sleep(_LOOK_S)
        return AgentEnded(reason="agent_stopped", facts={"settings": {"started_by": "the operator"}})
