"""A real agent supervisor, driven by its messages."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, TypeVar

from evopolicy_gateway.processes import child_messages
from evopolicy_gateway.processes.child_messages import FromChild, StartAgent, ToChild
from evopolicy_gateway.run_folder.layout import RunFolder

E = TypeVar("E", bound=FromChild)
TIMEOUT_S = 60.0
AGENT = "import os, time; open(os.path.join({folder!r}, str(os.getpid())), 'w').close(); time.sleep(1000)"


class SupervisorProcess:
    """An agent supervisor process with an agent that writes its process id into `folder`."""

    def __init__(
        self, root: Path, wall_limit_s: float = 1000.0, agent: str | None = None, **more: Any
    ) -> None:
        """`more`: fields of `StartAgent`."""
        self.folder = root / "pids"
        self.folder.mkdir(exist_ok=True)
        self.lock = RunFolder(root).supervisor_lock
        for folder in (self.lock.parent, RunFolder(root).workspace):
            folder.mkdir(exist_ok=True)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "evopolicy_gateway.agent_supervisor.supervisor"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        program = root / "agent.py"
        program.write_text(AGENT.format(folder=str(self.folder)))
        usual: dict[str, Any] = {"folder": str(root), "urls": {}, "started_in": str(root)}
        usual |= {"agent": agent or f"command:{sys.executable} {program}", "wall_limit_s": wall_limit_s}
        self.tell(StartAgent(**usual, **more))

    def tell(self, order: ToChild) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(child_messages.line(order))
        self.process.stdin.flush()

    def agent(self) -> int:
        """Its process id, once it runs."""
        deadline = time.monotonic() + TIMEOUT_S
        while not (found := os.listdir(self.folder)):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        return int(found[0])

    def until(self, kind: type[E]) -> E:
        """The next event of a kind."""
        assert self.process.stdout is not None
        for data in self.process.stdout:
            event = child_messages.event_of(data)
            if isinstance(event, kind):
                return event
        raise AssertionError(f"the supervisor ended without {kind.__name__}")

    def holds_its_lock(self) -> bool:
        with self.lock.open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False
