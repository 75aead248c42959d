"""Hosts on this machine: network, mount and name namespaces, joined by cables that can be pulled and wires that are
bad.

A host is its holder, a process that only sleeps: what runs on the host is started by `nsenter` into the holder's
namespaces, and when the holder is gone and nothing runs there any more, the kernel takes namespaces, devices and routes
away. Holders, and what was started on hosts, are ended with the thread that made them: a test that is killed leaves
nothing.

Root makes the namespaces as it is; other users make them inside a user namespace, where the kernel lets them. `require`
says why not. Call from the main thread.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

_TIMEOUT_S = 60.0
_WIRE = Path(__file__).with_name("bad_wire.py")


def require() -> None:
    """Skips the test that asks where there can be no hosts, and says why and what helps."""
    why = refusal()
    if why is not None:
        pytest.skip(why)


@functools.cache
def refusal() -> str | None:
    """Why there can be no hosts here; None when there can."""
    missing = [tool for tool in ("ip", "unshare", "nsenter", "setpriv") if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} missing: bash deploy/setup-host.sh --tests"
    try:
        with network() as hosts:
            near, far = hosts.host("a"), hosts.host("b")
            hosts.cable(near, "10.92.0.1/30", far, "10.92.0.2/30")
            hosts.wire(near, "10.92.0.5/30", far, "10.92.0.6/30")
    except (AssertionError, OSError, subprocess.CalledProcessError) as error:
        output = getattr(error, "stderr", None) or error
        return (
            f"needs network namespaces, which cannot be made here ({output}): run the tests as root, a container"
            " privileged"
        )
    return None


class Host:
    """A host of a `Network`: its own devices, routes, loopback and mounts, with the machine's files."""

    def __init__(self, name: str, enter: list[str], holder: subprocess.Popen[bytes] | None) -> None:
        self.name = name
        self.enter = enter
        """The words before a command that make it run here, without another process in between."""
        self._holder = holder
        self._started: list[subprocess.Popen[Any]] = []

    @property
    def pid(self) -> int:
        """Of the process that holds the namespaces."""
        assert self._holder is not None
        return self._holder.pid

    def run(self, *command: str) -> str:
        """The output of a command. Raises CalledProcessError, with its stderr as a note, when it fails."""
        try:
            done = subprocess.run(
                [*self.enter, *command], check=True, capture_output=True, text=True, timeout=_TIMEOUT_S
            )
        except subprocess.CalledProcessError as error:
            error.add_note(f"on host {self.name}: {error.stderr.strip()}")
            raise
        return done.stdout

    def start(
        self, command: Sequence[str], log: Path, environment: Mapping[str, str] | None = None
    ) -> subprocess.Popen[bytes]:
        """Starts a program here, in a session of its own, what it says appended to `log`.

        It is sent SIGTERM with the end of the network, or of the thread that started it.
        """
        with log.open("ab") as stream:
            process = subprocess.Popen(
                [*self.enter, "setpriv", "--pdeathsig", "TERM", *command],
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                start_new_session=True,
                env={**os.environ, **(environment or {})},
            )
        self._started.append(process)
        return process

    def hide(self, *folders: Path) -> None:
        """Lays an empty file system over each folder, which belongs to another host's disk."""
        for folder in folders:
            self.run("mount", "-t", "tmpfs", "-o", "mode=700,size=1m", "none", str(folder))

    def route(self, destination: str, via: str) -> None:
        """Packets to `destination` (`default`, or `10.0.2.0/24`) go to the neighbour `via`."""
        self.run("ip", "route", "replace", destination, "via", via)

    def forward(self) -> None:
        """Passes on packets that are not its own: a router."""
        self.run("sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")

    def end_programs(self, timeout_s: float = 20.0) -> None:
        """SIGTERM to all that was started here, SIGKILL to what stays; waited for."""
        for process in self._started:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
        for process in self._started:
            try:
                process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        self._started.clear()


class Cable:
    """A pair of veth devices, one on either host."""

    def __init__(self, ends: Sequence[tuple[Host, str]]) -> None:
        self.ends = tuple(ends)
        """Each host with the name of its device."""

    def pull(self) -> None:
        """Packets vanish, and no connection is told. Near routes through it are lost but that to its own subnet."""
        host, device = self.ends[0]
        host.run("ip", "link", "set", device, "down")

    def restore(self) -> None:
        host, device = self.ends[0]
        host.run("ip", "link", "set", device, "up")


