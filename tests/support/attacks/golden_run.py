"""Whole runs with everything that crosses to a gateway kept, and its memory read: while the agent lives, and when all
hidden episodes are done but the gateway has not yet been let go."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
from commands import process, worker_of
from coordinator_harness import TIMEOUT_S, Coordinator, OperatorClient
from waiting import wait_until

from attacks.leak_search import memory_of
from attacks.wiretap import Wiretap
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.operator import EvaluationPage, RecordedRequest, RunFinished
from evopolicy_common.processes import proc
from evopolicy_common.wire import credentials
from evopolicy_common.wire.transport import connect

N_CASES: dict[str, int] = {"train": 4, "valid": 2, "heldout": 2}
N_SUBMITS = 2
EPISODES = (0, 1)
TAPPED = Path(__file__).with_name("tapped_coordinator.py")
AGENT = """
import json, os, time, urllib.request

for number in range(N_SUBMITS):
    with open("system/policy.py", "w") as file:
        file.write(f'''
# RUN, submit {number}: no other run has played this policy.
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass
    def reset(self, episode_index):
        print("episode", episode_index)
    def act(self, obs):
        return [max(-1.0, min(1.0, {0.7 + number} * float(obs[2] - obs[0])))]
''')
    body = json.dumps({"env_instances": EPISODES}).encode()
    with urllib.request.urlopen(urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=body)) as answer:
        assert json.load(answer)["status"] == "ok"
    open(f"submitted-{number}", "w").close()
    while not os.path.exists(f"go-{number}"):
        time.sleep(0.05)
"""


_tapped = msgspec.msgpack.Decoder(tuple[str, str, bytes])


class Case(msgspec.Struct, frozen=True):
    """One case of a split file."""

    seed: int
    mark: str
    """A text in the case's options that stands nowhere else."""


class GoldenCluster:
    """A tapped coordinator, and a worker behind a wiretap."""

    def __init__(self, root: Path, *options: str, slots: int = 2, worker: tuple[str, ...] = ()) -> None:
        """`options`: more of the coordinator's; `worker`: of the worker's."""
        self.root = root
        self.tap = root / "tap"
        self.leak = root / "leak"
        self.cases = _write_cases(root / "data" / "toy_line")
        self._stack = contextlib.ExitStack()
        options = ("--data", str(root / "data"), "--listen", "tcp/127.0.0.1:0", *options)
        program = (str(TAPPED), str(self.tap), str(self.leak))
        self._coordinator = Coordinator(root / "st", *options, trust_workers=False, program=program)
        self._stack.callback(self._coordinator.stop)
        self.files: dict[str, str] = self._coordinator.ready["credentials"]
        (endpoint,) = [one for one in self._coordinator.ready["endpoints"] if one.startswith("tcp/")]
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self.address = (host, int(port))
        self.worker_tap = Wiretap(*self.address)
        self._stack.callback(self.worker_tap.close)
        through = self.through(self.worker_tap, "worker", root / "worker.json")
        words = ("--env", "toy", "--slots", str(slots), *worker)
        self._stack.enter_context(worker_of(self._coordinator, *words, "--credentials", str(through)))

    def through(self, wiretap: Wiretap, role: credentials.Role, file: Path) -> Path:
        """The role's credentials with the wiretap in the coordinator's place."""
        found = credentials.read_credentials(Path(self.files[role]))
        credentials.write(msgspec.structs.replace(found, endpoints=(wiretap.endpoint,)), file)
        return file

    def crossed(self, part: str) -> list[tuple[str, str, bytes]]:
        """Way, key and payload of every question and answer whose key has that part."""
        data = self.tap.read_bytes()
        found = []
        start = 0
        while start + 4 <= len(data):
            end = start + 4 + int.from_bytes(data[start : start + 4], "big")
            if end > len(data):
                break  # it is being written
            message = _tapped.decode(data[start + 4 : end])
            if part in message[1]:
                found.append(message)
            start = end
        return found

    def ask(self, question: Callable[[OperatorClient], Any]) -> Any:
        """The coordinator's replies to an operator."""

        async def main() -> Any:
            async with connect(credentials.read_credentials(Path(self.files["operator"]))) as link:
                return await question(OperatorClient(link))

        return asyncio.run(asyncio.wait_for(main(), 2 * TIMEOUT_S))

    def close(self) -> None:
        self._stack.close()

    def wait_for(self, condition: Callable[[], object]) -> None:
        wait_until(condition, self._coordinator.log.read_text)

    @contextlib.contextmanager
    def command(self, name: str, *words: str) -> Iterator[subprocess.Popen[bytes]]:
        """`evopolicy run` of that name, with its output in `NAME-log`, until the `with` is left."""
        options = ["run", "--env", "toy/line", "--entry", "e", "--exp-id", name, *words]
        options += ["--runs", str(self.root / "runs")]
        state = {"XDG_STATE_HOME": str(self.root / "xdg")}
        log = self.root / f"{name}-log"
        with process(log, "evopolicy_gateway.cli", *options, cwd=self.root, **state) as running:
            yield running


