"""The coordinator's machine is lost in the middle of runs, and an earlier backup of its state is started.

A row is a moment of the backup, a later moment of the loss, and how the runs are played: by `run`, by `suite`, or by
`suite` on two hosts of one sweep. Commands that were killed with the machine, or had ended, are given again. Each run
must be its undisturbed twin, opened and begun by its agent once, and no run may be left open at the coordinator.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from coordinator_harness import OperatorClient
from fault_cluster import EPISODES, HIDDEN, SUBMITS, TIMEOUT_S, FaultCluster

from evopolicy_common.errors import TransportError
from evopolicy_common.messages.status import StatusReply, StatusRequest
from evopolicy_common.wire.transport import connect
from evopolicy_coordinator.storage.backup import back_up

MOMENTS = ("before", "alive", "ended", "closed", "scored")
"""Of a run: not opened yet; its agent works; its agent has left and its last submit plays; the agent's side is closed;
the result is written, and so the command has ended."""
PAIRS = tuple(
    f"backup {first}, lost {then}"
    for number, first in enumerate(MOMENTS)
    for then in MOMENTS[max(number, 1) :]
    if first != then or first in ("alive", "scored")
)
KILLED = ", its commands too"
ROWS = (
    *(("run", pair) for pair in PAIRS),
    *(("run", f"backup {first}, lost closed{KILLED}") for first in ("before", "alive", "ended")),
    *((how, f"backup {pair}") for how in ("suite", "two suites") for pair in (
        "before, lost alive", "before, lost scored", "alive, lost closed", "alive, lost scored", "closed, lost scored",
    )),
    *(("suite", f"backup {first}, lost closed{KILLED}") for first in ("before", "alive")),
)  # fmt: skip
OVER_A_CABLE = (
    ("run", "backup alive, lost closed"),
    ("run", "backup before, lost alive"),
    ("two suites", "backup alive, lost scored"),
)
REPEATS = 2
ALIVE_AFTER, ENDED_AFTER = 7, (SUBMITS - 1) * EPISODES + 1
"""Episodes of a run."""
_CREATED = re.compile(r'"run_created".*?"run": ?"([^"]+)"|"run": ?"([^"]+)".*?"run_created"')


class Restored:
    """One row's commands, and their runs."""

    def __init__(self, cluster: FaultCluster, how: str, name: str) -> None:
        self._cluster, self._how, self._name = cluster, how, name
        self._log = cluster.root / "coordinator.log"
        self._logged = self._log.stat().st_size
        self._before = asyncio.run(_status(cluster)).episodes_done
        self.commands: list[subprocess.Popen[str]] = []
        self._errors = [
            cluster.root / f"{name}-{number}.err" for number in range(2 if how == "two suites" else 1)
        ]
        self._sweep = cluster.root / f"{name}.toml"
        self._sweep.write_text(_sweep(name, cluster.agent(leaves=True)))

    def start(self) -> None:
        self.commands = []
        for number, path in enumerate(self._errors):
            with path.open("a") as errors:
                self.commands.append(self._cluster.operator_command(self._arguments(number), errors))

    def _arguments(self, number: int) -> list[str]:
        cluster = self._cluster
        if self._how == "run":
            return cluster.arguments(self._name, leaves=True)
        folder = cluster.runs / (f"{self._name}-{number}" if self._how == "two suites" else self._name)
        return ["suite", str(self._sweep), "--runs", str(folder)]

    def folders(self) -> list[Path]:
        """The run directories that should be there."""
        if self._how == "run":
            return [self._cluster.folder(self._name)]
        found = self._cluster.runs.glob(f"{self._name}*/tester/toy_line/*/run.json")
        return sorted((path.parent for path in found), key=lambda path: path.name)

    def attempts(self) -> list[Path]:
        return list(self._cluster.runs.glob(f"{self._name}*/.attempts/**/workspace"))

    @property
    def running(self) -> bool:
        return any(command.poll() is None for command in self.commands)

    def kill(self) -> None:
        for command in self.commands:
            command.kill()
            command.wait()

    def errors(self) -> str:
        return "\n".join(path.read_text(errors="replace") for path in self._errors)

    def await_end(self) -> list[str]:
        """What is wrong with the commands' ends."""
        deadline = time.monotonic() + TIMEOUT_S
        while self.running and time.monotonic() < deadline:
            time.sleep(0.05)
        if self.running:
            self.kill()
            return [f"did not end within {TIMEOUT_S:g} s: {' | '.join(self.errors().splitlines()[-4:])}"]
        return [
            f"exit status {command.returncode}: {' | '.join(path.read_text().splitlines()[-4:])}"
            for command, path in zip(self.commands, self._errors, strict=True)
            if command.returncode
        ]

    def reached(self, moment: str, status: StatusReply) -> bool:
        done = status.episodes_done - self._before
        if not self.running:
            return True
        match moment:
            case "before":
                return True
            case "alive":
                return done >= ALIVE_AFTER and any(run.phase == "open" for run in status.runs)
            case "ended":
                return done >= ENDED_AFTER and not self._cluster.find("supervisor")
            case "closed":
                return any(run.phase != "open" for run in status.runs)
            case _:
                return False

    def created(self) -> int:
        """Different runs that the coordinators have opened for this row."""
        with self._log.open("rb") as log:
            log.seek(self._logged)
            lines = log.read().decode(errors="replace").splitlines()
        return len({found[1] or found[2] for line in lines if (found := _CREATED.search(line))})