class Wire(Cable):
    """A pair of TUN devices and the program that carries packets between them, late and not all of them."""

    def __init__(self, ends: Sequence[tuple[Host, str]], process: subprocess.Popen[bytes]) -> None:
        super().__init__(ends)
        self._process = process

    def weather(self, delay_s: float, loss: float) -> None:
        """From now on each packet arrives `delay_s` seconds later, either way, but for a share `loss` of them."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{delay_s} {loss}\n".encode())
        self._process.stdin.flush()

    def end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Network:
    """Hosts and what joins them; made by `network`."""

    def __init__(self) -> None:
        self.hosts: list[Host] = []
        self._wires: list[Wire] = []
        self._devices = 0
        self._user: subprocess.Popen[bytes] | None = None
        self._prefix: list[str] = []
        if os.getuid() != 0:
            self._user = _hold(["unshare", "--user", "--map-root-user"], "user")
            self._prefix = ["nsenter", "--user", "--preserve-credentials", "--target", str(self._user.pid)]

    def host(self, name: str) -> Host:
        """A new host that no cable goes to yet; `name` is what it calls itself."""
        holder = _hold([*self._prefix, "unshare", "--net", "--mount", "--uts"], "net")
        user = ["--user", "--preserve-credentials"] if self._prefix else []
        enter = ["nsenter", *user, "--net", "--mount", "--uts", "--wd=.", "--target", str(holder.pid)]
        host = Host(name, enter, holder)
        self.hosts.append(host)
        host.run("hostname", name)
        host.run("ip", "link", "set", "lo", "up")
        return host

    def cable(self, near: Host, near_address: str, far: Host, far_address: str) -> Cable:
        """Joins two hosts; addresses as `10.0.1.1/24`."""
        ends = [(near, self._device("veth")), (far, self._device("veth"))]
        words = ["ip", "link", "add", ends[0][1], "type", "veth", "peer", "name", ends[1][1]]
        near.run(*words, "netns", str(far.pid))
        for (host, device), address in zip(ends, (near_address, far_address), strict=True):
            _bring_up(host, device, address)
        return Cable(ends)

    def wire(self, near: Host, near_address: str, far: Host, far_address: str) -> Wire:
        """Joins two hosts by a line that `Wire.weather` makes bad; good at first. Needs /dev/net/tun."""
        ends = [(near, self._device("tun")), (far, self._device("tun"))]
        process = subprocess.Popen(
            [*near.enter, sys.executable, str(_WIRE), ends[0][1], ends[1][1]],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        wire = Wire(ends, process)
        self._wires.append(wire)
        assert process.stdout is not None
        assert process.stderr is not None
        with process.stdout, process.stderr:
            if process.stdout.readline() != b"ready\n":
                lines = process.stderr.read().decode(errors="replace").strip().splitlines()
                raise AssertionError(f"no TUN device: {lines[-1] if lines else 'no output'}")
        near.run("ip", "link", "set", ends[1][1], "netns", str(far.pid))
        for (host, device), address in zip(ends, (near_address, far_address), strict=True):
            _bring_up(host, device, address)
        return wire

    def close(self) -> None:
        """Ends what was started on the hosts, then the hosts."""
        for host in self.hosts:
            host.end_programs()
        for wire in self._wires:
            wire.end()
        for host in self.hosts:
            assert host._holder is not None
            _let_go(host._holder)
        if self._user is not None:
            _let_go(self._user)

    def _device(self, kind: str) -> str:
        self._devices += 1
        return f"{kind}{self._devices}"


@contextlib.contextmanager
def network() -> Iterator[Network]:
    """A `Network` without hosts; all that it became is gone after the `with`, whatever happened."""
    made = Network()
    try:
        yield made
    finally:
        made.close()


def _bring_up(host: Host, device: str, address: str) -> None:
    host.run("ip", "address", "add", address, "dev", device)
    host.run("ip", "link", "set", device, "up")


def _hold(unshare: list[str], kind: str) -> subprocess.Popen[bytes]:
    """A process that sleeps in new namespaces for as long as this thread lives; AssertionError when it cannot."""
    mine = os.readlink(f"/proc/self/ns/{kind}")
    sleep = ["setpriv", "--pdeathsig", "KILL", "sh", "-c", "echo ready; exec sleep infinity"]
    holder = subprocess.Popen([*unshare, *sleep], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert holder.stdout is not None
    assert holder.stderr is not None
    with holder.stdout, holder.stderr:
        if holder.stdout.readline() != b"ready\n":
            holder.wait()
            raise AssertionError(holder.stderr.read().decode(errors="replace").strip())
    assert os.readlink(f"/proc/{holder.pid}/ns/{kind}") != mine
    return holder


def _let_go(holder: subprocess.Popen[bytes]) -> None:
    holder.kill()
    holder.wait()
