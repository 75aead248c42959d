"""A cluster of real processes that is kept up as an init system would, whole runs on it, and its processes by kind.

This process is their subreaper: what any of them leaves behind becomes its child, so that nothing can hide. It runs in
mount and network namespaces of its own (`enter_namespaces`): the coordinator's state lies in a small file system, and a
worker can be put on a host of its own behind a cable.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

from coordinator_harness import OperatorClient
from cryptography.fernet import Fernet
from host_faults import Cable, Clock, Disks
from machines.own_processes import only_what_starts_inside
from machines.postgres import Server
from machines.weak_link import WeakLink

from evopolicy_common.messages import operator
from evopolicy_common.processes import proc
from evopolicy_common.wire import credentials
from evopolicy_common.wire.transport import connect
from evopolicy_coordinator.storage.engines import connect as connect_to_database
from evopolicy_gateway.processes import trees as processes

if TYPE_CHECKING:
    from machines.seaweedfs import ObjectStore

SUBMITS = 3
EPISODES = 6
HIDDEN = 4
TOTAL = SUBMITS * EPISODES + SUBMITS * HIDDEN + 2 * HIDDEN
"""Episodes of a whole run: train, validation of each checkpoint, held-out and the random reference."""
TIMEOUT_S = 100.0
PORT = 7447
DISK_BYTES = 512 << 20
"""Of each file system: the coordinator's state is on one, the run directories on another."""
KINDS = {
    "slot": ("python", "evopolicy_worker.episodes.env_process"),
    "slot's jail": ("bwrap", "evopolicy_worker.episodes.env_process"),
    "policy's jail": ("bwrap", "zygote.py"),
    "zygote": ("python", "zygote.py"),
    "policy": ("python", "zygote.py"),
    "gateway": ("python", "evopolicy_gateway.cli.serve"),
    "supervisor": ("python", "evopolicy_gateway.agent_supervisor.supervisor"),
}
"""Words of a process's program, and of its command line."""
ZYGOTE_DEPTH = 2 if os.geteuid() == 0 else 0
Site = Literal[
    "one host",
    "two hosts",
    "relay",
    "clock that jumps",
    "bad disks",
    "two coordinators",
    "leader on a machine of its own",
    "object store",
]
"""One host: worker and coordinator by a unix socket that `WeakLink` passes on. Two hosts: by TCP over a cable. Relay:
all by TCP that `WeakLink` passes on, gateways and commands too. Two coordinators: on one PostgreSQL database, and all
know both by TCP; the first one may be on a machine of its own, at the end of a cable. Object store: one host, whose
coordinator has its blobs in an S3 service."""

AGENT = '''
import http.client, json, os, pathlib, sys, time, urllib.error, urllib.request

POLICY = """
import random, time
class Policy:
    def __init__(self, obs_space, action_space, env_meta): pass
    def reset(self, episode_index): print("episode", episode_index)
    def act(self, obs):
        time.sleep(0.001)
        return [random.uniform(-1, 1) * %%r]
"""

def submit(ids, key, how):
    while True:
        request = urllib.request.Request(
            os.environ["EVOPOLICYGYM_SUBMIT_URL"] + how,
            data=json.dumps({"env_instances": ids}).encode(),
            headers={"Idempotency-Key": key},
        )
        try:
            with urllib.request.urlopen(request) as answer:
                return json.load(answer)
        except (OSError, ValueError, http.client.HTTPException):
            time.sleep(0.1)

if %r:
    with open("starts.txt", "a") as starts:
        starts.write("started\\n")
for number in range(%d):
    while True:
        try:
            pathlib.Path("system/policy.py").write_text(POLICY %% (0.1 + 0.4 * number))
            break
        except OSError:
            time.sleep(0.1)
    last = %r and number == %d
    submit(list(range(number, number + %d)), f"submit-{number}", "?wait=false" if last else "")
'''
"""An agent that submits several times. One that leaves notes each start of it, and ends while its last submit plays."""


def _agent(leaves: bool) -> str:
    return AGENT % (leaves, SUBMITS, leaves, SUBMITS - 1, EPISODES)