def play(cluster: FaultCluster, how: str, fault: str, name: str, folder: Path) -> tuple[Restored, list[str]]:
    """Plays the row; returns what is wrong with it by itself. `folder`: for the backup."""
    first, then = re.findall(r"backup (\w+), lost (\w+)", fault)[0]
    row = Restored(cluster, how, name)
    if first == "before":
        back_up(cluster.state, folder)
    row.start()
    if first != "before":
        _await(cluster, row, first)
        back_up(cluster.state, folder)
    _await(cluster, row, then, again=first == then)
    again = fault.endswith(KILLED) or not row.running
    if again:
        row.kill()
    cluster.restore(folder)
    if again:
        row.start()
    wrong = row.await_end()
    n = 1 if how == "run" else REPEATS
    if len(row.folders()) != n:
        wrong.append(f"{len(row.folders())} run directories with a result in place of {n}")
    if row.attempts():
        wrong.append(f"begun again: {row.attempts()[0]}")
    if (created := row.created()) != n:
        wrong.append(f"{created} runs were opened in place of {n}")
    deadline = time.monotonic() + 5.0
    while (left := asyncio.run(_status(cluster)).runs) and time.monotonic() < deadline:
        time.sleep(0.1)
    return row, wrong + [f"left at the coordinator: {run.run} ({run.phase})" for run in left]


def _await(cluster: FaultCluster, row: Restored, moment: str, *, again: bool = False) -> None:
    """Returns at the moment; `again`: a little later than the last one of its kind."""
    deadline = time.monotonic() + TIMEOUT_S
    asyncio.run(_until(cluster, lambda status: row.reached(moment, status) or time.monotonic() > deadline))
    if again and moment == "alive":
        more = asyncio.run(_status(cluster)).episodes_done + 2
        asyncio.run(_until(cluster, lambda status: status.episodes_done >= more or not row.running))


async def _until(cluster: FaultCluster, reached: Callable[[StatusReply], bool]) -> None:
    async with connect(cluster.operators) as link:
        client = OperatorClient(link)
        message = StatusRequest(token=client.token)
        while True:
            with contextlib.suppress(TransportError):
                if reached(await client.ask.once("status", message, StatusReply)):
                    return
            await asyncio.sleep(0.01)


async def _status(cluster: FaultCluster) -> StatusReply:
    async with connect(cluster.operators) as link:
        client = OperatorClient(link)
        return await client.ask.until_answered("status", StatusRequest(token=client.token), StatusReply)


def _sweep(name: str, agent: str) -> str:
    return f"""
name = {json.dumps(name)}
environments = ["toy/line"]
[defaults]
budget = {SUBMITS * EPISODES + 1}
repeats = {REPEATS}
validation = {HIDDEN}
heldout = {HIDDEN}
[parallel]
machine = 1
claim_ttl_s = 4.0
[[agents]]
name = "tester"
agent = {json.dumps(agent)}
"""
