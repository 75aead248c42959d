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


def kept_of(made: Plan, **ports: int) -> Path:
    """The folder of a finished run that can be replayed."""
    root = written(made, "1.0.0", -13.0)
    known = {"run": "r", "key": "k", "token": "t", "model_token": "m"}
    replays = Replays(
        folder=made.folder.model_record, root=root, **known, **{"port": 0, "model_port": 0} | ports
    )
    recorded_agent.keep(made.folder, made, replays)
    return root


def test_a_replay_does_not_take_the_place_of_its_run(tmp_path: Path) -> None:
    root = kept_of(plan(tmp_path, "runs"))
    with pytest.raises(ConfigError, match=r"would take the place of .*choose another --runs"):
        recorded_agent.plan_of(root, tmp_path / "runs", trusted=True)
    assert recorded_agent.plan_of(root, tmp_path / "replayed", trusted=True).overwrite


@pytest.mark.parametrize("taken", ["port", "model_port"])
def test_a_taken_port_is_named_with_the_remedy(tmp_path: Path, taken: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        root = kept_of(plan(tmp_path, "runs"), **{taken: port})
        with pytest.raises(ConfigError, match=rf"port {port} on 127.0.0.1, .*end what listens there"):
            recorded_agent.plan_of(root, tmp_path / "replayed", trusted=True)
