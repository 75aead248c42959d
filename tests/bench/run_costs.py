"""Processor time, wall time and disk of whole runs, as the page *What a run costs* has them.

    make bench-costs
    make bench-costs ARGS="--budget 16 --only random llm"

Each run is `evopolicy local` on two slots with the suite's hidden cases and a state of its own. The LLM agent's model
is the tests' API on loopback, which answers at once, and makes eight submits: the row has everything but the model.
Time is counted by a cgroup, for which it runs as root.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import frame
from machines.cgroups import counted
from stages.model_api import ModelApi, Step

from evopolicy_common.records.run_files import read_record

ROOT = Path(__file__).parents[2]
SUBMIT = (
    "echo '# edit' >> system/policy.py; curl -sS --noproxy '*' -d '{{\"env_instances\": \"0-{last}\"}}'"
    " $EVOPOLICYGYM_SUBMIT_URL"
)
MODEL = 'harness = "llm"\nmodel = "m"\n[api]\nbase_url = "{}/v1"\nkey = "BENCH_KEY"\n'
ROWS = (
    ("random", "gym/acrobot"),
    ("replay", "gym/acrobot"),
    ("llm", "gym/acrobot"),
    ("evolve", "gym/acrobot"),
    ("evolve", "gym/continuouscar"),
    ("evolve", "gym/halfcheetah5"),
)
N_SUBMITS = 8


def main() -> None:
    agents = sorted({agent for agent, _ in ROWS})
    given = frame.options(__doc__, budget=(128, "train episodes of a run"), only=(agents, "agents"))
    print("agent    environment         submits  CPU s  wall s  agent s  run MB  state MB", flush=True)
    for agent, env in ROWS:
        if agent in given.only:
            print(measured(agent, env, given.budget), flush=True)


def measured(agent: str, env: str, budget: int) -> str:
    with tempfile.TemporaryDirectory(prefix="evp-costs-") as name:
        folder = Path(name)
        command = [
            str(Path(sys.executable).with_name("evopolicy")),
            "local",
            "--env",
            env,
            "--state",
            "state",
        ]
        command += ["--budget", str(budget), "--entry", agent, "--exp-id", "x", "--agent"]
        last = max(1, budget // N_SUBMITS) - 1
        with (
            counted() as group,
            ModelApi([Step(command=SUBMIT.format(last=last)) for _ in range(N_SUBMITS)]) as api,
        ):
            (folder / "llm.toml").write_text(MODEL.format(api.base_url))
            policies = ROOT / "examples" / "policies"
            forms = {"llm": "file:llm.toml", "replay": f"replay:{policies}"}
            began = time.monotonic()
            done = subprocess.run(
                [*command, forms.get(agent, agent)],
                cwd=folder,
                env=os.environ | {"BENCH_KEY": "sk-bench-0123456789abcdef"},
                preexec_fn=lambda: group.add(os.getpid()),
                capture_output=True,
                text=True,
                check=False,
            )
            cpu_s = group.cpu_s()
        assert done.returncode == 0, done.stdout + done.stderr
        wall = time.monotonic() - began
        (run,) = folder.glob("runs/*/*/x")
        record = read_record(run)
        submits = len(list((run / "checkpoints").glob("submit_*")))
        return (
            f"{agent:8} {env:19} {submits:7}  {cpu_s:5.0f}  {wall:6.0f}  {record.timing.agent_s:7.0f}"
            f"  {megabytes(run):6.1f}  {megabytes(folder / 'state'):8.1f}"
        )


def megabytes(folder: Path) -> float:
    return sum(path.lstat().st_blocks * 512 for path in folder.rglob("*")) / 1e6


if __name__ == "__main__":
    main()
