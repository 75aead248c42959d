"""`make bench-start`: what a person waits for before anything is played, each beside a bare Python with the same
imports.

Rows: the help; `evopolicy local` from its call to the answer of a first one-episode submit, then that submit and the
next one; `evopolicy try` on one case; a report of 48 runs; a worker that offers all environments installed here, from
its call to its registration, for which the floor is one that offers Core16 (`--workers-only`: this row alone); a
thousand requests to a model API on loopback through the relay, for which the floor is the same without it
(`--relay-only`), by their size and by `--record-model`, in turns: seconds read as milliseconds a request. Wall time and
processor time (of all processes), the best of `--times`; the floor is the same of bare Pythons, one for each process
that the command starts, which import what it imports. Prints a table, asserts nothing.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import frame
from bare_loop import POLICY
from coordinator_harness import Coordinator
from invented.study import AGENTS, write_suite
from stages.model_api import ModelApi

from evopolicy_common import catalogue
from evopolicy_common.wire.http import bound
from evopolicy_gateway.processes.child_messages import StartRelay, line
from evopolicy_worker.environments import registry

HERE = Path(__file__).parent
N_REQUESTS = 1000
SIZES = ((1000, 4000), (50, 500_000))
"""Requests to the relay that are timed at once, and their bytes."""
TOKEN = "token-of-the-bench"
ENV, GYMNASIUM_ID = "gym/acrobot", "Acrobot-v1"
AGENT = """
import json, os, pathlib, sys, time, urllib.request

