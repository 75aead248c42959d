"""Several faults at once, at random: `fault_matrix.py --chaos SECONDS`.

Processes of every role are killed, or stopped for a while, by a Poisson process that hits up to three at a time.
Meanwhile a coordinator, two workers and operators' commands play single runs and sweeps, several at once, over and
over. A command that was killed is given again. Every run must be that of its undisturbed twin, up to the published
list, its budget spent to the episode; afterwards no process, no folder and no semaphore may be left over, and no log
may hold a traceback.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

from fault_cluster import EPISODES, HIDDEN, SUBMITS, FaultCluster, command_line, fault_cluster, record

from evopolicy_common.processes import proc, scratch
from evopolicy_common.records.run_difference import differences

EVERY_S = 2.5
"""Mean time between two strikes, on a machine that does nothing else."""
AT_ONCE = (0.6, 0.3, 0.1)
"""How likely one, two, three processes are hit by a strike."""
KILLED = 0.6
LONGEST_STOP_S = 6.0
"""Longer than a lease lives in `fixed_coordinator`."""
ROLES = {
    "coordinator": 2,
    "worker": 3,
    "slot": 4,
    "slot's jail": 2,
    "policy's jail": 3,
    "zygote": 3,
    "policy": 5,
    "gateway": 3,
    "supervisor": 1,
    "command": 1,
}
"""What is hit, and how often by comparison. Never an agent: what becomes of a run without it is another run."""
ENOUGH = 200
"""Strikes of which some hit every role."""
TIMEOUT_S = 600.0
CALM_S = 15.0
"""For what was killed last to be taken up again."""
ENVIRONMENTS = ("toy/line", "toy/maze")
AGENTS = ("first", "second")
SEMAPHORES = "/dev/shm/sem.mp-*"

Tell = Callable[[str], None]


def slowness() -> float:
    """How much longer all takes here than on a machine that does nothing else; from 1.

    Rounds are hit as often, by their own measure, and are as patient: what is killed before it has started comes to no
    end.
    """
    return max(1.0, os.getloadavg()[0] / (2 * (os.cpu_count() or 1)))


class Chaos:
    """The faults: a thread that strikes until it is ended."""

    def __init__(self, cluster: FaultCluster, seed: int, diary: Path) -> None:
        self._cluster = cluster
        self._random = random.Random(f"chaos {seed}")
        self._diary = diary.open("w")
        self._end = threading.Event()
        self._stopped: list[threading.Timer] = []
        self._began = time.monotonic()
        self.commands: dict[str, subprocess.Popen[str]] = {}
        self.struck: Counter[str] = Counter()
        self.killed: set[int] = set()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Strikes no more; what is stopped goes on."""
        self._end.set()
        self._thread.join()
        for timer in self._stopped:
            timer.join()
        self._diary.close()

    def _run(self) -> None:
        while not self._end.wait(self._random.expovariate(1 / EVERY_S) * slowness()):
            (n,) = self._random.choices((1, 2, 3), AT_ONCE)
            for role in self._random.choices(list(ROLES), list(ROLES.values()), k=n):
                self._strike(role)

    def _strike(self, role: str) -> None:
        which, kills, stop_s = self._random.random(), self._random.random() < KILLED, self._random.random()
        pids = self._pids(role)
        if not pids:
            return
        pid = pids[int(which * len(pids))]
        line = command_line(pid)[-80:]
        try:
            os.kill(pid, signal.SIGKILL if kills else signal.SIGSTOP)
        except ProcessLookupError:
            return
        how = "SIGKILL" if kills else "SIGSTOP"
        if kills:
            self.killed.add(pid)
        else:
            timer = threading.Timer(stop_s**2 * LONGEST_STOP_S, _go_on, (pid,))
            timer.start()
            self._stopped.append(timer)
        self.struck[f"{role} {how}"] += 1
        entry = {
            "at_s": round(time.monotonic() - self._began, 2),
            "clock": time.strftime("%H:%M:%S", time.gmtime()),
            "role": role,
            "how": how,
            "stop_s": None if kills else round(stop_s**2 * LONGEST_STOP_S, 2),
            "pid": pid,
            "line": line,
        }
        print(json.dumps(entry), file=self._diary, flush=True)

    def _pids(self, role: str) -> list[int]:
        if role == "command":
            return [command.pid for command in list(self.commands.values()) if command.poll() is None]
        return self._cluster.find(role)