class Kept:
    """A program that is started again whenever it dies."""

    def __init__(self, program: list[str], log: Path, environment: Mapping[str, str]) -> None:
        self._program = program
        self._log = log
        self._environment = {**os.environ, **environment}
        self._ending = False
        self._lock = threading.Lock()
        self.starts = 0
        self._start()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def _start(self) -> None:
        with self._log.open("ab") as log:
            self.process = subprocess.Popen(
                self._program, stdout=log, stderr=log, start_new_session=True, env=self._environment
            )
        self.starts += 1

    def _keep(self) -> None:
        while True:
            self.process.wait()
            time.sleep(0.2)
            with self._lock:
                if self._ending:
                    return
                if self.process.poll() is not None:
                    self._start()

    def replaced(self, meanwhile: Callable[[], None]) -> None:
        """Kills it, and starts it once `meanwhile` has returned."""
        with self._lock:
            self.process.kill()
            self.process.wait()
            meanwhile()
            self._start()

    def end(self) -> None:
        self._ending = True
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process.pid, signal.SIGCONT)
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._thread.join()


class FaultCluster:
    """Coordinator and workers with two slots each, kept up, at one of the `Site`s."""

    def __init__(self, root: Path, site: Site, stack: contextlib.ExitStack, workers: int = 1) -> None:
        """What is started here ends with the stack, also when not all of it can be started."""
        self.root = root
        root.mkdir(exist_ok=True)
        self.state = root / "state"
        self.runs = root / "runs"
        for folder in (self.state, self.runs):
            folder.mkdir(mode=0o700)
            subprocess.run(
                ["mount", "-t", "tmpfs", "-o", f"mode=700,size={DISK_BYTES}", "none", folder], check=True
            )
            stack.callback(subprocess.run, ["umount", "--lazy", folder], check=True)
        self.clock = Clock(root) if site == "clock that jumps" else None
        # Of their own, so that what is left there is theirs.
        self.temporary = root / "tmp"
        self.temporary.mkdir()
        self._environment = {"TMPDIR": str(self.temporary)}
        if self.clock is not None:
            self._environment |= self.clock.environment
        self.disks = Disks(root, (self.state, self.runs)) if site == "bad disks" else None
        if self.disks is not None:
            self._environment |= self.disks.environment
        apart = site == "leader on a machine of its own"
        self.cable = Cable() if site == "two hosts" or apart else None
        if self.cable is not None:
            stack.callback(self.cable.close)
        self._ready = root / "ready.json"
        launcher = Path(__file__).with_name("fixed_coordinator.py")
        coordinator = [sys.executable, str(launcher), str(self.state), str(self._ready)]
        if site in ("two hosts", "relay"):
            # Of a network namespace of our own, so the port is free, and the same when it is started again.
            coordinator.append(f"tcp/{Cable.NEAR if self.cable is not None else '127.0.0.1'}:{PORT}")
        self.server: Server | None = None
        self.standby: Kept | None = None
        more: dict[str, str] = {}
        if site == "two coordinators" or apart:
            self.server = Server(net=f"{Cable.FAR}/32" if apart else "")
            stack.callback(self.server.close)
            self.database = self.server.new()
            key = root / "seal-key"
            key.touch(mode=0o600)
            key.write_bytes(Fernet.generate_key())
            self._environment |= {"PGPASSFILE": str(self.server.passfile), "FAULTS_SEAL_KEY": str(key)}
            near, far = (Cable.NEAR, Cable.FAR) if apart else ("127.0.0.1", "127.0.0.1")
            coordinator.append(f"tcp/{far}:{PORT}")
            # A folder that both machines mount.
            self._environment |= {"FAULTS_BLOBS": str(root / "blobs")}
            more = {"FAULTS_STORE": f"{self.database.replace('127.0.0.1', near)}?application_name=first"}
            if self.cable is not None:
                coordinator = [*self.cable.at_its_far_end, *coordinator]
        self.objects: ObjectStore | None = None
        if site == "object store":
            from machines.seaweedfs import ObjectStore

            self.objects = ObjectStore()
            stack.callback(self.objects.close)
            more = {"FAULTS_BLOBS": self.objects.new(), **self.objects.keys}
        self.coordinator = Kept(coordinator, root / "coordinator.log", self._environment | more)
        stack.callback(self.coordinator.end)
        deadline = time.monotonic() + TIMEOUT_S
        while not self._ready.exists():
            assert time.monotonic() < deadline, (root / "coordinator.log").read_text()
            time.sleep(0.02)
        ready = json.loads(self._ready.read_text())
        self.files: dict[str, str] = ready["credentials"]
        self.link: WeakLink | None = None
        if self.server is not None:
            other = root / "standby"
            other.mkdir(mode=0o700)
            program = [sys.executable, str(launcher), str(other), str(root / "standby.json")]
            program.append(f"tcp/127.0.0.1:{PORT + 1}")
            more = {"FAULTS_STORE": f"{self.database}?application_name=second"}
            self.standby = Kept(program, root / "standby.log", self._environment | more)
            stack.callback(self.standby.end)
            self._reach(f"tcp/{far}:{PORT}", f"tcp/127.0.0.1:{PORT + 1}")
        if site == "relay":
            port = int(ready["endpoints"][-1].rpartition(":")[2])
            self.link = WeakLink(("127.0.0.1", 0), ("127.0.0.1", port))
            stack.callback(self.link.close)
            self._reach(f"tcp/127.0.0.1:{self.link.port}")
        worker = [sys.executable, str(launcher.with_name("fixed_worker.py"))]
        worker += ["--env", "toy/*", "--slots", "2", "--need-tier", "bwrap"]
        worker += ["--grace", "1", "--credentials", self.files["worker"]]
        if self.cable is not None and not apart:
            worker = [*self.cable.at_its_far_end, *worker, "--connect", ready["endpoints"][-1]]
        elif self.link is None and self.server is None:
            self.link = WeakLink(root / "link.sock", self.state / "coordinator.sock")
            stack.callback(self.link.close)
            worker += ["--connect", f"unixsock-stream/{root / 'link.sock'}"]
        self.workers = []
        for name, log in (("w", "worker.log"), ("v", "worker-2.log"))[:workers]:
            self.workers.append(Kept([*worker, "--name", name], root / log, self._environment))
            stack.callback(self.workers[-1].end)
        self.afterwards: list[operator.CancelRun] = []
        """What the coordinator is to be told once a fault is over."""
        self._agents = {False: root / "agent.py", True: root / "leaving_agent.py"}
        for leaves, path in self._agents.items():
            path.write_text(_agent(leaves))

    def _reach(self, *endpoints: str) -> None:
        """All roles reach the coordinator there alone."""
        folder = self.root / "credentials"
        folder.mkdir(mode=0o700)
        for role, path in self.files.items():
            found = json.loads(Path(path).read_text())
            self.files[role] = str(folder / Path(path).name)
            Path(self.files[role]).touch(mode=0o600)
            Path(self.files[role]).write_text(json.dumps(found | {"endpoints": endpoints}))

    @property
    def operators(self) -> credentials.Credentials:
        return credentials.read_credentials(Path(self.files["operator"]))

    def command(self, name: str) -> subprocess.Popen[str]:
        """A run that has been started, or after its command was killed: that is gone on with."""
        self.run = self.operator_command(self.arguments(name))
        return self.run

    def arguments(self, name: str, *, leaves: bool = False) -> list[str]:
        arguments = ["run", "--env", "toy/line", "--agent", self.agent(leaves)]
        # One that leaves does so before its budget is spent: else either could end the run.
        budget = SUBMITS * EPISODES + leaves
        arguments += ["--entry", "tester", "--exp-id", name, "--budget", str(budget), "--resume"]
        return [*arguments, "--validation", str(HIDDEN), "--heldout", str(HIDDEN), "--runs", str(self.runs)]

    def agent(self, leaves: bool = False) -> str:
        """As `--agent` takes it."""
        return f"command:{sys.executable} {self._agents[leaves]}"

    def restore(self, backup: Path) -> None:
        """The coordinator is killed, its state lost, and another one started on the backup."""

        def replace() -> None:
            self._lose_disk()
            shutil.copytree(backup, self.state, dirs_exist_ok=True)
            self.state.chmod(0o700)

        self.coordinator.replaced(replace)

    def _lose_disk(self) -> None:
        for path in self.state.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def lose_machine(self) -> float:
        """The first coordinator's machine is lost: network, process, and disk at once. When the standby leads, a new
        machine with an empty disk comes instead, and takes the lead later. Returns the seconds without a leader."""
        assert self.cable is not None
        assert self.standby is not None
        cable, without_s = self.cable, 0.0
        deadline = time.monotonic() + TIMEOUT_S
        while self.leader() is not self.coordinator:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        lost_at = time.monotonic()

        def replace() -> None:
            nonlocal without_s
            self._lose_disk()
            while not self._lead().get("second"):
                assert time.monotonic() < lost_at + TIMEOUT_S
                time.sleep(0.05)
            without_s = time.monotonic() - lost_at
            cable.far_end("up")

        cable.far_end("down")
        self.coordinator.replaced(replace)
        assert self.leader() is self.standby
        os.kill(self.standby.process.pid, signal.SIGKILL)
        return without_s

    def operator_command(
        self, arguments: list[str], stderr: int | IO[str] = subprocess.PIPE
    ) -> subprocess.Popen[str]:
        """`evopolicy` with these arguments and the operator's credentials."""
        return subprocess.Popen(
            [
                *(sys.executable, "-m", "evopolicy_gateway.cli", *arguments),
                *("--credentials", self.files["operator"]),
            ],
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            text=True,
            cwd=self.root,
            env={**os.environ, **self._environment},
        )

    async def tell_afterwards(self) -> None:
        actions, self.afterwards = self.afterwards, []
        if actions:
            async with connect(self.operators) as link:
                ask = OperatorClient(link).ask
                for message in actions:
                    await ask.until_answered("cancel", message, operator.Done)

    def folder(self, name: str) -> Path:
        return self.runs / "tester" / "toy_line" / name

    def find(self, kind: str) -> list[int]:
        """Processes of that kind now, in order of their ids."""
        if kind == "leader":
            leader = self.leader()
            return [] if leader is None else [leader.process.pid]
        if kind == "coordinator":
            return [self.coordinator.process.pid]
        if kind == "worker":
            return [worker.process.pid for worker in self.workers]
        if kind == "run":
            return [] if self.run.poll() is not None else [self.run.pid]
        program, wanted = KINDS[kind]
        lines = {pid: command_line(pid) for pid in proc.descendants(os.getpid())}
        found = [pid for pid, line in lines.items() if wanted in line and program in line.partition(" ")[0]]
        if kind in ("zygote", "policy"):
            # As root the zygote has two processes above it that wait for it; a policy's is one of its own, below it.
            depths = {pid: depth(pid, found) for pid in found}
            found = [pid for pid in found if (depths[pid] == ZYGOTE_DEPTH + 1) == (kind == "policy")]
        return found

    def leader(self) -> Kept | None:
        """Of two coordinators on one database, the one that leads, once the other one waits."""
        deadline = time.monotonic() + TIMEOUT_S
        while sorted((known := self._lead()).values()) != [False, True]:
            assert time.monotonic() < deadline, known
            time.sleep(0.05)
        return self.coordinator if known["first"] else self.standby

    def _lead(self) -> dict[str, bool]:
        """Whether each of the coordinators on the database leads."""
        assert self.server is not None
        address = f"{self.database}?passfile={self.server.passfile}"
        with contextlib.closing(connect_to_database(address, "ro", 10.0)) as db:
            return dict(db.coordinators())

    def strays(self) -> list[str]:
        """What lives below this process beside the coordinator, the worker and what the worker's slots need."""
        here = os.getpid()
        kept = {self.coordinator.process.pid, *self.find("worker")}
        if self.server is not None and self.standby is not None:
            kept |= {self.standby.process.pid, self.server.process.pid}
            kept |= set(proc.descendants(self.server.process.pid))
        if self.objects is not None:
            kept.add(self.objects.process.pid)
        if self.cable is not None:
            kept.add(self.cable.holder.pid)
        of_workers = {pid for worker in self.find("worker") for pid in proc.descendants(worker)}
        found = [pid for pid in proc.descendants(here) if pid not in kept | of_workers]
        slots = self.find("slot")
        words = [f"{pid}: {command_line(pid)[:120]}" for pid in found if command_line(pid)]
        return words + ([f"{len(slots)} slot processes"] if len(slots) > 2 * len(self.workers) else [])


@contextlib.contextmanager
def fault_cluster(root: Path, site: Site = "one host", workers: int = 1) -> Iterator[FaultCluster]:
    """The cluster inside the `with`; everything that was started there is gone after it."""
    with only_what_starts_inside(), contextlib.ExitStack() as stack:
        processes.become_subreaper()
        stack.callback(processes.end_descendants, 0.0)
        yield FaultCluster(root, site, stack, workers)


def depth(pid: int, among: Collection[int]) -> int:
    """How many of the processes above it, one after another, are among these."""
    n = 0
    while (pid := parent(pid)) in among:
        n += 1
    return n


def parent(pid: int) -> int:
    """0 for a process that is gone."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def command_line(pid: int) -> str:
    """Empty for a process that is gone or a zombie."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
    except OSError:
        return ""


def record(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return found