times = [time.time()]
pathlib.Path("system/policy.py").write_text(pathlib.Path(sys.argv[1]).read_text())
for _ in range(2):
    request = urllib.request.Request(
        os.environ["EVOPOLICYGYM_SUBMIT_URL"],
        data=json.dumps({"env_instances": [0]}).encode(),
        headers={"Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request) as answer:
        assert json.load(answer)["status"] == "ok"
    times.append(time.time())
pathlib.Path(sys.argv[2]).write_text(json.dumps(times))
"""
FRONT = "import evopolicy_gateway.cli.main"
COORDINATOR = "import evopolicy_coordinator.cli.main"
WORKER = "import evopolicy_worker.cli"
SIMULATOR = f"import evopolicy_worker.episodes.env_process, gymnasium; gymnasium.make({GYMNASIUM_ID!r})"
TRIAL = (f"{FRONT}, evopolicy_gateway.cli.play", COORDINATOR, WORKER, SIMULATOR)
LOCAL = (*TRIAL, "import evopolicy_gateway.cli.serve", "import evopolicy_gateway.agent_supervisor.supervisor")
REPORT = ("import evopolicy_gateway.cli.main, evopolicy_results.cli.report, evopolicy_results.report",)


class Cost(NamedTuple):
    wall_s: float
    cpu_s: float


class Row(NamedTuple):
    name: str
    cost: Cost
    floor: Cost | None = None


def cost(work: Callable[[], None], times: int) -> Cost:
    """The least of several times."""
    found = []
    for _ in range(times):
        before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        work()
        wall_s, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        found.append(Cost(wall_s, cpu_s))
    return Cost(min(one.wall_s for one in found), min(one.cpu_s for one in found))


def run(*words: str | Path) -> None:
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))} failed:\n{done.stderr[-2000:]}")


def evopolicy(*words: str | Path) -> None:
    run("-m", "evopolicy_gateway.cli", *words)


def floor(programs: Sequence[str], times: int) -> Cost:
    return cost(lambda: [run("-c", program) for program in programs] and None, times)


def first_minute(folder: Path, state: Path) -> tuple[float, float, float]:
    """Seconds from the call to the first submit's answer, and what the first and the second submit took."""
    policy, agent, times = folder / "policy.py", folder / "agent.py", folder / "times.json"
    policy.write_text(POLICY)
    agent.write_text(AGENT)
    called = time.time()
    run(
        *("-m", "evopolicy_gateway.cli", "local", "--env", ENV, "--budget", "2", "--state", state),
        *("--agent", f"command:{sys.executable} {agent} {policy} {times}", "--jail", "none"),
        *(
            "--runs",
            folder / "runs",
            "--overwrite",
            "--exp-id",
            "bench",
            "--validation",
            "1",
            "--heldout",
            "1",
        ),
    )
    begun, first, second = json.loads(times.read_text())
    return first - called, first - begun, second - first


def registered_s(folder: Path, coordinator: Coordinator, env_ids: Sequence[str]) -> float:
    """Seconds from the call of a worker until it has registered."""
    log = folder / "worker.log"
    words = [f"--env={each}" for each in env_ids]
    words += ["--slots", "1", "--grace", "1", "--credentials", coordinator.ready["credentials"]["worker"]]
    variables = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
    with log.open("wb") as file:
        called = time.perf_counter()
        program = [sys.executable, "-P", "-m", "evopolicy_worker.cli", *words]
        process = subprocess.Popen(program, stdout=file, stderr=file, env=variables)
        while b"registered" not in log.read_bytes():
            if process.poll() is not None:
                raise SystemExit(f"the worker has ended:\n{log.read_text()[-2000:]}")
            time.sleep(0.005)
        took = time.perf_counter() - called
    process.terminate()
    process.wait()
    return took


def workers(folder: Path, times: int) -> list[Row]:
    """A worker that offers everything, beside one that offers Core16, in turns. The first start describes Core16."""
    core16, everything = list(catalogue.suites()["core16"].environments), registry.offered()
    coordinator = Coordinator(folder / "worker-state", trust_workers=False)
    try:
        registered_s(folder, coordinator, core16)
        few, many = zip(
            *(
                (registered_s(folder, coordinator, core16), registered_s(folder, coordinator, everything))
                for _ in range(times)
            ),
            strict=True,
        )
    finally:
        coordinator.stop()
    unknown = float("nan")
    name = f"evopolicy-worker, {len(everything):,} environments (floor: {len(core16)})"
    return [Row(name, Cost(min(many), unknown), Cost(min(few), unknown))]


def relay(folder: Path, times: int) -> list[Row]:
    """Streamed requests one after another, as an agent makes them: all but the end of each repeats the one before."""
    unknown, levels, found = float("nan"), ("off", "digests", "full"), []
    with ModelApi([]) as api, contextlib.ExitStack() as stack:
        ports = [int(api.base_url.rpartition(":")[2])]
        ports += [stack.enter_context(relayed(folder / level, level, api)) for level in levels]
        for n, n_bytes in SIZES:
            least = [float("inf")] * len(ports)
            for _ in range(times + 1):  # the first is a warm-up
                least = [
                    min(one, asked(api, port, n, n_bytes)) for one, port in zip(least, ports, strict=True)
                ]
            floor, *costs = [Cost(each * N_REQUESTS / n, unknown) for each in least]
            name = f"{N_REQUESTS} model requests of {n_bytes // 1000} kB, record"
            found += [Row(f"{name} {level}", each, floor) for level, each in zip(levels, costs, strict=True)]
    return found


@contextlib.contextmanager
def relayed(folder: Path, level: str, api: ModelApi) -> Iterator[int]:
    """The port of a relay that records so much."""
    folder.mkdir()
    sock = bound("127.0.0.1", 0)
    sock.listen()
    order = {"token": TOKEN, "ledger": str(folder / "ledger.jsonl"), "limits": {"max_requests": 10**9}}
    order |= {"record": level, "folder": str(folder)}
    order["upstream"] = {"protocol": "openai", "base_url": f"{api.base_url}/v1"}
    program = [sys.executable, "-m", "evopolicy_gateway.relay", str(sock.fileno())]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, pass_fds=[sock.fileno()]
    ) as process:
        assert process.stdin is not None
        process.stdin.write(line(StartRelay(order=order)))
        process.stdin.flush()
        yield sock.getsockname()[1]
        process.terminate()


def asked(api: ModelApi, port: int, n: int, n_bytes: int) -> float:
    """Seconds that `n` requests of so many bytes over one connection take."""
    headers = {"authorization": f"Bearer {TOKEN}", "content-type": "application/json"}
    document = {"model": "m", "stream": True, "stream_options": {"include_usage": True}}
    said = [{"role": "user", "content": "a line of some length\n" * 44} for _ in range(n_bytes // 1000)]
    bodies = [
        json.dumps(document | {"messages": [*said, {"role": "user", "content": f"{port} {at}"}]})
        for at in range(n)
    ]
    connection = http.client.HTTPConnection("127.0.0.1", port)
    started = time.perf_counter()
    for body in bodies:
        connection.request("POST", "/v1/chat/completions", body, headers)
        with connection.getresponse() as answer:
            assert b"[DONE]" in answer.read()
    took = time.perf_counter() - started
    connection.close()
    api.bodies.clear()
    api.requests.clear()
    return took


def rows(folder: Path, times: int) -> list[Row]:
    """Everything that is measured. The state is kept between commands, as a user's is."""
    state = folder / "state"
    found = [
        Row("evopolicy --help", cost(lambda: evopolicy("--help"), times), floor(["import typer"], times))
    ]
    first_minute(folder, state)
    minutes = [first_minute(folder, state) for _ in range(times)]
    least = [min(column) for column in zip(*minutes, strict=True)]
    names = ("evopolicy local, call to first episode", "its first submit", "its second submit")
    for name, wall_s in zip(names, least, strict=True):
        found.append(Row(name, Cost(wall_s, float("nan")), floor(LOCAL, times) if name == names[0] else None))
    bundle = folder / "policy"
    bundle.mkdir()
    (bundle / "policy.py").write_text(POLICY)
    trial = ["try", bundle, "--env", ENV, "--cases", "0", "--out", folder / "tries", "--state", state]
    found.append(Row("evopolicy try, one case", cost(lambda: evopolicy(*trial), times), floor(TRIAL, times)))
    three = dict(list(AGENTS.items())[:3])
    n_runs = len(write_suite(folder / "study", agents=three))
    report = ["report", folder / "study", "--out", folder / "report"]
    found.append(
        Row(f"evopolicy report, {n_runs} runs", cost(lambda: evopolicy(*report), times), floor(REPORT, times))
    )
    return [*found, *workers(folder, times), *relay(folder, times)]


def main() -> None:
    options = frame.options(
        __doc__,
        times=(3, "of each; the least counts"),
        workers_only=(False, "only the start of a worker"),
        relay_only=(False, "only the relay for model calls"),
        json=(Path, "also write all numbers to this file"),
    )
    with tempfile.TemporaryDirectory(prefix="evopolicy-bench-") as name:
        folder = Path(name)
        chosen = [workers] * options.workers_only + [relay] * options.relay_only
        found = [row for each in chosen for row in each(folder, options.times)] or rows(folder, options.times)
    console = frame.console()
    console.print(
        f"seconds, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; over floor: CPU, or wall where there is no"
        " other"
    )
    table = frame.table("", "wall", "CPU", "floor, wall", "floor, CPU", "over floor")
    for row in found:
        cells = [_text(row.cost.wall_s), _text(row.cost.cpu_s)]
        if row.floor is not None:
            known = row.cost.cpu_s == row.cost.cpu_s
            ratio = row.cost.cpu_s / row.floor.cpu_s if known else row.cost.wall_s / row.floor.wall_s
            cells += [_text(row.floor.wall_s), _text(row.floor.cpu_s), f"{ratio:.1f}"]
        table.add_row(row.name, *cells)
    console.print(table)
    frame.save(options.json, [row._asdict() for row in found])


def _text(seconds: float) -> str:
    return "" if seconds != seconds else f"{seconds:.2f}"


if __name__ == "__main__":
    main()
