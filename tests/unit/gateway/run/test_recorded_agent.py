"""Refusals of a replay, and its report of the first difference."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.run import recorded_agent
from evopolicy_gateway.run.plan import Plan, Replays
from evopolicy_gateway.run.run_options import RunOptions


def plan(root: Path, runs: str) -> Plan:
    given = RunOptions(agent="evolve", entry="e", runs=root / runs)
    made = given.plan(given.settings("toy/line", "first"), root)
    made.folder.model_record.mkdir(parents=True)
    (made.folder.model_record / "calls.jsonl").touch()
    return made


def written(made: Plan, version: str, score: float) -> Path:
    record: dict[str, Any] = {"versions": {"harness": version, "fingerprint": {"numpy": version}}}
    made.folder.run_json.write_text(json.dumps({**record, "outcome": {"final_score": score}}))
    return made.folder.root


def test_other_versions_explain_a_difference_and_are_none(tmp_path: Path) -> None:
    run, again = written(plan(tmp_path, "runs"), "1.0.0", -13.0), plan(tmp_path, "replayed")
    written(again, "1.0.1", -13.0)
    assert recorded_agent.outcome(run, again) == ""
    written(again, "1.0.1", -7.0)
    assert recorded_agent.outcome(run, again).splitlines() == [
        "run.json: outcome.final_score: -13.0 and -7.0",
        'other versions: run.json: versions.harness: "1.0.0" and "1.0.1"',
        'other versions: run.json: versions.fingerprint.numpy: "1.0.0" and "1.0.1"',
    ]
    written(again, "1.0.0", -7.0)
    assert recorded_agent.outcome(run, again) == "run.json: outcome.final_score: -13.0 and -7.0"


@pytest.mark.parametrize("taken", ["port", "model_port"])
def test_a_taken_port_is_named_with_the_remedy(tmp_path: Path, taken: str) -> None:
    made = plan(tmp_path, "runs")
    written(made, "1.0.0", -13.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        ports = {"port": 0, "model_port": 0, taken: server.getsockname()[1]}
        folder = made.folder
        kept = Replays(
            folder=folder.model_record,
            root=folder.root,
            run="r",
            key="k",
            token="t",
            model_token="m",
            **ports,
        )
        recorded_agent.keep(folder, made, kept)
        with pytest.raises(ConfigError, match=rf"port {ports[taken]} on 127.0.0.1, .*end what listens there"):
            recorded_agent.plan_of(folder.root, tmp_path / "replayed", trusted=True)
