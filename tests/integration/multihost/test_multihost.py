"""Whole runs over several hosts, and what befalls the network meanwhile: the run is that of one machine, byte for byte.

Coordinator, two workers, a desk with gateway and agent, and a router between them, each in namespaces of its own,
mutual TLS on every link (`sites.py`). What it is compared with is played on the coordinator's host alone.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from machines import hosts
from sites import EPISODES, REAL, SUBMITS, TIMEOUT_S, TOTAL, TOY, Sites, sites

from evopolicy_common.messages.status import StatusReply
from evopolicy_common.records.run_difference import differences

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(900)]

DELAY_S = 0.1
LOSS = 0.01
Command = subprocess.Popen[bytes]
AWAY_S = 4.0
"""Longer than a lease lives here (`fixed_coordinator`)."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Sites]:
    """The hosts with their workers; the runs of one machine are played before these join."""
    hosts.require()
    with contextlib.ExitStack() as stack:
        root = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="evm-", dir="/tmp")))
        made = stack.enter_context(sites(root, stack.enter_context(hosts.network())))
        alone = made.start_worker("coordinator", Path(made.own["worker"]), slots=2)
        for env in (TOY, REAL):
            command = made.begin("coordinator", "alone", env, Path(made.own["operator"]))
            ended_well(made, command, "coordinator", "alone")
        alone.terminate()
        alone.wait(TIMEOUT_S)
        for name in ("one", "two"):
            worker = made.start_worker(name, root / name / "keys")
            made.status_until(partial(is_active, name), worker)
        yield made


def is_active(name: str, reply: StatusReply) -> bool:
    return any(each.worker == name and each.state == "active" for each in reply.workers)


def ended_well(cluster: Sites, command: subprocess.Popen[bytes], host: str, name: str) -> None:
    """Waits for the end of a run's command, which has to be a good one."""
    try:
        code = command.wait(TIMEOUT_S)
    except subprocess.TimeoutExpired:
        pytest.fail(f"did not end by itself: {cluster.log(host, name)}")
    assert code == 0, cluster.log(host, name)


def play(
    cluster: Sites, name: str, env: str = TOY, meanwhile: Callable[[Command], object] | None = None
) -> None:
    """A run from the desk; `meanwhile` happens when a third of its episodes are done. It must be that of one
    machine."""
    before = cluster.status_until(lambda reply: True).episodes_done
    command = cluster.begin("desk", name, env, cluster.root / "desk" / "keys")
    if meanwhile is not None:
        cluster.status_until(lambda reply: reply.episodes_done - before >= TOTAL // 3, command)
        meanwhile(command)
    ended_well(cluster, command, "desk", name)
    folder = cluster.folder("desk", name, env)
    assert differences(cluster.folder("coordinator", "alone", env), folder) == []
    assert json.loads((folder / "run.json").read_text())["outcome"]["budget_used"] == SUBMITS * EPISODES


def test_a_run_over_several_hosts_is_that_of_one_machine(cluster: Sites) -> None:
    play(cluster, "quiet", REAL)


def test_both_workers_are_given_work_and_see_nothing_of_the_coordinators_disk(cluster: Sites) -> None:
    busy: set[str] = set()

    def both(reply: StatusReply) -> bool:
        busy.update(each.worker for each in reply.workers if each.held)
        return busy >= {"one", "two"}

    for name in ("one", "two", "desk", "router"):
        assert cluster.hosts[name].run("ls", "-A", str(cluster.root / "coordinator")) == ""
    play(cluster, "both", meanwhile=lambda command: cluster.status_until(both, command))


def test_a_worker_host_is_unplugged_and_plugged_in_again(cluster: Sites) -> None:
    def unplug(command: Command) -> None:
        cluster.cables["one"].pull()
        time.sleep(AWAY_S)
        cluster.cables["one"].restore()

    play(cluster, "unplugged", meanwhile=unplug)


def test_the_router_host_is_restarted(cluster: Sites) -> None:
    play(cluster, "router", meanwhile=lambda command: cluster.restart_router(AWAY_S))


def test_packets_to_the_coordinator_are_late_and_get_lost(cluster: Sites) -> None:
    def spoil(command: Command) -> None:
        cluster.wire.weather(DELAY_S, LOSS)

    try:
        play(cluster, "weather", meanwhile=spoil)
    finally:
        cluster.wire.weather(0.0, 0.0)
