"""Audits read actions by themselves from the store, and compare recordings whatever a worker reports."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs.store_rows import blob, outcome_row, run_row, state_row

from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.rendered import MAGIC
from evopolicy_common.records.episodes.trajectory import Recorder, decode
from evopolicy_coordinator.core.contract.effects import CompareAudit, PrepareAudit
from evopolicy_coordinator.core.contract.events import AuditCompared, AuditPrepared
from evopolicy_coordinator.core.contract.records import AuditRow, OutcomeRow
from evopolicy_coordinator.server import auditing
from evopolicy_coordinator.storage.disk_use import collect
from evopolicy_coordinator.storage.store import Reader, Store

GROUP = "r-1/s0/train"
ACTIONS = [np.array([0.25], np.float32), [1, 2.5], {"a": float("nan")}, np.float64(-0.0), None, "left"]


def recording(*rewards: float, actions: list[Any] | None = None, obs: float = 0.0) -> bytes:
    recorder = Recorder("full")
    for t, reward in enumerate(rewards):
        action = (actions or ACTIONS)[t % len(actions or ACTIONS)]
        recorder.append(np.array([obs, t]), action, reward, t + 1 == len(rewards), False, {"x": 1.0})
    return recorder.finish()


def played(data: bytes, **changes: Any) -> EpisodeOutcome:
    outcome = outcome_row(GROUP, 0, 0, blob(data)).outcome
    values = {"episode_return": 3.0, "length": 2, **changes}
    return msgspec.structs.replace(outcome, **values)


def rendered(rows: bytes) -> bytes:
    """An honest log beside made-up feedback files."""
    file = {"name": "trajectory.jsonl", "size": len(rows), "packed": "as it is"}
    header = msgspec.msgpack.encode({"observations": "arrays", "n": 2, "files": [file]})
    parts = (header, recording(1.0, 2.0), rows)
    return MAGIC + b"".join(len(part).to_bytes(4, "little") + part for part in parts)


class Shelf:
    """A store with outcomes in it."""

    def __init__(self, root: Path) -> None:
        self.store = Store(root / "db")
        self.blobs = BlobStore(root / "blobs")
        self.reader = Reader(root / "db")

    def put(self, group: str, outcome: EpisodeOutcome) -> None:
        row = msgspec.structs.replace(outcome_row(group, 0, 0), outcome=outcome)
        assert isinstance(row, OutcomeRow)
        self.store.write([row])

    def prepare(self) -> AuditPrepared:
        effect = PrepareAudit(run="r-1", audit="a", group=GROUP, index=0)
        event = auditing.carry_out(effect, self.reader, self.blobs)
        assert isinstance(event, AuditPrepared)
        return event

    def compare(self, *replays: str) -> AuditCompared:
        effect = CompareAudit(run="r-1", audit="a", group=GROUP, index=0, replays=replays)
        event = auditing.carry_out(effect, self.reader, self.blobs)
        assert isinstance(event, AuditCompared)
        return event


@pytest.fixture
def shelf(tmp_path: Path) -> Shelf:
    return Shelf(tmp_path)


def test_an_auditor_gets_the_actions_without_their_results(shelf: Shelf) -> None:
    data = recording(*(float(k) for k in range(1, 7)), obs=7.0)
    shelf.put(GROUP, played(data))
    event = shelf.prepare()
    assert event.actions is not None
    given_out = decode(shelf.blobs.read(event.actions.digest))
    assert given_out.record == "actions"
    assert not given_out.rewards.any()
    assert not given_out.terminated.any()
    for row, recorded in zip(given_out.rows(), decode(data).rows(), strict=True):
        assert (type(row.action), repr(row.action)) == (type(recorded.action), repr(recorded.action))


@given(st.lists(st.floats(width=32), min_size=1, max_size=30))
def test_actions_of_one_form_come_back_bit_for_bit(values: list[float]) -> None:
    actions = [np.array([value], np.float32) for value in values]
    packed = decode(compare.action_log(actions))
    assert [row.action.tobytes() for row in packed.rows()] == [action.tobytes() for action in actions]


def test_what_is_no_recording_is_its_players_fault(shelf: Shelf) -> None:
    shelf.put(GROUP, played(b"nonsense"))
    event = shelf.prepare()
    assert event.actions is None
    assert event.at_fault


def test_what_the_store_has_lost_is_nobodys_fault(shelf: Shelf) -> None:
    lost = msgspec.structs.replace(blob(recording(1.0)), inline=None)
    shelf.put(GROUP, msgspec.structs.replace(played(b""), trajectory=lost))
    event = shelf.prepare()
    assert event.actions is None
    assert not event.at_fault
    shelf.put("replay.1", played(recording(1.0)))
    assert shelf.compare("replay.1").error
    assert shelf.compare("replay.2").error


@pytest.mark.parametrize(
    ("forged", "difference"),
    [
        (played(recording(1.0, 2.0)), None),
        (played(recording(1.0, 2.0), stdout=b"another policy's words", wall_s=9.0), None),
        (played(recording(1.0, 2.5)), "step 1: reward"),
        (played(recording(1.0, 2.0), episode_return=math.nextafter(3.0, 4.0)), "episode return"),
        (played(recording(1.0, 2.0), length=3), "length"),
        (played(recording(1.0, 2.0), reward_components={"x": 1.0}), "reward components"),
        (played(recording(1.0, 2.0, obs=0.5)), "step 0: the observations differ"),
        (played(recording(1.0, 2.0, 3.0)), "step 1: terminated"),
        (played(compare.action_log([1, 2])), "records of actions, arrays and of full, arrays"),
        (played(b"nonsense"), "cannot be read"),
        # Its return is forged, and a comparison of its rows fails.
        *(
            (played(rendered(rows), episode_return=9.0), "cannot be compared")
            for rows in (b"", b"1\n", b"{}\n{}\n", b"]\n]\n")
        ),
        (
            played(recording(1.0, 2.0), reward_components={f"{k:1000}": 1.0 for k in range(9)}),
            "reward components",
        ),
    ],
)
def test_whatever_differs_is_reported(shelf: Shelf, forged: EpisodeOutcome, difference: str | None) -> None:
    shelf.put(GROUP, forged)
    shelf.put("replay.1", played(recording(1.0, 2.0)))
    compared = shelf.compare("replay.1")
    assert (compared.error, compared.replay, compared.with_first) == ("", 1, None)
    if difference is None:
        assert compared.with_player is None
    else:
        assert compared.with_player is not None
        assert difference in compared.with_player
        assert len(compared.with_player) <= auditing.MAX_TEXT


def test_a_third_opinion_is_held_against_both(shelf: Shelf) -> None:
    shelf.put(GROUP, played(recording(9.0, 2.0)))
    shelf.put("replay.1", played(recording(1.0, 2.0)))
    shelf.put("replay.2", played(recording(1.0, 2.0)))
    compared = shelf.compare("replay.1", "replay.2")
    assert compared.replay == 2
    assert compared.with_player is not None
    assert compared.with_first is None


def test_audits_of_unfinished_runs_survive_restarts_and_collection(tmp_path: Path) -> None:
    root = tmp_path / "state"
    root.mkdir()
    store = Store(root / "coordinator.sqlite")
    blobs = BlobStore(root / "blobs")
    digest = blobs.put(b"actions")
    orphan = blobs.put(b"orphan")
    row = AuditRow(
        run="r-1",
        audit=f"{GROUP}/audit-0",
        group=GROUP,
        index=0,
        kind="train",
        submit_index=0,
        player="w",
        numerics="n",
        actions=msgspec.structs.replace(blob(b"actions"), inline=None),
    )
    store.write([run_row(), state_row(), row, msgspec.structs.replace(row, audit="other", run="r-2")])
    assert store.load().audits == (row,)
    store.close()
    collect(root, 0.0, now=4e9)
    assert blobs.has(digest)
    assert not blobs.has(orphan)
