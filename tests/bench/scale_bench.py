"""What the path of a result costs: `python tests/bench/scale_bench.py [--envs core16] [--runs 1,8,32] [--json FILE]`.

For each environment a real worker first plays real episodes through a coordinator and a gateway to feedback on disk.
Then workers without a simulator report the same outcomes: the real supervisor with its leases, heartbeats and result
reports over Zenoh connections of its own, whose slots answer at once. Coordinator and gateways are the real programs, a
process a run. The feedback of the first and the last submit of every run is hashed and has to equal the real one.
Prints tables; the only thing that it asserts is that hash.

CPU is the system's count for whole processes while submits were in flight. "By CPU": slots whose episodes cost, without
a slot, as much CPU as their results cost the process. All processes of the bench share the machine.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import frame
import msgspec
import numpy as np
from coordinator_harness import FINGERPRINT, Coordinator, operator_of
from rich.console import Console
from rigs.finished_run import mark_opened

from evopolicy_common import catalogue
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeOutcome, Job
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.episodes import rendered
from evopolicy_common.wire import credentials, transport
from evopolicy_coordinator.core.contract.records import RunRow, submit_group
from evopolicy_coordinator.storage.store import Reader
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_worker import environments
from evopolicy_worker.capabilities import Capabilities
from evopolicy_worker.slot_protocol import slot_messages
from evopolicy_worker.supervisor import Supervisor, WorkerOptions

POLICY = '''"""Actions that differ from step to step, and are the same in every run."""
import numpy as np


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.space = action_space

    def reset(self, episode_index):
        self.rng = np.random.default_rng(7)

    def act(self, obs):
        if self.space["type"] == "Discrete":
            return int(self.rng.integers(self.space["n"]))
        return self.rng.uniform(-0.5, 0.5, self.space["shape"]).astype(np.float32)
'''
FEWEST_CASES = 4
SPARE_SUBMITS = 2


class Outcomes(msgspec.Struct):
    """What workers without a simulator answer with."""

    env: EnvironmentDescription
    by_seed: dict[int, bytes]
    """What a slot's process says of an episode (`slot_messages.Finished`), by its case's seed."""


class Played(msgspec.Struct, frozen=True):
    """What a real worker played."""

    episodes: tuple[tuple[str, int, float], ...]
    """SHA-256 and bytes of each episode's feedback, and its return."""
    bare_s: float
    """CPU seconds of an episode without a slot."""
    steps: float

    @property
    def kilobytes(self) -> float:
        """Of an episode's feedback."""
        return sum(size for _, size, _ in self.episodes) / len(self.episodes) / 1000

    def expected(self, n: int) -> str:
        """What `Run.hash` gives for a submit of `n` episodes, on these cases in turn."""
        some = [self.episodes[index % len(self.episodes)] for index in range(n)]
        return _hash([digest for digest, _, _ in some], [value for _, _, value in some])


# Workers that answer at once.


class AnsweringSlot:
    """Takes the supervisor's jobs as a slot does, and reads what came of them as from a slot's process."""

    begun = None

    def __init__(self, outcomes: Outcomes) -> None:
        self._outcomes = outcomes

    async def start(self) -> None: ...

    async def prepare(self, env_ids: Sequence[str]) -> None: ...

    async def cancel(self) -> None: ...

    async def close(self) -> None: ...

    async def play_job(
        self, job: Job, bundle: Path | None, on_progress: Callable[[int, int], None]
    ) -> tuple[EpisodeOutcome, ...]:
        outcomes = []
        for spec in job.episodes:
            reply = slot_messages.replies.decode(self._outcomes.by_seed[spec.case.seed])
            assert isinstance(reply, slot_messages.Finished)
            outcomes.append(msgspec.structs.replace(reply.outcome, index=spec.index))
        await asyncio.sleep(0)
        return tuple(outcomes)


async def answer(options: Any) -> None:
    """Supervisors until the parent closes standard input."""
    folder: Path = options.answer
    outcomes = msgspec.msgpack.decode((folder / "outcomes").read_bytes(), type=Outcomes)
    found = credentials.read_credentials(folder / "worker.json")
    async with contextlib.AsyncExitStack() as stack:
        tasks = []
        for number in range(options.workers):
            name = f"w-{options.process}-{number}"
            own = WorkerOptions(
                name=name,
                slots=options.slots,
                fingerprint=FINGERPRINT,
                host="bench",
                scratch=folder / name,
            )
            own.scratch.mkdir()
            link = await stack.enter_async_context(transport.connect(found))
            supervisor = Supervisor(
                link,
                own,
                Capabilities(("bwrap",), (outcomes.env,)),
                lambda index, tier: AnsweringSlot(outcomes),
            )
            tasks.append(asyncio.create_task(supervisor.run()))
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.read)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


