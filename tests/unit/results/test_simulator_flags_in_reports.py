"""A report shows code that looks like a simulator as evidence: where it is, its lines, as text."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_results.reading.reader import load_runs
from evopolicy_results.reading.records import Run
from evopolicy_results.report import write_report
from evopolicy_results.simulators.look import look
from evopolicy_results.studies.study import study

SIMULATOR = """\
def future(x, v, gain):
    total = 0.0  # <script>alert(1)</script> =cmd()
    for _ in range(40):
        u = max(-1.0, min(1.0, -gain * x))
        v = v + 0.05 * (u - 0.1 * v)
        x = x + 0.05 * v
        total -= x * x
    return total


BEST = max((0.5, 1.0, 2.0), key=lambda gain: future(1.0, 0.0, gain))
"""
HONEST = Version(policy(gain=1.0), (-200.0,), -180.0)


def with_simulator(gain: float) -> Version:
    files = policy(gain=gain)
    files["policy.py"] += "\n\n" + SIMULATOR
    return Version(files, (-90.0,), -95.0)


def load(folder: Path) -> Run:
    (run,) = load_runs([folder]).runs
    return run


def test_lines_of_several_submits_are_one_flag(tmp_path: Path) -> None:
    run = load(write_run(tmp_path, [HONEST, with_simulator(2.0), with_simulator(3.0)]))
    (flag,) = run.simulator_flags
    assert (flag.path, flag.submits, flag.kind) == ("system/policy.py", (1, 2), "rollout")
    lines = with_simulator(2.0).files["policy.py"].splitlines()
    assert list(flag.quote) == lines[flag.line - 1 : flag.end_line]
    assert "for _ in range(40):" in flag.quote[0]


def test_files_left_in_the_workspace_are_looked_through(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [HONEST])
    (folder / "workspace" / "scratch" / ".notes").mkdir(parents=True)
    (folder / "workspace" / "scratch" / ".notes" / "train.py").write_text(SIMULATOR)
    (folder / "workspace" / "feedback" / "submit_000" / "copy.py").write_text(SIMULATOR)
    (flag,) = load(folder).simulator_flags
    assert (flag.path, flag.submits, flag.line) == ("workspace/scratch/.notes/train.py", (), 3)


def test_a_here_document_in_the_log_is_looked_through(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [HONEST], log="codex")
    command = f"cd system && python3 - <<'EOF'\n{SIMULATOR}\nEOF\necho done"
    item = {"type": "item.completed", "item": {"type": "command_execution", "command": command}}
    log = folder / "logs" / "agent.jsonl"
    before = len(log.read_text().splitlines())
    log.write_text(log.read_text() + json.dumps(item) + "\n")
    (flag,) = load(folder).simulator_flags
    assert flag.path == f"logs/agent.jsonl:{before + 1}"


def test_a_run_that_may_simulate_is_stamped_and_not_looked_through(tmp_path: Path) -> None:
    run = load(write_run(tmp_path / "runs", [with_simulator(2.0)], simulation="allowed"))
    assert run.simulator_flags == ()
    index = write_report(study([tmp_path / "runs"]), tmp_path / "report")
    assert "1 of 1 runs let their agent simulate" in index.read_text()
    (page,) = (tmp_path / "report" / "traces").glob("*.html")
    assert "This run's rules let its agent simulate" in page.read_text()
    data = json.loads((tmp_path / "report" / "report.json").read_text())
    (row,) = data["tables"]["audit"]["rows"]
    assert (row["simulation"], row["simulator_flags"]) == ("allowed", None)
    assert "simulator_flags" not in data["tables"]


def test_a_report_quotes_the_evidence_as_text(tmp_path: Path) -> None:
    files = policy(gain=1.0)
    files["policy.py"] += "\n\n" + SIMULATOR.replace(
        "        u = max", '        note = "<script>alert(2)</script>"\n        u = max'
    )
    write_run(tmp_path / "runs", [Version(files, (-90.0,), -95.0)])
    write_run(tmp_path / "runs", [HONEST], entry="Honest")
    index = write_report(study([tmp_path / "runs"]), tmp_path / "report").read_text()
    assert "1 of 2 runs have code that looks like a simulator" in index
    assert "never a verdict" in index
    (page,) = (tmp_path / "report" / "traces").glob("*Agent-A*.html")
    for text in (index, page.read_text()):
        assert "<script>alert(2)" not in text
        assert "&lt;script&gt;alert(2)" in text
    (honest,) = (tmp_path / "report" / "traces").glob("*Honest*.html")
    assert "None was found in the checkpoints" in honest.read_text()
    data = json.loads((tmp_path / "report" / "report.json").read_text())
    (row,) = data["tables"]["simulator_flags"]["rows"]
    assert (row["file"], row["submits"], row["kind"]) == ("system/policy.py", "s000", "rollout")
    assert {r["entry"]: r["simulator_flags"] for r in data["tables"]["audit"]["rows"]} == {
        "Agent A": 1,
        "Honest": 0,
    }


HOSTILE = {
    "nested loops": "\n".join("    " * depth + f"for a{depth} in b{depth}:" for depth in range(18)) + "\n" + "    " * 18 + "x = x * a1",
    "many loops": "def f(x, plan):\n" + "    for u in plan:\n        x = x + u * x\n" * 4000,
    "many functions": "".join(f"def f{k}(x):\n    return f{k + 1}(x) * f{k + 1}(x + 1) + f{k + 1}(2 * x)\n" for k in range(400))
    + "for t in range(9):\n    y = f0(y)\n",
    "one name": "def f(x):\n    for t in range(9):\n        x = f(f(f(f(x)))) * x\n    return x\n" * 500,
    "long sum": "x = 0\nfor t in range(9):\n    x = " + " + ".join(f"x * a{k}" for k in range(900)),
    "many texts": "T = [" + ",".join(repr("for a in b:\n    c = 1\n\n\n" * 300) for _ in range(60)) + "]",
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_no_source_takes_long(name: str) -> None:
    look({"policy.py": HOSTILE[name].encode()}, "gym/acrobot")
