"""`make bench-replay`: how far real coding agents are replayed.

Each CLI plays runs in its jail whose model, a script on loopback, edits a policy, submits and reads the
feedback. No two scripts are equal. `ordinary` ones do what an agent does in most runs; `hard` ones use slow
and background commands, unsorted listings, all variables and calls at once, and every fifth prints a value
that no replay repeats (`CHANCE`). Each run is recorded with `--record-model full` and replayed. It prints a
line for each run: its script, its steps, its calls, and `identical`, or the first place that differs.
`EVOPOLICY_REAL_CLIS` names the folder of the CLIs, as tests/integration/gateway/agents/test_real_clis.py
tells. Asserts nothing.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import re
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import frame
from commands import evopolicy, worker_of
from coordinator_harness import Coordinator
from rich.console import Console
from stages.model_api import ModelApi, Step

from evopolicy_common.records import model_record

CLIS = {
    "codex": ("codex", "openai", "gpt-5.5"),
    "claude-code": ("claude", "anthropic", "claude-opus-4-7"),
    "qwen": ("qwen", "openai", "qwen3-coder-plus"),
}
"""Program, protocol, and model of each harness."""
QWEN = Path(__file__).parents[2] / "examples" / "agents" / "qwen.toml"
ENVS = ("gym/acrobot", "gymnasium/MiniGrid-Empty-5x5-v0")
POLICY = """class Policy:
 def __init__(self, *a): pass
 def reset(self, i): pass
 def act(self, obs): return {}
"""
USUAL = {
    "error": "python3 system/none.py; cat none; ls /none; exit 3",
    "traceback": "cd system && python3 -c 'from policy import Policy as P; raise ValueError(P(), P.act)'",
    "long": "seq 1 30000",
    "listing": "date; ls -la . system; ls -la --time-style=full-iso feedback; stat system/policy.py;"
    " git status",
    "search": "find . -type f; grep -rn return system; ls -RlU feedback | head -40",
    "feedback": "cat feedback/*/summary.json; find feedback -type f | head -20 | xargs head -c 600",
    "timed": "time python3 -c 'print(sum(range(100000)))'",
    "machine": "uname -a; id; nproc; python3 --version; env | sort; pwd; which python3 git node",
    "background": "sleep 0.2 & wait; jobs; echo done",
    "unit test": "printf 'import unittest\\nclass T(unittest.TestCase):\\n def test(self): pass\\n' > t.py;"
    " python3 -m unittest t; rm -r t.py __pycache__",
}
"""Commands of any hard script."""
CHANCE = {
    "a process id": "echo $$; sleep 0.1 & echo $!; wait",
    "a temporary name": "mktemp -d",
    "a time of its own": "python3 -c 'import time; print(time.perf_counter())'",
    "use of memory": "cat /proc/meminfo | head -3; cat /proc/loadavg",
}


Script = tuple[str, int, list[Step], list[str]]
"""Environment, budget, steps, and words on what they are."""


def submit(n: int) -> Step:
    ids = json.dumps({"env_instances": list(range(n))})
    kind = "-H 'Content-Type: application/json'"
    return Step(command=f"curl -sS --noproxy '*' -X POST {kind} -d '{ids}' $EVOPOLICYGYM_SUBMIT_URL")


def found(pattern: str, name: str, **more: Any) -> Any:
    """Arguments with the last value in the request that the pattern finds."""

    def given(request: str) -> dict[str, Any]:
        value = (re.findall(pattern, request) or ["0"])[-1]
        return {name: int(value) if value.isdecimal() else value, **more}

    return given


def in_workspace(path: str, **more: Any) -> Any:
    """Arguments with the path of a file in the workspace, whose own path is in the request."""

    def given(request: str) -> dict[str, Any]:
        workspace = re.findall(r"(/[^\s\"\\]*/workspace)", request)[0]
        return {"file_path": f"{workspace}/{path}", **more}

    return given


def own_tools(harness: str, comment: str) -> dict[str, list[Step]]:
    """What only this CLI can do, by name."""
    slow = "for i in 1 2 3 4; do echo $i; sleep 0.7; done"
    if harness == "codex":
        change = f"@@\n class Policy:\n+ # {comment}"
        patch = f"*** Begin Patch\n*** Update File: system/policy.py\n{change}\n*** End Patch"
        return {
            "edit": [
                Step(command="cat system/policy.py"),
                Step(command=f"apply_patch <<'EOF'\n{patch}\nEOF"),
            ],
            "slow": [
                Step(tool="exec_command", given=lambda _: {"cmd": slow, "yield_time_ms": 1000}),
                Step(tool="write_stdin", given=found(r"session ID (\d+)", "session_id", yield_time_ms=9000)),
            ],
        }
    if harness == "qwen":
        return {}
    new = {"old_string": "class Policy:\n", "new_string": f"class Policy:\n # {comment}\n"}
    return {
        "edit": [
            Step(tool="Read", given=in_workspace("system/policy.py")),
            Step(tool="Edit", given=in_workspace("system/policy.py", **new)),
        ],
        "slow": [
            Step(
                tool="Bash", given=lambda _: {"command": slow, "run_in_background": True, "description": "s"}
            ),
            Step(command="sleep 4"),
            Step(tool="Read", given=found(r"(/[^\s\"\\]+\.output)", "file_path")),
        ],
        "search": [
            Step(
                tool="Grep",
                given=lambda _: {"pattern": "return"},
                also=[Step(tool="Glob", given=lambda _: {"pattern": "**/*"})],
            )
        ],
    }


FAILING = (
    *("python3 system/none.py", "cat feedback/submit_009/summary.json"),
    "cd system && python3 -c 'from policy import Policy as P; raise ValueError(P(), P.act)'",
    "python3 -c 'import torch_of_no_machine'",
    "printf 'def f(:\\n' > t.py; python3 t.py; rm t.py; exit 1",
)
POLL = """import json, os, sys, time, urllib.request
url = os.environ["EVOPOLICYGYM_SUBMIT_URL"]
body = json.dumps({"env_instances": list(range(int(sys.argv[1])))}).encode()
open_url = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
asked = urllib.request.Request(url + "?wait=false", body, {"Content-Type": "application/json"})
answer = json.load(open_url(asked))
while answer["status"] == "running":
    time.sleep(0.5)
    answer = json.load(open_url(url + "/" + str(answer["submit_id"])))