def _go_on(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def chaos(seconds: float, seed: int, root: Path, tell: Tell) -> bool:
    """Plays the twins, then rounds of them for so long, and checks each; True when nothing is wrong."""
    semaphores = _semaphores()
    wrong: list[str] = []
    with fault_cluster(root, workers=2) as cluster:
        twins = Twins(cluster)
        twins.play("undisturbed", None, wrong)
        if wrong:
            tell("\n".join(wrong))
            return False
        faults = Chaos(cluster, seed, root / "strikes.jsonl")
        deadline = time.monotonic() + seconds
        n = 0
        try:
            while time.monotonic() < deadline:
                n += 1
                started = time.monotonic()
                found: list[str] = []
                runs = twins.play(f"round-{n}", faults, found)
                took = time.monotonic() - started
                tell(f"round {n:<4}{runs:>3} runs {took:>7.1f} s  {'; '.join(found) or 'same runs'}")
                wrong += [f"round {n}: {each}" for each in found]
        finally:
            faults.end()
        total = sum(faults.struck.values())
        tell(f"{total} strikes: {', '.join(f'{what} {n}' for what, n in sorted(faults.struck.items()))}")
        never = [role for role in ROLES if not any(what.startswith(f"{role} SIG") for what in faults.struck)]
        if never and total >= ENOUGH:
            wrong.append(f"never hit: {', '.join(never)}: is it still called so?")
        end = time.monotonic() + CALM_S
        while (strays := cluster.strays()) and time.monotonic() < end:
            time.sleep(0.1)
        wrong += [f"left over: {stray}" for stray in strays]
        temporary = cluster.temporary
        wrong += _tracebacks(root, root)
    # What killed owners have left goes when anything of its kind is started.
    with patch.object(tempfile, "tempdir", str(temporary)):
        for folder in temporary.glob("evopolicy-*"):
            os.utime(folder, (0, 0))
            scratch.clear_stale(folder.name.split("-")[1])
    left = proc.descendants(os.getpid())
    wrong += [f"left over: {pid} {command_line(pid)[:120]}" for pid in left]
    wrong += [
        f"left over: {path}" for path in sorted(temporary.glob("evopolicy-*")) if "-cores-" not in path.name
    ]
    wrong += [f"left over: {path}" for path in _semaphores() - semaphores]
    for each in wrong:
        tell(each)
    tell(f"chaos, seed {seed}: {twins.runs} runs, {total} strikes, {len(wrong)} things wrong")
    return not wrong


class Twins:
    """A single run and a sweep at the same time, again and again."""

    def __init__(self, cluster: FaultCluster) -> None:
        self._cluster = cluster
        self.runs = 0

    def play(self, name: str, faults: Chaos | None, wrong: list[str]) -> int:
        """One round, with its runs compared to those of the undisturbed one; how many runs it had."""
        cluster = self._cluster
        sweep = cluster.root / f"{name}.toml"
        sweep.write_text(_sweep(name, cluster.agent()))
        arguments = {
            "run": [
                *(
                    "run",
                    "--env",
                    "toy/line",
                    "--agent",
                    cluster.agent(),
                    "--entry",
                    "tester",
                    "--exp-id",
                    name,
                ),
                *("--budget", str(SUBMITS * EPISODES), "--validation", str(HIDDEN), "--heldout", str(HIDDEN)),
                *("--runs", str(cluster.runs), "--resume"),
            ],
            "suite": ["suite", str(sweep), "--runs", str(cluster.runs / name)],
        }
        timeout_s, looked = TIMEOUT_S, time.monotonic()
        with contextlib.ExitStack() as stack:
            commands: dict[str, subprocess.Popen[str]] = {}
            logs = {}

            def start(what: str) -> None:
                logs[what] = stack.enter_context((cluster.root / f"{name}-{what}.err").open("a"))
                commands[what] = cluster.operator_command(arguments[what], logs[what])
                if faults is not None:
                    faults.commands[what] = commands[what]

            for what in arguments:
                start(what)
            while commands:
                for what, command in list(commands.items()):
                    code = command.poll()
                    if code is None:
                        continue
                    del commands[what]
                    if code == 0:
                        continue
                    if faults is not None and command.pid in faults.killed:
                        start(what)
                    else:
                        output = (cluster.root / f"{name}-{what}.err").read_text(errors="replace")
                        wrong.append(f"{what}: exit status {code}: {' | '.join(output.splitlines()[-4:])}")
                now = time.monotonic()
                timeout_s, looked = timeout_s - (now - looked) / slowness(), now
                if timeout_s < 0.0:
                    wrong.append(
                        f"{', '.join(commands)}: did not end within {TIMEOUT_S:g} s of a machine's own that does"
                        " nothing else"
                    )
                    for command in commands.values():
                        command.kill()
                        command.wait()
                    break
                time.sleep(0.05)
        pairs = list(self._pairs(name))
        for ours, twin in pairs:
            wrong += _compared(ours, twin)
            wrong += _tracebacks(ours, cluster.root)
            if name != "undisturbed" and not wrong:
                shutil.rmtree(ours)
        self.runs += len(pairs)
        return len(pairs)

    def _pairs(self, name: str) -> Iterator[tuple[Path, Path]]:
        """Each run of the round beside its twin: agents and repeats of one environment are all the same."""
        runs = self._cluster.runs
        yield runs / "tester" / "toy_line" / name, runs / "tester" / "toy_line" / "undisturbed"
        for agent in AGENTS:
            for env in ENVIRONMENTS:
                folder = env.replace("/", "_")
                twin = runs / "undisturbed" / agent / folder / "undisturbed-0"
                yield runs / name / agent / folder / f"{name}-0", twin


def _sweep(name: str, agent: str) -> str:
    lines = [f'name = "{name}"', f"environments = {json.dumps(ENVIRONMENTS)}", "[defaults]"]
    lines += [
        f"budget = {SUBMITS * EPISODES}",
        "repeats = 1",
        f"validation = {HIDDEN}",
        f"heldout = {HIDDEN}",
    ]
    lines += ["[parallel]", "machine = 2"]
    for each in AGENTS:
        lines += ["[[agents]]", f'name = "{each}"', f"agent = {json.dumps(agent)}"]
    return "\n".join(lines) + "\n"


def _compared(ours: Path, twin: Path) -> list[str]:
    name = "/".join(ours.parts[-4:])
    if not (ours / "run.json").exists():
        return [f"{name}: there is no run.json"]
    # What was begun again keeps its earlier attempts.
    found = [each for each in differences(twin, ours) if not each.startswith(".attempts/")]
    used = record(ours)["outcome"]["budget_used"]
    if used != SUBMITS * EPISODES:
        found.append(f"budget used: {used} of {SUBMITS * EPISODES}")
    return [f"{name}: {each}" for each in found[:3]] + (
        [f"{name}: and {len(found) - 3} more"] if len(found) > 3 else []
    )


def _semaphores() -> set[Path]:
    return set(Path("/").glob(SEMAPHORES.lstrip("/")))


def _tracebacks(folder: Path, root: Path) -> Iterator[str]:
    """Logs with a traceback, each with the error that its first one ends with."""
    for path in sorted(folder.rglob("*")):
        if path.suffix not in (".log", ".err", ".jsonl") or not path.is_file() or path.name == "agent.jsonl":
            continue
        text = path.read_text(errors="replace")
        n = text.count("Traceback (most recent call last)")
        if n:
            after = text.partition("Traceback (most recent call last)")[2]
            error = re.search(
                r"(?:^|\\n)([A-Za-z_.]+(?:Error|Exception|Interrupt|Group)[^\n\\]{0,160})",
                after,
                re.MULTILINE,
            )
            yield f"{path.relative_to(root)}: {n} tracebacks, {error[1] if error else '?'}"


def run(seconds: float, seed: int, keep: Path | None) -> bool:
    """As `fault_matrix.py` calls it."""
    with contextlib.ExitStack() as stack:
        root = keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="evof-")))
        root.mkdir(parents=True, exist_ok=True)
        return chaos(seconds, seed, root / "cluster", lambda line: print(line, flush=True))
