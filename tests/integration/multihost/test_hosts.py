"""The hosts that the tests beside this one stand on: packets go where they should, and nothing is left over."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from machines import hosts
from machines.hosts import Host, Network

pytestmark = pytest.mark.system

PEER = """
import socket, sys
with socket.create_server((sys.argv[1], 7000)) as server:
    while True:
        peer, _ = server.accept()
        with peer:
            while data := peer.recv(65536):
                peer.sendall(data)
"""
ASK = """
import socket, sys, time
for attempt in range(600):
    try:
        peer = socket.create_connection((sys.argv[1], 7000))
        break
    except ConnectionRefusedError:
        time.sleep(0.05)
sent = bytes(range(256)) * 400
peer.sendall(sent)
peer.shutdown(socket.SHUT_WR)
heard = b""
began = time.monotonic()
while data := peer.recv(65536):
    heard += data
assert heard == sent
print(time.monotonic() - began)
"""
MAKER = """
import pathlib, sys, time
from machines import hosts
with hosts.network() as network:
    host = network.host("a")
    log = pathlib.Path(sys.argv[1])
    program = host.start(["sh", "-c", "echo up; exec sleep 1000"], log)
    while not log.read_text():
        time.sleep(0.01)
    print(host.pid, program.pid, flush=True)
    time.sleep(1000)
"""


@pytest.fixture
def network() -> Iterator[Network]:
    hosts.require()
    with hosts.network() as made:
        yield made


def ask(host: Host, address: str) -> float:
    """Seconds until 100 KB have come back whole."""
    return float(host.run(sys.executable, "-c", ASK, address))


def test_hosts_reach_each_other_over_a_lossy_wire(network: Network, tmp_path: Path) -> None:
    near, router, far = (network.host(name) for name in ("near", "router", "far"))
    network.cable(router, "10.92.1.1/24", near, "10.92.1.2/24")
    wire = network.wire(router, "10.92.2.1/24", far, "10.92.2.2/24")
    router.forward()
    near.route("default", "10.92.1.1")
    far.route("default", "10.92.2.1")
    far.start([sys.executable, "-c", PEER, "10.92.2.2"], tmp_path / "log")
    ask(near, "10.92.2.2")
    wire.weather(0.05, 0.01)
    # No answer can come before one packet there and one back.
    assert ask(near, "10.92.2.2") >= 0.1
    assert near.run("hostname").strip() == "near"


def test_a_pulled_cable_carries_nothing_until_it_is_restored(network: Network, tmp_path: Path) -> None:
    near, far = network.host("near"), network.host("far")
    cable = network.cable(near, "10.92.1.1/24", far, "10.92.1.2/24")
    far.start([sys.executable, "-c", PEER, "10.92.1.2"], tmp_path / "log")
    ask(near, "10.92.1.2")
    cable.pull()
    with pytest.raises(subprocess.CalledProcessError):
        ask(near, "10.92.1.2")
    cable.restore()
    ask(near, "10.92.1.2")


def test_a_hosts_disk_is_hidden_from_another(network: Network, tmp_path: Path) -> None:
    (tmp_path / "secret").touch()
    host = network.host("a")
    host.hide(tmp_path)
    assert host.run("ls", "-A", str(tmp_path)) == ""
    assert (tmp_path / "secret").exists()


def test_a_maker_that_is_killed_leaves_nothing(tmp_path: Path) -> None:
    hosts.require()
    maker = subprocess.Popen(
        [sys.executable, "-c", MAKER, str(tmp_path / "log")],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(hosts.__file__).parents[1])},
    )
    with maker:
        assert maker.stdout is not None
        pids = [int(word) for word in maker.stdout.readline().split()]
        assert len(pids) == 2
        maker.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 60
    while any(is_running(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(is_running(pid) for pid in pids)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
