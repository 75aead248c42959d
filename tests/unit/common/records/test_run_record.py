"""The files of a run directory: field order, what may be left out, what is skipped and what refused."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from evopolicy_common.errors import ProtocolError
from evopolicy_common.records.policies.checkpoints import read_meta
from evopolicy_common.records.run_record import (
    RECORD_VERSION,
    Agent,
    ExperimentDimensions,
    Outcome,
    RunRecord,
    Timing,
    Versions,
    decode_run_record,
    encode_run_record,
)
from evopolicy_common.records.summary import SCHEMA_VERSION, Summary, decode_summary, utc_text

NAMES = """
schema_version submit_index env status n_episodes first_global_episode env_instances remaining_budget submit_started_at
submit_completed_at wall_time_seconds returns mean_return std_return min_return max_return episode_lengths
mean_episode_length timeouts errors
"""
FIELDS = NAMES.split()
NOT_OK = Summary(
    schema_version=SCHEMA_VERSION,
    submit_index=3,
    env="toy/line",
    status="import_error",
    n_episodes=4,
    first_global_episode=None,
    env_instances=(2, 2, 0, 1),
    remaining_budget=100,
    submit_started_at=utc_text(0.0),
    submit_completed_at=utc_text(1.25),
    wall_time_seconds=1.25,
    **dict.fromkeys(FIELDS[11:]),  # type: ignore[arg-type]
)

RECORD = RunRecord(
    model="m",
    env="toy/line",
    exp_id="e",
    agent=Agent(entry="m", harness="evolve"),
    sandbox_tier="bwrap",
    jail="bwrap",
    experiment_dimensions=ExperimentDimensions(
        episode_budget=8,
        min_episodes_per_submit=1,
        max_episodes_per_submit=8,
        policy_scope="episode",
        observations="arrays",
        n_train=4,
        n_validation=2,
        n_heldout=2,
    ),
    timing=Timing(start_time=utc_text(0.0), end_time=utc_text(9.0), wall_time_seconds=9.0),
    outcome=Outcome(status="completed", final_score=1.5, best_submit_index=0, val_scores={"0": 1.0}),
    versions=Versions(
        harness="0.1.0",
        env="line 1",
        agents_md_hash="a",
        data_train_hash="b",
        data_valid_hash="c",
        data_heldout_hash="d",
        fingerprint={"numpy": "2.4.6"},
    ),
)


def test_summary_has_its_fields_in_order_and_nulls_when_not_ok() -> None:
    found = msgspec.to_builtins(NOT_OK)
    assert list(found) == FIELDS
    assert found["returns"] is None
    assert found["first_global_episode"] is None
    assert tuple(found["env_instances"]) == (2, 2, 0, 1)
    assert found["submit_completed_at"] == "1970-01-01T00:00:01.250000Z"
    assert decode_summary(msgspec.json.encode(NOT_OK)) == NOT_OK


def test_reward_components_come_last_and_only_where_there_are_any() -> None:
    more = {"reward_components_mean": {"a": 1.0}, "reward_components_per_episode": ({"a": 1.0},)}
    assert list(msgspec.to_builtins(msgspec.structs.replace(NOT_OK, **more))) == [*FIELDS, *more]


def test_run_record_survives_a_round_trip_and_skips_unknown_fields() -> None:
    data = encode_run_record(RECORD)
    assert decode_run_record(data) == RECORD
    more = json.loads(data) | {"colour": "blue"}
    assert decode_run_record(json.dumps(more).encode()) == RECORD


def test_file_of_a_newer_version_is_refused_by_name() -> None:
    document = json.loads(encode_run_record(RECORD))
    schemas = [{"schema_version": version} for version in (2, "0.2")]
    for newer in (*schemas, *({"record_version": RECORD_VERSION + by} for by in (-1, 1))):
        with pytest.raises(ProtocolError, match=r"run\.json has schema_version .*use the software"):
            decode_run_record(json.dumps(document | newer).encode())
    with pytest.raises(ProtocolError, match="schema_version 2"):
        decode_summary(json.dumps(json.loads(msgspec.json.encode(NOT_OK)) | {"schema_version": 2}).encode())


@pytest.mark.parametrize("data", [b"", b"[]", b"{}", b"\xff", b"[" * 100_000, b'{"submit_index": "one"}'])
def test_bytes_that_are_no_record_are_refused(tmp_path: Path, data: bytes) -> None:
    for decode in (decode_run_record, decode_summary):
        with pytest.raises(ProtocolError, match="not a"):
            decode(data)
    (tmp_path / "_meta.json").write_bytes(data)
    with pytest.raises(ProtocolError, match="not a"):
        read_meta(tmp_path)