print(answer["feedback"], answer["status"], answer["summary"]["mean_return"])
"""
"""The way in Python that AGENTS.md documents."""


def ordinary(harness: str, index: int) -> Script:
    """Reads, edits, submits in a documented way, reads its feedback, edits again; one command fails."""
    rng = random.Random(index)
    n_submits, fails, budget = 2 + index % 4, rng.randrange(3), 0
    tools = harness == "claude-code" and index % 2 == 0
    steps = [Step(command="cat AGENTS.md"), Step(command="ls system; cat system/policy.py")]
    if by_poll := index % 3 == 2:
        steps.append(Step(command=f"cat > submit.py <<'EOF'\n{POLL}EOF"))
    if index % 2:
        steps.insert(1, Step(command="curl -sS --noproxy '*' $EVOPOLICYGYM_INFO_URL"))
    for n in range(n_submits):
        text = POLICY.format((index + n) % 3)
        if index % 5 == 3 and n == 0:
            text = text.replace("return", "raise ValueError(obs) #")
        if n == 0 or index % 4 == 3:
            steps.append(Step(command=f"cat > system/policy.py <<'EOF'\n# try {index}.{n}\n{text}EOF"))
        elif harness == "codex" or tools:
            steps += own_tools(harness, f"try {index}.{n}")["edit"]
        else:
            change = f"s/return .*/return {(index + n) % 3}/"
            steps.append(Step(command=f"sed -i '{change}' system/policy.py && cat system/policy.py"))
        if n == fails % n_submits:
            steps.append(Step(command=FAILING[index % len(FAILING)]))
        episodes = 1 + rng.randrange(3)
        budget += episodes
        steps.append(Step(command=f"python3 submit.py {episodes}") if by_poll else submit(episodes))
        folder = f"feedback/submit_{n:03}"
        if tools:
            steps.append(Step(tool="Read", given=in_workspace(f"{folder}/summary.json")))
        else:
            steps.append(Step(command=f"cat {folder}/summary.json"))
        look = rng.choice(("ls", "ls -la", "cat"))
        if look == "cat":
            look = "head -c 900"
            folder += "/episodes/*/trajectory.jsonl"
        if n < n_submits - 1:
            steps.append(Step(command=f"{look} {folder}"))
    way = "polls" if by_poll else "curl"
    names = [f"{n_submits} submits by {way}", f"fails: {FAILING[index % len(FAILING)].splitlines()[0][:30]}"]
    return ENVS[index % 2], budget, [*steps, Step(text="done")], names


def hard(harness: str, index: int) -> Script:
    """Slow and background commands, unsorted listings, all variables, temporary names, calls at once."""
    rng = random.Random(index)
    names = rng.sample(sorted(USUAL), 4)
    own = own_tools(harness, "edited")
    parts = {name: [Step(command=USUAL[name])] for name in names}
    parts |= {f"own {name}": own[name] for name in rng.sample(sorted(own), min(2, len(own)))}
    first, second = rng.sample(sorted(USUAL), 2)
    both = [Step(command=USUAL[second])]
    parts[f"{first} ∥ {second}"] = [Step(command=USUAL[first], also=both)]
    if index % 5 == 4:
        name = list(CHANCE)[index // 5 % len(CHANCE)]
        parts[name] = [Step(command=CHANCE[name])]
    order = rng.sample(sorted(parts), len(parts))
    steps, budget, n_submits = [], 0, 2 + index % 3
    for n in range(n_submits):
        text = POLICY.format((index + n) % 3)
        steps += [Step(command=f"cat > system/policy.py <<'EOF'\n{text}EOF"), submit(1 + (index + n) % 2)]
        budget += 1 + (index + n) % 2
        for name in order[n::n_submits] if n < n_submits - 1 else ():
            steps += parts[name]
        if n == 0:
            for name in order[n_submits - 1 :: n_submits]:
                steps += parts[name]
        if index % 4 == 1 and n == 0:
            steps.append(Step(text="I am done."))  # and is prompted again
    return ENVS[index % 2], budget, [*steps, Step(text="done")], order


KINDS = {"ordinary": ordinary, "hard": hard}


def agent(harness: str, folder: Path, base_url: str) -> None:
    program, protocol, model = CLIS[harness]
    path = f"{os.environ['EVOPOLICY_REAL_CLIS']}/{program}"
    url = base_url if protocol == "anthropic" else f"{base_url}/v1"
    lines = [f'harness = "{harness}"\nprogram = ["{path}"]\nmodel = "{model}"\nbackoff_s = 0.1\n']
    lines.append(f'[api]\nprotocol = "{protocol}"\nbase_url = "{url}"\nkey = "MODEL_ACCESS"\n')
    if harness == "qwen":
        text = QWEN.read_text()
        lines.append(text[text.index("[cli]") :])
    (folder / "agent.toml").write_text("".join(lines))


def play(harness: str, kind: str, index: int, root: Path, operator: str) -> tuple[str, ...]:
    """A run and its replay, as a row."""
    env, budget, steps, names = KINDS[kind](harness, index)
    folder = root / f"{harness}-{kind}-{index}"
    folder.mkdir()
    with ModelApi(steps) as api:
        agent(harness, folder, api.base_url)
        arguments = ["--env", env, "--budget", str(budget), "--validation", "1", "--heldout", "1"]
        done = evopolicy(
            folder,
            *("run", *arguments, "--agent", "file:agent.toml", "--exp-id", "t", "--record-model", "full"),
            *("--credentials", operator),
        )
        (folder / "run.log").write_text(done.stdout + done.stderr)
    runs = list((folder / "runs").glob("*/*/t"))
    shown = (kind, str(index), env.rpartition("/")[2], ", ".join(names))
    if done.returncode or not runs:
        return (*shown, "", f"not recorded: {done.stderr[-200:]}")
    n_calls = len(model_record.read_calls(runs[0] / model_record.FOLDER))
    done = evopolicy(folder, "replay", str(runs[0]), "--credentials", operator)
    (folder / "replay.log").write_text(done.stdout + done.stderr)
    lines = done.stdout.splitlines() or done.stderr.splitlines()[-1:]
    differs = [next((line for line in lines[3:] if line.startswith(sign)), "")[:160] for sign in "-+"]
    return (*shown, f"{api.played} / {n_calls}", " ⏎ ".join(filter(None, (lines[0][:160], *differs))))


def main() -> None:
    chosen = frame.options(
        __doc__,
        runs=(10, "of each CLI and kind"),
        kinds=(list(KINDS), "of scripts", KINDS),
        clis=(["codex", "claude-code"], "programs", CLIS),
        only=("", "only runs of these numbers, comma separated"),
        parallel=(2, "runs at once"),
        keep=(Path, "keep the runs in this new folder"),
    )
    os.environ["MODEL_ACCESS"] = "key-of-the-bench-0123456789"
    console = Console(width=200)
    with tempfile.TemporaryDirectory(prefix="evopolicy-replays-") as name:
        root = chosen.keep or Path(name)
        root.mkdir(exist_ok=chosen.keep is None)
        with contextlib.ExitStack() as stack:
            coordinator = Coordinator(root / "s")
            stack.callback(coordinator.stop)
            stack.enter_context(worker_of(coordinator, *(f"--env={env}" for env in ENVS)))
            pool = stack.enter_context(ThreadPoolExecutor(chosen.parallel))
            operator = coordinator.ready["credentials"]["operator"]
            for harness, kind in itertools.product(chosen.clis, chosen.kinds):
                rows = []
                numbers = [*map(int, filter(None, chosen.only.split(",")))] or range(chosen.runs)
                for row in pool.map(lambda n: play(harness, kind, n, root, operator), numbers):  # noqa: B023
                    rows.append(row)
                    console.print(" | ".join((harness, *row)), markup=False, highlight=False)
                same = sum(row[-1] == "identical" for row in rows)
                console.print(f"{harness}: {same} of {len(rows)} {kind} replays are identical")


if __name__ == "__main__":
    main()
