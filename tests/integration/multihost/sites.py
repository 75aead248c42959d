"""A cluster over five hosts, and whole runs on it.

    coordinator 10.92.1.2 ──wire── 10.92.1.1 ┐
    desk        10.92.2.2 ──cable─ 10.92.2.1 ├ router: passes packets on; a site's Zenoh router listens on 10.92.4.1
    one         10.92.3.2 ──cable─ 10.92.3.1 │
    two         10.92.4.2 ──cable─ 10.92.4.1 ┘

Each host has a network namespace and a disk (its folder; the others' are hidden from it). The desk, where agents run,
and worker `one` speak to the coordinator over routed TLS; worker `two` speaks to the site's router, which has a
certificate of its own. Every machine's folder comes from `evopolicy-coordinator certs issue`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from coordinator_harness import OperatorClient
from machines.hosts import Host, Network

from evopolicy_common.errors import TransportError
from evopolicy_common.messages.status import StatusReply, StatusRequest, unfolded
from evopolicy_common.wire import credentials
from evopolicy_common.wire.transport import connect

TIMEOUT_S = 240.0
SUBMITS = 3
EPISODES = 6
HIDDEN = 4
TOTAL = SUBMITS * EPISODES + SUBMITS * HIDDEN + 2 * HIDDEN
"""Episodes of a whole run: train, validation of each checkpoint, held-out and the random reference."""
TOY = "toy/line"
REAL = "gym/continuouscar"
NAMES = ("coordinator", "router", "desk", "one", "two")
COORDINATOR = "tls/10.92.1.2:7447"
SITE = "tls/10.92.4.1:7447"
_HERE = Path(__file__).parent
_FAULTS = _HERE.parents[1] / "faults"

AGENT = '''
import json, os, pathlib, urllib.request

POLICY = """
import random, time
class Policy:
    def __init__(self, obs_space, action_space, env_meta): pass
    def reset(self, episode_index): print("episode", episode_index)
    def act(self, obs):
        time.sleep(%r)
        return [random.uniform(-1, 1) * %r]