# Processes, and what they use.


def _written(pid: int) -> int:
    """Bytes that the process has had written to the disk."""
    lines = Path(f"/proc/{pid}/io").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("write_bytes"))


@contextlib.contextmanager
def child(*command: str, log: Path, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A Python program, ended with SIGTERM."""
    with log.open("ab") as file:
        process = subprocess.Popen([sys.executable, *command], stderr=file, text=True, **options)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(30)
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


# Runs.


class Run:
    """One run: its folder, its gateway, and what it was answered."""

    def __init__(
        self, coordinator: Coordinator, root: Path, run: str, capability: str, stack: contextlib.ExitStack
    ) -> None:
        self.id = run
        self.folder = RunFolder(root)
        self.folder.state.mkdir(parents=True, mode=0o700)
        self.latencies: list[float] = []
        self.log = root / "gateway.log"
        found = msgspec.structs.replace(coordinator.credentials("gateway"), token=capability)
        credentials.write(found, self.folder.credentials)
        mark_opened(self.folder, run)
        self.said = root / "gateway.jsonl"
        pipes = {"stdin": subprocess.PIPE, "stdout": stack.enter_context(self.said.open("wb"))}
        self.process = stack.enter_context(
            child("-m", "evopolicy_gateway.cli.serve", str(root), log=self.log, **pipes)
        )
        self._url = ""

    def serving(self) -> None:
        """Waits until it serves."""
        while not self._url:
            assert self.process.poll() is None, f"a gateway did not start: {self.log.read_text()}"
            time.sleep(0.02)
            lines = self.said.read_text().splitlines(keepends=True)
            told = [json.loads(line) for line in lines if '"variables"' in line and line.endswith("\n")]
            self._url = told[0]["variables"]["EVOPOLICYGYM_SUBMIT_URL"] if told else ""
        (self.folder.system / "policy.py").write_text(POLICY)

    def submit(self, ids: list[int]) -> None:
        request = urllib.request.Request(self._url, json.dumps({"env_instances": ids}).encode())
        started = time.perf_counter()
        with urllib.request.urlopen(request) as reply:
            assert json.load(reply)["status"] == "ok"
        self.latencies.append(time.perf_counter() - started)

    def episodes(self, index: int) -> tuple[list[tuple[str, int]], list[float]]:
        """SHA-256 and bytes of each episode's feedback in a submit, and the returns in its summary."""
        folder = sorted(self.folder.feedback.iterdir())[index]
        found = []
        for episode in sorted((folder / "episodes").iterdir()):
            digest, size = hashlib.sha256(), 0
            for path in sorted(episode.iterdir()):
                data = path.read_bytes()
                digest.update(b"%s %d\n" % (path.name.encode(), len(data)) + data)
                size += len(data)
            found.append((digest.hexdigest(), size))
        return found, json.loads((folder / "summary.json").read_text())["returns"]

    def hash(self, index: int) -> str:
        """SHA-256 of what a submit's feedback holds."""
        episodes, returns = self.episodes(index)
        return _hash([digest for digest, _ in episodes], returns)


def _hash(episodes: list[str], returns: list[float]) -> str:
    return hashlib.sha256(json.dumps([episodes, returns]).encode()).hexdigest()


def create(coordinator: Coordinator, env: str, exp_id: str, n: int, submits: int) -> tuple[str, str]:
    async def ask() -> tuple[str, str]:
        async with operator_of(coordinator) as operator:
            created = await operator.create(
                key=exp_id,
                env=env,
                exp_id=exp_id,
                budget=n * (submits + SPARE_SUBMITS),
                max_episodes_per_submit=n,
                n_validation=1,
                n_heldout=1,
            )
            return created.run, created.capability

    return asyncio.run(ask())


def play_really(coordinator: Coordinator, env: str, folder: Path, n: int) -> Played:
    """A submit of `n` episodes that a real worker plays. Their outcomes are in `folder/outcomes` then."""
    ids = list(range(n))
    with contextlib.ExitStack() as stack:
        run = Run(coordinator, folder / "real", *create(coordinator, env, "real", n, 1), stack)
        stack.enter_context(
            child(
                *("-m", "evopolicy_worker.cli", "--env", env, "--slots", "2", "--grace", "0"),
                *("--credentials", coordinator.ready["credentials"]["worker"]),
                log=folder / "worker.log",
                stdout=subprocess.DEVNULL,
            )
        )
        run.serving()
        run.submit(ids)
        episodes, returns = run.episodes(0)
    reader = Reader(coordinator.state / "coordinator.sqlite")
    rows = reader.outcomes(submit_group(run.id, 0, "train"), 0, 1 << 30, 1 << 40)
    stored = reader.one(RunRow, run=run.id)
    assert stored is not None
    blobs = BlobStore(coordinator.state / "blobs")
    by_seed: dict[int, bytes] = {}
    for row in rows:
        outcome = row.outcome
        ref = outcome.trajectory
        assert ref is not None
        whole = (
            ref
            if ref.inline is not None
            else msgspec.structs.replace(ref, inline=blobs.read_blob(ref.digest))
        )
        reply = slot_messages.Finished(outcome=msgspec.structs.replace(outcome, trajectory=whole))
        by_seed[stored.train[ids[row.index]].seed] = slot_messages.encoder.encode(reply)
    # The hidden cases of the runs to come are answered like a case that was played.
    some = next(iter(by_seed.values()))
    by_seed |= {case.seed: some for case in (*stored.validation, *stored.heldout)}
    first = slot_messages.replies.decode(by_seed[stored.train[ids[0]].seed])
    bare_s = bare(env, stored.train[ids[0]], rendered.decode(first.outcome.trajectory.inline).actions)
    outcomes = Outcomes(env=environments.describe(env), by_seed=by_seed)
    (folder / "outcomes").write_bytes(msgspec.msgpack.encode(outcomes))
    return Played(
        tuple((digest, size, value) for (digest, size), value in zip(episodes, returns, strict=True)),
        bare_s,
        sum(row.outcome.length for row in rows) / len(rows),
    )


def bare(env: str, case: Case, actions: Iterable[Any]) -> float:
    """CPU seconds that the environment alone takes for an episode, in this process."""
    environment = environments.make(env)
    try:
        environment.reset(case)
        started = time.process_time()
        for action in actions:
            _, _, terminated, truncated, _ = environment.step(environment.action_codec.repair(action)[0])
            if terminated or truncated:
                break
        return time.process_time() - started
    finally:
        environment.close()


def n_cases(env: str, options: Any) -> int:
    """As many episodes as a real worker plays in about `--play` seconds."""
    environment = environments.make(env)
    rng, codec = np.random.default_rng(7), environment.action_codec
    actions = (codec.sample(rng) for _ in range(environment.description.max_episode_steps))
    one_s = bare(env, Case(seed=7), actions)
    environment.close()
    return min(options.cases, options.per_submit, max(FEWEST_CASES, int(options.play / max(one_s, 1e-3))))


def answered(
    coordinator: Coordinator, env: str, folder: Path, n_runs: int, played: Played, options: Any
) -> dict[str, Any]:
    """`n_runs` runs at once, each of them one submit after another, answered by workers without a simulator."""
    room = max(1, int(options.megabytes * 1000 / played.kilobytes / n_runs))
    per_submit = min(options.per_submit, max(len(played.episodes), room // 2))
    submits = max(2, min(options.episodes // n_runs, room) // per_submit)
    ids = [index % len(played.episodes) for index in range(per_submit)]
    folder.mkdir()
    credentials.write(coordinator.credentials("worker"), folder / "worker.json")
    (folder / "outcomes").symlink_to(folder.parent / "outcomes")
    with contextlib.ExitStack() as stack:
        answering = []
        for number in range(options.processes):
            process = stack.enter_context(
                child(
                    *(__file__, "--answer", str(folder), "--process", str(number)),
                    *("--workers", str(options.workers), "--slots", str(options.slots)),
                    log=folder / "answering.log",
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                )
            )
            assert process.stdout is not None
            assert process.stdout.readline(), (folder / "answering.log").read_text()
            answering.append(process)
        runs = [
            Run(
                coordinator,
                folder / f"run-{k}",
                *create(coordinator, env, f"{folder.name}-{k}", len(ids), submits),
                stack,
            )
            for k in range(n_runs)
        ]
        for run in runs:
            run.serving()
            run.submit(ids)  # warms everything up, the bundle's way to the workers too
            run.latencies.clear()
        pids = {"coordinator": [coordinator.process.pid]}
        pids["gateway"] = [run.process.pid for run in runs]
        pids["supervisor"] = [process.pid for process in answering]
        before = {what: sum(map(frame.cpu_s, of)) for what, of in pids.items()}
        written = _written(coordinator.process.pid)
        started = time.monotonic()
        threads = [
            threading.Thread(target=lambda run=run: [run.submit(ids) for _ in range(submits)]) for run in runs
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wall_s = time.monotonic() - started
        used = {what: sum(map(frame.cpu_s, of)) - before[what] for what, of in pids.items()}
        written = _written(coordinator.process.pid) - written
        hashes = {run.hash(index) for run in runs for index in (0, submits)}
        assert hashes == {played.expected(per_submit)}, f"{env}: the feedback differs from a real run's"
        latencies = sorted(latency for run in runs for latency in run.latencies)
    episodes = n_runs * submits * len(ids)
    assert len(latencies) == n_runs * submits, "a submit failed"
    cpu_ms = {what: 1000 * cpu / episodes for what, cpu in used.items()}
    rate, bare_ms = episodes / wall_s, 1000 * played.bare_s
    return {
        "env": env,
        "runs": n_runs,
        "episodes": episodes,
        "per_submit": per_submit,
        "steps": round(played.steps),
        "bare_ms": round(bare_ms, 1),
        "feedback_kb": round(played.kilobytes, 1),
        "episodes_per_s": round(rate, 1),
        "feedback_mb_per_s": round(rate * played.kilobytes / 1000, 1),
        "disk_kb": round(written / episodes / 1000, 1),
        "p50_ms": round(1000 * statistics.median(latencies), 1),
        "p99_ms": round(1000 * latencies[math.ceil(0.99 * len(latencies)) - 1], 1),
        **{f"{what}_ms": round(value, 3) for what, value in cpu_ms.items()},
        # A slot takes longer than the environment alone, so these are the fewest.
        "slots_by_gateway": round(bare_ms / max(cpu_ms["gateway"], 1e-3), 1),
        "slots_by_coordinator": round(bare_ms / max(cpu_ms["coordinator"], 1e-3), 1),
    }


def bench(env: str, options: Any) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory(prefix="evopolicy-scale-", dir=options.folder) as temporary:
        folder = Path(temporary)
        coordinator = Coordinator(folder / "state", "--log-level", "warning", "--hidden-isolation", "off")
        try:
            played = play_really(coordinator, env, folder, n_cases(env, options))
            rows = []
            for n_runs in map(int, options.runs.split(",")):
                rows.append(answered(coordinator, env, folder / f"n{n_runs}", n_runs, played, options))
                print("  ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
            return rows
        finally:
            coordinator.stop()


COLUMNS = {
    "environment": "env",
    "steps": "steps",
    "bare ms": "bare_ms",
    "runs": "runs",
    "a submit": "per_submit",
    "episodes/s": "episodes_per_s",
    "coordinator ms": "coordinator_ms",
    "gateway ms": "gateway_ms",
    "supervisor ms": "supervisor_ms",
    "kB": "feedback_kb",
    "MB/s": "feedback_mb_per_s",
    "disk kB": "disk_kb",
    "submit ms, 50 %": "p50_ms",
    "99 %": "p99_ms",
    "slots of a run by CPU": "slots_by_gateway",
    "of a coordinator by CPU": "slots_by_coordinator",
}


def tell(rows: list[dict[str, Any]], console: Console) -> None:
    """All rows in one table."""
    console.print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; CPU of one core an episode")
    table = frame.table(*COLUMNS)
    for row in rows:
        table.add_row(*(str(row[name]) for name in COLUMNS.values()))
    console.print(table)


def main() -> None:
    options = frame.options(
        __doc__,
        envs=("gym/acrobot,gym/reacher5", "suites, ids or globs, comma separated"),
        runs=("1,8,32", "runs at once, comma separated"),
        episodes=(2048, "episodes of all runs of a row together"),
        per_submit=(128, "episodes of a submit"),
        cases=(32, "most episodes that are really played of each environment"),
        play=(15.0, "CPU seconds of episodes that are really played"),
        megabytes=(1000.0, "most feedback of all runs of a row together"),
        processes=(2, "processes of answering workers"),
        workers=(4, "workers in each, a connection a worker"),
        slots=(32, "slots of each worker"),
        folder=(Path, "where the temporary folders go"),
        json=(Path, "also write all numbers to this file"),
        answer=(Path, argparse.SUPPRESS),
        process=(int, argparse.SUPPRESS),
    )
    if options.answer is not None:
        asyncio.run(answer(options))
        return
    rows = [row for env in catalogue.resolve(options.envs.split(",")) for row in bench(env, options)]
    tell(rows, Console(width=None if sys.stdout.isatty() else 220))
    frame.save(options.json, rows)


if __name__ == "__main__":
    main()
