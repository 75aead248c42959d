"""`make bench-peers`: the same episodes through this project and through its peers, on the same machine in one run.

Each row plays the same cases of an environment with the policy of `bare_loop.py`, which costs nothing: a bare loop on
one core; this project's second submit on as many slots as there are cores, sandboxed and up to committed feedback;
Gymnasium's AsyncVectorEnv with one environment a core; Ray, Dask and joblib with one task an episode on a process a
core. All but the first submit of a process are warm: imports and the making of environments are left out everywhere.
Prints versions, and times over the bare loop's; a peer that is not installed for `--python` is skipped with the reason.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import frame
from runtime_bench import submit_time

from evopolicy_common import __version__, catalogue

HERE = Path(__file__).parent
ENVIRONMENTS = ["gym/acrobot", "gym/reacher5", "gym/halfcheetah5", "gymnasium/MiniGrid-FourRooms-v0"]

BEGIN = """
import importlib.metadata, json, os, sys, time
sys.path.insert(0, os.environ["BENCH"])
gymnasium_id, n, cores = sys.argv[1], int(sys.argv[2]), len(os.sched_getaffinity(0))
import bare_loop

def report(package, seconds, steps):
    print(json.dumps({"version": f"{package} {importlib.metadata.version(package)}", "seconds": seconds, "steps": steps}))
"""  # noqa: E501
BARE = """
env = bare_loop.make(gymnasium_id)
bare_loop.play(env, 1)
started = time.perf_counter()
steps = sum(bare_loop.play(env, seed) for seed in bare_loop.seeds(n))
report("gymnasium", time.perf_counter() - started, steps)
"""
VECTOR = """
import gymnasium, numpy as np

def main():
    makers, mode = [lambda: bare_loop.make(gymnasium_id)] * cores, gymnasium.vector.AutoresetMode.DISABLED
    try:
        envs = gymnasium.vector.AsyncVectorEnv(makers, autoreset_mode=mode)
    except ValueError:  # a space that its shared memory does not know
        envs = gymnasium.vector.AsyncVectorEnv(makers, autoreset_mode=mode, shared_memory=False)
    space = envs.single_action_space
    one = 0 if not hasattr(space, "high") else np.zeros(space.shape, dtype=space.dtype)
    action = np.stack([np.asarray(one, dtype=space.dtype)] * cores)
    envs.reset(seed=[1] * cores)
    started, steps, seeds = time.perf_counter(), 0, bare_loop.seeds(n)
    # Cases in batches of one a core: an environment that is done waits for the others, as the class has it.
    for first in range(0, n, cores):
        batch = seeds[first : first + cores]
        batch += [batch[-1]] * (cores - len(batch))
        envs.reset(seed=batch)
        done = np.zeros(cores, dtype=bool)
        done[n - first :] = True
        while not done.all():
            _, _, terminated, truncated, _ = envs.step(action)
            steps += int((~done).sum())
            ended = terminated | truncated
            done |= ended
            if ended.any() and not done.all():
                envs.reset(options={"reset_mask": ended})
    report("gymnasium", time.perf_counter() - started, steps)
    envs.close()

if __name__ == "__main__":
    main()
"""
TASK = """
def episode(gymnasium_id, seed):
    import os, sys
    sys.path.insert(0, os.environ["BENCH"])
    import bare_loop
    # In a module of the process: each task may bring this function, with globals, anew.
    made = vars(bare_loop).setdefault("made", {})
    if gymnasium_id not in made:
        made[gymnasium_id] = bare_loop.make(gymnasium_id)
    return bare_loop.play(made[gymnasium_id], seed)
"""
RAY = """
import ray
ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False, logging_level="error")

@ray.remote(num_cpus=1)
class Player:
    def __init__(self):
        self.env = bare_loop.make(gymnasium_id)

    def play(self, seed):
        return bare_loop.play(self.env, seed)

from ray.util import ActorPool
pool = ActorPool([Player.remote() for _ in range(cores)])
list(pool.map(lambda player, seed: player.play.remote(seed), [1] * cores))
started = time.perf_counter()
steps = sum(pool.map_unordered(lambda player, seed: player.play.remote(seed), bare_loop.seeds(n)))
report("ray", time.perf_counter() - started, steps)
ray.shutdown()
"""
DASK = """
from distributed import Client, LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=cores, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        client.gather([client.submit(episode, gymnasium_id, 1, pure=False) for _ in range(4 * cores)])
        started = time.perf_counter()
        tasks = [client.submit(episode, gymnasium_id, seed, pure=False) for seed in bare_loop.seeds(n)]
        steps = sum(client.gather(tasks))
        report("distributed", time.perf_counter() - started, steps)
