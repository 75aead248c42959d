"""What it costs that hidden episodes and agents never share a machine: the same sweep with the rule and without, on one
machine, and with the rule and workers that report another kernel, as if they were on another machine.

    make bench-isolation
    make bench-isolation ARGS="--agents 2 --environments toy --repeats 2 --parallel 2"

Agents are uniform random ones with tiny budgets, so nearly all of a run is starting, waiting and scoring: the rule's
worst case.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import frame

from evopolicy_common.records.run_record import RunRecord, decode_run_record

SUITE = """
name = "isolation"
environments = [{environments}]
[defaults]
budget = {budget}
repeats = {repeats}
validation = {validation}
heldout = {heldout}
[parallel]
machine = {parallel}
"""
AGENT = '[[agents]]\nname = "{}"\nagent = "random"\n'
APART = """
import sys
if "evopolicy_worker.cli" in sys.orig_argv:
    from evopolicy_common.processes import proc
    proc.boot_id = lambda: "another-kernel"
"""
RULES = {"off": "shared", "related": "exclusive", "apart": "exclusive"}
"""Each sweep, and the stamp of its runs."""
PHASES = ("agent_s", "queue_s", "rollout_s", "feedback_s", "permit_s", "held_s", "finalise_s")


def main() -> None:
    options = frame.options(
        __doc__,
        agents=(4, "of the sweep"),
        environments=(["core16"], "suites, ids or globs"),
        repeats=(1, "of each agent and environment"),
        parallel=(4, "agents at once"),
        slots=(os.cpu_count() or 1, "of the worker"),
        budget=(4, "train episodes of a run"),
        validation=(2, "cases"),
        heldout=(4, "cases"),
    )
    text = SUITE.format(
        **{**vars(options), "environments": ", ".join(f'"{name}"' for name in options.environments)}
    ) + "".join(AGENT.format(f"random-{number}") for number in range(options.agents))
    load = os.getloadavg()[0]
    walls: dict[str, float] = {}
    records: dict[str, list[RunRecord]] = {}
    with tempfile.TemporaryDirectory(prefix="evp-isolation-") as root:
        for rule in RULES:
            walls[rule], records[rule] = sweep(Path(root) / rule, text, rule, options.slots)
    n = len(records["related"])
    print(
        f"{n} runs of {options.agents} agents, {options.parallel} at once, {options.slots} slots, {os.cpu_count()}"
        " cores"
    )
    print(f"load average before: {load:.1f}")
    print(
        "wall time: "
        + ", ".join(f"{rule} {wall:.0f} s ({wall / walls['off']:.2f})" for rule, wall in walls.items())
    )
    print("seconds a run, in the mean:")
    for phase in PHASES:
        line = "  ".join(
            f"{rule} {sum(getattr(one.timing, phase) for one in records[rule]) / n:7.2f}" for rule in RULES
        )
        print(f"  {phase:<11}{line}")
    retries = {
        rule: sum(int(one.outcome.auxiliary.get("infrastructure_retries", 0)) for one in found)
        for rule, found in records.items()
    }
    print("episodes played again: " + ", ".join(f"{rule} {n}" for rule, n in retries.items()))


def sweep(root: Path, text: str, rule: str, slots: int) -> tuple[float, list[RunRecord]]:
    """Wall seconds, and what came of the runs."""
    root.mkdir(parents=True)
    (root / "suite.toml").write_text(text)
    started = time.monotonic()
    isolation = "off" if rule == "off" else "related"
    words = [
        "suite",
        str(root / "suite.toml"),
        "--local",
        "--slots",
        str(slots),
        "--hidden-isolation",
        isolation,
    ]
    if rule == "apart":
        (root / "sitecustomize.py").write_text(APART)
    with (root / "events.jsonl").open("wb") as events:
        code = subprocess.run(
            [sys.executable, "-m", "evopolicy_gateway.cli", *words, "--runs", str(root / "runs"), "--json"],
            env={**os.environ, "XDG_STATE_HOME": str(root / "xdg"), "PYTHONPATH": str(root)},
            stdout=events,
            check=False,
        ).returncode
    if code:
        lines = [line for line in (root / "events.jsonl").read_text().splitlines() if '"error":"' in line]
        raise SystemExit(f"the sweep ended with exit code {code}: " + "\n".join(lines[:5]))
    wall = time.monotonic() - started
    files = sorted((root / "runs").glob("*/*/*/run.json"))
    found = [decode_run_record(file.read_bytes()) for file in files]
    assert {one.hidden_isolation for one in found} == {RULES[rule]}
    return wall, found


if __name__ == "__main__":
    main()
