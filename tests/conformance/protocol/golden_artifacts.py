"""The artifacts of one run as texts that do not change from run to run: times, names and machines are taken out.

`PYTHONPATH=tests/support python tests/conformance/protocol/golden_artifacts.py` writes the golden files anew.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from commands import agent
from played import play

GOLDEN = Path(__file__).parent / "golden"
BUDGET = 5
AGENT = '''
from pathlib import Path

POLICY = """import numpy as np


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.t = 0
        print("made for", env_meta["env"])

    def reset(self, episode_index):
        self.t = 0

    def act(self, obs):
        self.t += 1
        if self.t > FAILS_AFTER:
            raise ValueError("no more ideas")
        return np.clip(4.0 * (obs[2:] - obs[:1]) - 5.0 * obs[1:2], -1.0, 1.0)
"""


system = Path("system")
(system / "notes.txt").write_text("kept")
(system / "policy.py").write_text(POLICY.replace("FAILS_AFTER", "1000"))
submit("0")
(system / "policy.py").write_text("import no_such_module")
submit([1])
submit([99])
(system / "policy.py").write_text(POLICY.replace("FAILS_AFTER", "2"))
submit([2, 1])
(system / "policy.py").unlink()
submit([3])
'''

_TIMES = re.compile(r"(^|_)(at|time|timestamp|start_time|end_time|wall_time_seconds)$")
_MACHINE = {
    *("run", "committed", "fingerprint", "harness_version", "installations", "program", "agents_md_hash"),
    *("rules_hash", "initial_policy_hash", "traceback"),
}
"""Names of what changes with machine, version or run."""


def artifacts(run: Path) -> dict[str, str]:
    """Golden file name to its text, of a run of `AGENT`."""
    feedback, checkpoints = run / "workspace" / "feedback", run / "checkpoints"
    last = feedback / "submit_002"
    found = {
        "run.json": _json(run / "run.json", _record),
        "_meta.json": _json(checkpoints / "submit_000" / "_meta.json", None),
        "metrics.json": _json(checkpoints / "submit_000" / "metrics.json", None),
        "summary.json": _json(feedback / "submit_000" / "summary.json", None),
        "summary.import_error.json": _json(feedback / "submit_001" / "summary.json", None),
        "summary.missing_policy.json": _json(feedback / "submit_003" / "summary.json", None),
        "summary.policy_failed.json": _json(last / "summary.json", _without_numbers),
        "errors.txt": _lines(feedback / "submit_001" / "errors.txt"),
        "error.txt": _lines(last / "episodes" / "ep_002" / "error.txt"),
        "trajectory.jsonl": _lines(feedback / "submit_000" / "episodes" / "ep_000" / "trajectory.jsonl"),
        "trajectory.policy_failed.jsonl": _lines(last / "episodes" / "ep_002" / "trajectory.jsonl"),
        "stdout.txt": (feedback / "submit_000" / "episodes" / "ep_000" / "stdout.txt").read_text(),
        "env.log": _lines(run / "logs" / "env.log", None),
    }
    tree = sorted(path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file())
    return found | {"tree.txt": "".join(f"{path}\n" for path in tree)}


def _json(path: Path, more: Callable[[Any], Any] | None) -> str:
    document = _plain("", json.loads(path.read_bytes()))
    return json.dumps(document if more is None else more(document), indent=2, ensure_ascii=False) + "\n"


def _lines(path: Path, most: int | None = 4) -> str:
    rows = [_row(_plain("", json.loads(line))) for line in path.read_text().splitlines()[:most]]
    return "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)


def _row(value: Any) -> Any:
    """Once a policy has failed its episode's actions are the run's own random ones, and so is what comes of them."""
    if isinstance(value, dict) and (value.get("info") or {}).get("policy_failed"):
        return _without_numbers(value)
    if isinstance(value, dict) and value.get("submit_index") == 2:
        return _without_numbers(value)
    return value


def _record(record: Any) -> Any:
    """Of submit 2, whose episodes are random, every score is taken out."""
    record["outcome"]["val_scores"]["2"] = "<random>"
    record["versions"]["harness"] = record["versions"]["env"] = "<version>"
    record["agent"]["resources"] = "<resources>"
    record["timing"] = dict.fromkeys(record["timing"], "<time>")
    return record


def _without_numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_numbers(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_without_numbers(each) for each in value]
    return "<random>" if isinstance(value, float) else value


def _plain(name: str, value: Any) -> Any:
    if value is None:
        return None
    if _TIMES.search(name):
        return "<time>"
    if name in _MACHINE or (name == "agent" and isinstance(value, str)):
        return f"<{name}>"
    if isinstance(value, dict):
        return {key: _plain(key, each) for key, each in value.items()}
    if isinstance(value, list):
        return [_plain("", each) for each in value]
    return value


def play_golden(root: Path) -> Path:
    """The run directory of `AGENT`."""
    agent(root, AGENT)
    return play(root, root / "agent.py", BUDGET)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as root:
        for name, text in artifacts(play_golden(Path(root))).items():
            (GOLDEN / name).write_text(text)
