"""A cluster to be cheated: a coordinator and a worker with something listening beside them, on this machine alone."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import socket
import sys
import sysconfig
import threading
from pathlib import Path
from typing import Any

from commands import evopolicy, worker_of
from coordinator_harness import Coordinator

from evopolicy_common.records.run_record import RunRecord, decode_run_record

TIMEOUT_S = 120.0
SECRET = "the operator's own"
AGENT = Path(__file__).parents[2] / "conformance" / "cheats" / "programs" / "cheating_agent.py"


class Listener:
    """A server that nobody has business with: says hello to whoever comes, and remembers them."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        self._tcp = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._tcp.getsockname()[1]
        self.abstract = f"evopolicy-test-{os.getpid()}-{self.port}"
        self._unix = socket.socket(socket.AF_UNIX)
        self._unix.bind("\0" + self.abstract)
        self._unix.listen()
        both = (self._tcp, self._unix)
        self._threads = [threading.Thread(target=self._accept, args=(sock,)) for sock in both]
        for thread in self._threads:
            thread.start()

    def _accept(self, sock: socket.socket) -> None:
        while True:
            try:
                peer, _ = sock.accept()
            except OSError:
                return
            with peer:
                peer.settimeout(0.5)
                try:
                    peer.sendall(b"hello")
                    self.heard.append(peer.recv(2000).decode("latin-1"))
                except OSError:
                    self.heard.append("")

    def close(self) -> None:
        for sock in (self._tcp, self._unix):
            sock.shutdown(socket.SHUT_RDWR)
            sock.close()
        for thread in self._threads:
            thread.join()


def _log_in() -> None:
    """Gives this process, and all that it starts, a session keyring with a key of the operator's, as a login does."""
    libc = ctypes.CDLL(None, use_errno=True)
    add_key, keyctl = (248, 250) if os.uname().machine == "x86_64" else (217, 219)
    libc.syscall(keyctl, 1, None)
    assert libc.syscall(add_key, b"user", b"evopolicy-operator", SECRET.encode(), len(SECRET), -3) > 0


class Cheated:
    """The cluster, its operator's folder, and what an agent may be after."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.home = root / "home"
        self.home.mkdir()
        (self.home / "notes").write_text(SECRET)
        self.state = root / "state"
        self.runs = root / "runs"
        other = self.runs / "other" / "toy_line" / "t" / "checkpoints"
        other.mkdir(parents=True)
        (other / "policy.py").write_text(SECRET)
        self.other_run = other / "policy.py"
        own = {"HOME": str(self.home), "XDG_STATE_HOME": str(root / "xdg"), "OPERATORS_SECRET": SECRET}
        self.environment = {**os.environ, **own}
        _log_in()
        self._stack = contextlib.ExitStack()
        # Runs of one environment stand beside each other here, and one is scored while another's agent listens.
        options = ("--hidden-isolation", "off")
        coordinator = Coordinator(self.state, *options, trust_workers=False, **self.environment)
        self._stack.callback(coordinator.stop)
        self.coordinator = coordinator.process
        self.credentials: dict[str, str] = coordinator.ready["credentials"]
        options = ("--env", "toy", "--need-tier", "bwrap")
        self._stack.enter_context(worker_of(coordinator, *options, **self.environment))
        self.listener = Listener()
        self._stack.callback(self.listener.close)

    def targets(self) -> dict[str, Any]:
        (sock,) = self.state.glob("*.sock")
        return {
            "state": str(self.state),
            "operator": self.credentials["operator"],
            "socket": str(sock),
            "pid": self.coordinator.pid,
            "runs": str(self.runs),
            "other_run": str(self.other_run),
            "home": str(self.home / "notes"),
            "port": self.listener.port,
            "abstract": self.listener.abstract,
            "site": sysconfig.get_path("platlib"),
            "python": sys.executable,
        }

    def play(self, agent: str, exp_id: str, *options: str) -> tuple[int, str, Path]:
        """Plays a run: exit code, what the command said, and the run's folder."""
        words = ["run", "--env", "toy/line", "--agent", agent, "--entry", "e", "--exp-id", exp_id]
        words += ["--credentials", self.credentials["operator"]]
        words += ["--budget", "4", "--validation", "2", "--heldout", "2", "--runs", str(self.runs)]
        done = evopolicy(self.root, *words, *options, **self.environment)
        return done.returncode, done.stdout + done.stderr, self.runs / "e" / "toy_line" / exp_id

    def close(self) -> None:
        self._stack.close()


class CheatingRun:
    """The result of a cheating agent."""

    def __init__(self, cheated: Cheated, name: str, *options: str) -> None:
        before = len(cheated.listener.heard)
        words = f"command:{sys.executable} {AGENT} '{json.dumps(cheated.targets())}'"
        code, output, self.folder = cheated.play(words, name, *options)
        assert code == 0, output
        self.report: dict[str, Any] = json.loads((self.folder / "workspace" / "report.json").read_text())
        self.record: RunRecord = decode_run_record((self.folder / "run.json").read_bytes())
        self.heard = cheated.listener.heard[before:]