class GoldenRun:
    """A run to its end, with what was seen on the way.

    Its policies differ from those of all other runs: what a policy came to in another run is not played again.
    """

    def __init__(self, cluster: GoldenCluster, name: str) -> None:
        self.cluster = cluster
        self._closing: list[int] = []
        self.wiretap = Wiretap(*cluster.address, on_sent=self._stop_at_close)
        files = cluster.root / f"{name}-files"
        cluster.through(self.wiretap, "gateway", files / "gateway.json")
        operator = files / "operator.json"
        operator.write_bytes(Path(cluster.files["operator"]).read_bytes())
        operator.chmod(0o600)
        agent = cluster.root / f"{name}-agent.py"
        text = AGENT.replace("N_SUBMITS", str(N_SUBMITS)).replace("EPISODES", json.dumps(list(EPISODES)))
        agent.write_text(text.replace("RUN", name))
        self.folder = cluster.root / "runs" / "e" / "toy_line" / name
        self.workspace = self.folder / "workspace"
        budget = N_SUBMITS * len(EPISODES) + 1
        words = ["--agent", f"command:{sys.executable} {agent}", "--credentials", str(operator)]
        self.log = cluster.root / f"{name}-log"
        with contextlib.ExitStack() as stack:
            stack.callback(self.wiretap.close)
            running = stack.enter_context(cluster.command(name, *words, "--budget", str(budget)))
            stack.callback(self._go_on)
            self._follow(running)

    def _follow(self, process: subprocess.Popen[bytes]) -> None:
        cluster = self.cluster
        self.memory: dict[str, list[bytes]] = {}
        for number in range(N_SUBMITS):
            cluster.wait_for(lambda n=number: self._at_work(process, f"submitted-{n}"))  # type: ignore[misc]
            if number == N_SUBMITS - 1:
                self.gateway = self._process_of(process.pid, b"evopolicy_gateway.cli.serve")
                supervisor = self._process_of(process.pid, b"evopolicy_gateway.agent_supervisor.supervisor")
                for who, pid in (("gateway", self.gateway), ("supervisor", supervisor)):
                    self.memory[f"{who} beside the agent"] = list(memory_of(pid))
            (self.workspace / f"go-{number}").touch()
        # The gateway stands still before its word that the run is over gets away, until all is scored.
        self.finished: RunFinished = cluster.ask(lambda client: client.finished(self.run))
        self.supervisor_outlived_the_run = Path(f"/proc/{supervisor}").exists()
        self.record_came_early = (self.folder / "run.json").exists()
        self.memory["gateway, after the scoring"] = list(memory_of(self.gateway))
        self.found_early = self.read_files()
        self._go_on()
        assert process.wait(timeout=2 * TIMEOUT_S) == 0, self.log.read_text()
        self.gateway_is_gone = not Path(f"/proc/{self.gateway}").exists()
        self.outcomes = {
            name: cluster.ask(lambda client, split=split, index=index: self._outcomes(client, split, index))
            for name, split, index in (
                *((f"validation of submit {number}", "validation", number) for number in range(N_SUBMITS)),
                ("held-out", "heldout", self.finished.best_submit_index),
                ("random reference", "heldout", -1),
            )
        }

    def read_files(self) -> dict[str, bytes]:
        """Every file of the workspace and the logs, by its path in the run's folder."""
        return {
            str(path.relative_to(self.folder)): path.read_bytes()
            for folder in (self.workspace, self.folder / "logs")
            for path in sorted(folder.rglob("*"))
            if path.is_file() and not path.is_symlink()
        }

    @property
    def run(self) -> str:
        """The coordinator's id of the run."""
        intended = self.folder / ".gateway" / "intended.json"
        if intended.exists() and (run := json.loads(intended.read_bytes()).get("run")):
            self._run = str(run)
        return self._run

    def _at_work(self, process: subprocess.Popen[bytes], file: str) -> bool:
        assert process.poll() is None, self.log.read_text()
        return (self.workspace / file).exists()

    def _process_of(self, parent: int, module: bytes) -> int:
        (found,) = [
            pid for pid in proc.descendants(parent) if module in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        return found

    def _stop_at_close(self, data: bytes) -> None:
        if b"close_run" in data and not self._closing:
            os.kill(self.gateway, signal.SIGSTOP)
            self._closing.append(self.gateway)

    def _go_on(self) -> None:
        while self._closing and self._closing[0]:
            os.kill(self._closing[0], signal.SIGCONT)
            self._closing[0] = 0

    async def _outcomes(self, client: OperatorClient, split: Split, index: int) -> list[EpisodeOutcome]:
        outcomes: list[EpisodeOutcome] = []
        cursor, finished = 0, False
        while not finished:
            message = RecordedRequest(
                token=client.token, run=self.run, split=split, submit_index=index, cursor=cursor
            )
            page = await client.ask.until_answered("recorded", message, EvaluationPage)
            outcomes += page.outcomes
            cursor, finished = page.cursor, page.finished
        return outcomes


def _write_cases(folder: Path) -> dict[str, tuple[Case, ...]]:
    folder.mkdir(parents=True)
    rng = random.Random(20260)
    found: dict[str, tuple[Case, ...]] = {}
    for split, n in N_CASES.items():
        cases = tuple(
            Case(rng.randrange(2**30, 2**31), f"{split}-{rng.randbytes(9).hex()}") for _ in range(n)
        )
        listed = [{"seed": case.seed, "options": {"mark": case.mark}} for case in cases]
        document = {"env": "toy/line", "split": split, "cases": listed, "secret": True}
        (folder / f"{split}.json").write_text(json.dumps(document))
        found[split] = cases
    return found