"""

for number in range(%d):
    pathlib.Path("system/policy.py").write_text(POLICY %% (%r, 0.1 + 0.4 * number))
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"],
        data=json.dumps({"env_instances": list(range(number, number + %d))}).encode(),
        headers={"Idempotency-Key": f"submit-{number}"},
    )
    json.load(urllib.request.urlopen(request))
'''


class Sites:
    """The cluster; made by `sites`."""

    def __init__(self, root: Path, network: Network) -> None:
        self.root = root
        self.network = network
        self.hosts = {name: network.host(name) for name in NAMES}
        router = self.hosts["router"]
        router.forward()
        self.wire = network.wire(router, "10.92.1.1/24", self.hosts["coordinator"], "10.92.1.2/24")
        self.cables = {
            name: network.cable(router, f"10.92.{subnet}.1/24", self.hosts[name], f"10.92.{subnet}.2/24")
            for subnet, name in ((2, "desk"), (3, "one"), (4, "two"))
        }
        for subnet, name in enumerate(("coordinator", "desk", "one", "two"), start=1):
            self.hosts[name].route("default", f"10.92.{subnet}.1")
        for name in NAMES:
            (root / name / "tmp").mkdir(parents=True, mode=0o700)
        for name, host in self.hosts.items():
            host.hide(*(root / other for other in NAMES if other != name))
        self.state = root / "coordinator" / "state"
        self._issue()
        self._start_coordinator()
        self._site_router = self._start_site_router()

    def _issue(self) -> None:
        """Certificates, made on the coordinator's host and carried to the others by hand."""
        self._certs("init", "--host", "10.92.1.2")
        for role, name, *more in (
            ("worker", "one"),
            ("worker", "two", "--connect", SITE),
            ("operator", "desk"),
            ("router", "router", "--host", "10.92.4.1"),
        ):
            folder = self.root / "coordinator" / name
            self._certs("issue", role, name, "--out", str(folder), *more)
        issued = self.root / "coordinator" / "router"
        arguments = ["router-config", "router", "--folder", str(issued), "--state", str(self.state)]
        arguments += ["--listen", SITE, "--admit", "worker/two"]
        self._command(*arguments, "--installed-at", str(self.root / "router" / "keys"))
        for name in NAMES[1:]:
            # Not by the hosts, which do not see each other's disks.
            shutil.move(self.root / "coordinator" / name, self.root / name / "keys")

    def _certs(self, *arguments: str) -> None:
        self._command("certs", *arguments, "--state", str(self.state))

    def _command(self, *arguments: str) -> None:
        self.hosts["coordinator"].run(sys.executable, "-m", "evopolicy_coordinator.cli", *arguments)

    def start(self, name: str, program: list[str], log: str) -> subprocess.Popen[bytes]:
        """Starts a program on the host `name`, with that host's home and temporary folder."""
        folder = self.root / name
        environment = {"HOME": str(folder), "XDG_STATE_HOME": str(folder), "TMPDIR": str(folder / "tmp")}
        return self.hosts[name].start([sys.executable, *program], folder / f"{log}.log", environment)

    def _start_coordinator(self) -> None:
        ready = self.root / "coordinator" / "ready.json"
        program = [str(_FAULTS / "fixed_coordinator.py"), str(self.state), str(ready), COORDINATOR]
        process = self.start("coordinator", program, "coordinator")
        until(ready.exists, process, self.root / "coordinator" / "coordinator.log")
        self.own: dict[str, str] = json.loads(ready.read_text())["credentials"]
        """Credentials files of the coordinator's own machine, by role."""

    def _start_site_router(self) -> subprocess.Popen[bytes]:
        config = self.root / "router" / "keys" / "zenohd.json"
        return self.start("router", [str(_HERE / "site_router.py"), str(config)], "zenoh")

    def start_worker(self, name: str, credentials_at: Path, slots: int = 1) -> subprocess.Popen[bytes]:
        program = [str(_FAULTS / "fixed_worker.py"), "--env", TOY, "--env", REAL, "--slots", str(slots)]
        program += [
            *("--need-tier", "bwrap", "--grace", "1", "--name", name, "--credentials"),
            str(credentials_at),
        ]
        return self.start(name, program, "worker")

    def restart_router(self, away_s: float) -> None:
        """The router's host is off for a while: no packet passes, and its Zenoh router is another when it is back."""
        links = (self.wire, *self.cables.values())
        for link in links:
            link.pull()
        self._site_router.kill()
        self._site_router.wait()
        time.sleep(away_s)
        for link in links:
            link.restore()
        self._site_router = self._start_site_router()

    def begin(self, host: str, name: str, env: str, operators: Path) -> subprocess.Popen[bytes]:
        """Starts a run from this host, with an agent that is installed at the same place everywhere."""
        folder = self.root / host
        agent = self.root / f"{env.replace('/', '_')}.py"
        agent.write_text(AGENT % ("%r", "%r", SUBMITS, 0.004 if env == TOY else 0.0, EPISODES))
        program = ["-m", "evopolicy_gateway.cli", "run", "--env", env]
        program += ["--agent", f"command:{sys.executable} {agent}", "--entry", "tester", "--exp-id", name]
        program += ["--budget", str(SUBMITS * EPISODES), "--validation", str(HIDDEN)]
        program += ["--heldout", str(HIDDEN), "--runs", str(folder / "runs")]
        return self.start(host, [*program, "--credentials", str(operators)], name)

    def folder(self, host: str, name: str, env: str) -> Path:
        return self.root / host / "runs" / "tester" / env.replace("/", "_") / name

    def log(self, host: str, name: str) -> str:
        return (self.root / host / f"{name}.log").read_text(errors="replace")

    def strays(self) -> list[int]:
        """Processes that were started here, or by what was started here."""
        return [pid for pid in map(int, filter(str.isdecimal, os.listdir("/proc"))) if self._is_ours(pid)]

    def _is_ours(self, pid: int) -> bool:
        with contextlib.suppress(OSError):
            readable = Path(f"/proc/{pid}/environ").read_bytes() + Path(f"/proc/{pid}/cmdline").read_bytes()
            return pid != os.getpid() and os.fsencode(self.root) in readable
        return False

    def status_until(
        self, fits: Callable[[StatusReply], bool], process: subprocess.Popen[bytes] | None = None
    ) -> StatusReply:
        """What the coordinator tells an operator at its own machine, once it fits.

        AssertionError when the process ends before, or it takes too long.
        """

        async def ask() -> StatusReply:
            deadline = time.monotonic() + TIMEOUT_S
            async with connect(credentials.read_credentials(Path(self.own["operator"]))) as link:
                client = OperatorClient(link)
                message = StatusRequest(token=client.token)
                while time.monotonic() < deadline:
                    with contextlib.suppress(TransportError):
                        reply = unfolded(await client.ask.once("status", message, StatusReply))
                        if fits(reply):
                            return reply
                    assert process is None or process.poll() is None, "it ended before"
                    await asyncio.sleep(0.02)
            raise AssertionError(f"not within {TIMEOUT_S:g} s")

        return asyncio.run(ask())


def until(condition: Callable[[], bool], process: subprocess.Popen[bytes], log: Path) -> None:
    """Waits for it; AssertionError with the log when the process ends before, or it takes too long."""
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            raise AssertionError(log.read_text(errors="replace"))
        time.sleep(0.05)


@contextlib.contextmanager
def sites(root: Path, network: Network) -> Iterator[Sites]:
    """The cluster inside the `with`, without workers at first; nothing of it is left after it."""
    made = Sites(root, network)
    yield made
    # The coordinator last: workers give back what they hold.
    for host in sorted(made.hosts.values(), key=_last_the_coordinator):
        host.end_programs()
    deadline = time.monotonic() + 20.0
    while (left := made.strays()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not left, f"processes are left: {left}"


def _last_the_coordinator(host: Host) -> int:
    return (*NAMES[2:], "router", "coordinator").index(host.name)
