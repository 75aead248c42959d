"""deploy/slurm/worker.sbatch on a real Slurm of one node: workers that are pre-empted in the middle of a run."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import agent, command
from coordinator_harness import Coordinator
from machines.own_certs import free_port
from restless_runs import SIZE, agent_code, assert_same
from waiting import wait_until

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(600)]

SCRIPT = Path(__file__).parents[3] / "deploy" / "slurm" / "worker.sbatch"
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "slurm.md"
PROGRAMS = ("slurmctld", "slurmd", "munged", "mungekey", "sbatch")


class Slurm:
    """One node, with two CPUs as a rule; jobs of the partition `high` pre-empt and requeue those of `low`."""

    def __init__(self, root: Path, cpus: int = 2) -> None:
        self.root = root
        self.processes: list[subprocess.Popen[bytes]] = []
        self.environment = {**os.environ, "SLURM_CONF": str(root / "slurm.conf")}
        name = socket.gethostname().partition(".")[0]
        for folder in ("state", "spool", "run"):
            (root / folder).mkdir()
        munge = root / "run" / "munge.socket"
        (root / "slurm.conf").write_text(f"""
ClusterName=test
SlurmctldHost={name}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={munge},cred_expire=5
StateSaveLocation={root}/state
SlurmdSpoolDir={root}/spool
SlurmctldPidFile={root}/run/slurmctld.pid
SlurmdPidFile={root}/run/slurmd.pid
SlurmctldLogFile={root}/slurmctld.log
SlurmdLogFile={root}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=2,batch_sched_delay=0
SlurmdParameters=config_overrides
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
KillWait=20
NodeName={name} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={cpus * 2048} State=UNKNOWN
PartitionName=low Nodes={name} Default=YES PriorityTier=1 MaxTime=INFINITE State=UP
PartitionName=high Nodes={name} PriorityTier=10 PreemptMode=OFF MaxTime=INFINITE State=UP
""")
        subprocess.run(["mungekey", "--create", f"--keyfile={root}/run/munge.key"], check=True)
        places = [f"--socket={munge}", f"--key-file={root}/run/munge.key", f"--log-file={root}/munged.log"]
        places += [f"--pid-file={root}/run/munged.pid", f"--seed-file={root}/run/munged.seed"]
        self._start("munged", "--foreground", "--force", *places)
        wait_until(munge.exists)
        self._start("slurmctld", "-D")
        self._start("slurmd", "-D", "-N", name)
        wait_until(lambda: "idle" in self.says("sinfo", "--noheader", "--format=%T"), self.diagnostics)

    def _start(self, *words: str) -> None:
        with (self.root / f"{words[0]}.out").open("wb") as out:
            self.processes.append(subprocess.Popen(words, env=self.environment, stdout=out, stderr=out))

    def says(self, *words: str, **more: str) -> str:
        done = subprocess.run(
            words,
            env={**self.environment, **more},
            cwd=self.root,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout + done.stderr

    def diagnostics(self) -> str:
        logs = [*self.root.glob("*.log"), *self.root.glob("*.out")]
        return "\n".join(f"{path.name}: {path.read_text()[-3000:]}" for path in logs)

    def submit(self, *words: str, **more: str) -> str:
        """The id of the job."""
        output = self.says("sbatch", *words, **more)
        found = re.search(r"Submitted batch job (\d+)", output)
        assert found is not None, output
        return found[1]

    def running(self, job: str) -> list[str]:
        """Its running tasks, such as `7_0`."""
        return self.says(
            "squeue", f"--jobs={job}", "--noheader", "--states=R", "--format=%i", "--array"
        ).split()

    def stop(self) -> None:
        self.says("scancel", "--user=root")
        for process in reversed(self.processes):
            process.terminate()
            try:
                process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@pytest.fixture
def slurm(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Slurm]:
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not found: apt-get install slurmctld slurmd slurm-client munge")
    slurm = Slurm(tmp_path, getattr(request, "param", 2))
    try:
        yield slurm
    finally:
        slurm.stop()


def test_a_run_comes_to_the_same_when_array_workers_are_preempted(slurm: Slurm, tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "s", "--hidden-isolation", "off")
    operator, worker = (coordinator.ready["credentials"][role] for role in ("operator", "worker"))
    size = (*SIZE, "--credentials", operator)
    program = agent(tmp_path, agent_code(0.5))

    def play(name: str, disturb: Callable[[], None]) -> None:
        arguments = ("run", "--env", "toy/line", "--agent", program, "--exp-id", name, *size)
        with command(tmp_path, *arguments) as running:
            feedback = f"*/*/{name}/workspace/feedback/"
            wait_until(lambda: [*(tmp_path / "runs").glob(f"{feedback}submit_001*/episodes/ep_*")])
            disturb()
            assert running.wait() == 0, running.text + slurm.diagnostics()

    def take_nodes() -> None:
        """A job of higher priority takes both CPUs for a while, a task is cancelled, another killed outright."""
        slurm.submit("--partition=high", "--ntasks=2", "--output=high.log", "--wrap=sleep 3")
        wait_until(lambda: not slurm.running(workers), slurm.diagnostics)
        first, second = wait_until(lambda: pair(slurm.running(workers)), slurm.diagnostics)
        slurm.says("scancel", first)
        slurm.says("scancel", "--signal=KILL", "--full", second)

    options = {
        "EVOPOLICY_CREDENTIALS": worker,
        "EVOPOLICY_WORKER_OPTIONS": "--env toy --need-tier bwrap",
        "EVOPOLICY_BIN": str(Path(sys.executable).parent),
        "XDG_STATE_HOME": str(tmp_path / "xdg"),
    }
    try:
        small = ("--cpus-per-task=1", "--mem-per-cpu=0")
        workers = slurm.submit("--array=0-9%2", *small, str(SCRIPT), **options)
        play("restless", take_nodes)
        logs = "".join(path.read_text() for path in tmp_path.glob("evopolicy-worker-*.log"))
        assert "draining" in logs, logs[-3000:]
        play("calm", lambda: None)
    finally:
        slurm.says("scancel", "--user=root")
        wait_until(lambda: not slurm.running(workers))
        coordinator.stop()
    assert_same(tmp_path, "restless", "calm")


@pytest.mark.parametrize("slurm", [8], indirect=True)
def test_the_page_runs_as_written(slurm: Slurm, tmp_path: Path) -> None:
    """Its two blocks of commands; FIRST is this machine, and the port is a free one."""
    serving, using = [
        [line.partition(" #")[0].strip() for line in block.splitlines()]
        for block in re.findall(r"^```\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    ]
    home, port = tmp_path / "home", str(free_port())
    home.mkdir(mode=0o700)
    (home / "deploy").symlink_to(SCRIPT.parents[1])
    shown = {"HOME": str(home), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    shown |= {"EVOPOLICY_WORKER_OPTIONS": "--env toy", "XDG_STATE_HOME": str(home / "state")}

    def words(line: str) -> list[str]:
        return ["bash", "-c", f"cd {home} && {line.replace('7447', port).replace('FIRST', '127.0.0.1')}"]

    def says(line: str) -> str:
        done = subprocess.run(
            words(line),
            env=slurm.environment | shown,
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert done.returncode == 0, (line, done.stdout, done.stderr, slurm.diagnostics())
        return done.stdout

    init, serve, issue = serving
    doctor, submit, status = using
    says(init)
    with (tmp_path / "coordinator.out").open("wb") as out:
        line = words(f"exec {serve}")
        coordinator = subprocess.Popen(line, env=slurm.environment | shown, stdout=out, stderr=out)
    try:
        wait_until((home / "state/evopolicy/coordinator/credentials/operator.json").exists, slurm.diagnostics)
        says(issue)
        assert "tier" in says(doctor)
        assert "Submitted batch job" in says(submit)
        # Two of the array's tasks fit on this node.
        wait_until(lambda: says(f"{status} --json").count('"evopolicy-worker-') >= 2, slurm.diagnostics)
        assert "evopolicy-worker-" in says(status)
    finally:
        slurm.says("scancel", "--user=root")
        wait_until(lambda: not slurm.says("squeue", "--noheader"))
        coordinator.terminate()
        coordinator.wait(timeout=60)


def pair(tasks: list[str]) -> list[str]:
    return tasks if len(tasks) == 2 else []