"""  # noqa: E501
JOBLIB = """
from joblib import Parallel, delayed

if __name__ == "__main__":
    with Parallel(n_jobs=cores, pre_dispatch="all", batch_size=1) as pool:
        pool(delayed(episode)(gymnasium_id, 1) for _ in range(4 * cores))
        started = time.perf_counter()
        steps = sum(pool(delayed(episode)(gymnasium_id, seed) for seed in bare_loop.seeds(n)))
        report("joblib", time.perf_counter() - started, steps)
"""
PEERS = {
    "Gymnasium AsyncVectorEnv": ("gymnasium", BEGIN + VECTOR),
    "Ray": ("ray", BEGIN + RAY),
    "Dask": ("distributed", BEGIN + TASK + DASK),
    "joblib": ("joblib", BEGIN + TASK + JOBLIB),
}


def played(python: str, program: str, folder: Path, gymnasium_id: str, n: int) -> dict[str, Any] | str:
    """What a program measured; in a text, why it did not."""
    file = folder / "peer.py"  # a file, as their workers import it anew
    file.write_text(program)
    done = subprocess.run(
        [python, file, gymnasium_id, str(n)],
        env=os.environ | {"BENCH": str(HERE), "PYTHONPATH": str(HERE)},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        return f"failed: {(done.stderr.strip().splitlines() or ['no output'])[-1]}"
    return dict(json.loads(lines[-1]))


def has(python: str, module: str) -> bool:
    code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is None)"
    return subprocess.run([python, "-c", code], check=False).returncode == 0


def main() -> None:
    options = frame.options(
        __doc__,
        env=(ENVIRONMENTS, "ids"),
        episodes=(32, "cases"),
        python=(sys.executable, "the Python that the peers are installed for"),
        json=(Path, "also write all numbers to this file"),
    )

    console, n = frame.console(), options.episodes
    found: dict[str, dict[str, Any]] = {}
    versions: dict[str, str] = {"evopolicy": f"evopolicy {__version__}"}
    skipped: dict[str, str] = {
        name: f"no module {module!r} for {options.python}"
        for name, (module, _) in PEERS.items()
        if not has(options.python, module)
    }
    with tempfile.TemporaryDirectory(prefix="evopolicy-peers-") as name:
        folder = Path(name)
        for env in catalogue.resolve(options.env):
            gymnasium_id = str(catalogue.entry(env).gymnasium_id)
            bare = played(sys.executable, BEGIN + BARE, folder, gymnasium_id, n)
            if isinstance(bare, str):
                raise SystemExit(f"the bare loop of {env} {bare}")
            row: dict[str, Any] = {"bare": bare["seconds"], "steps": bare["steps"]}
            row["evopolicy"] = submit_time(env, n, accelerations=True)
            for peer, (_, program) in PEERS.items():
                if peer in skipped:
                    continue
                result = played(options.python, program, folder, gymnasium_id, n)
                if isinstance(result, str):
                    row[peer] = result
                elif result["steps"] != bare["steps"]:
                    row[peer] = f"other steps: {result['steps']}, bare loop {bare['steps']}"
                else:
                    row[peer], versions[peer] = result["seconds"], result["version"]
            found[env] = row
    columns = ["evopolicy", *(peer for peer in PEERS if peer not in skipped)]
    cores = len(os.sched_getaffinity(0))
    title = f"{n} episodes on {cores} cores over the bare loop on one (load {os.getloadavg()[0]:.1f})"
    table = frame.table("environment", *columns, title=title)
    for env, row in found.items():
        cells = [row[column] for column in columns]
        table.add_row(env, *(one if isinstance(one, str) else f"{one / row['bare']:.2f}" for one in cells))
    console.print(table)
    console.print("; ".join(versions.values()))
    for peer, why in skipped.items():
        console.print(f"skipped: {peer}: {why}")
    frame.save(options.json, {"rows": found, "versions": versions, "skipped": skipped})


if __name__ == "__main__":
    main()
