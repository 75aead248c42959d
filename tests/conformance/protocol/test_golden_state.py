"""The coordinator's state `golden_state` stays readable: later versions open it and serve its run.

`golden_state/record.py` makes it anew when a release changes the schema or the rows."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from evopolicy_common.records import journal
from evopolicy_common.records.blobs import BlobStore
from evopolicy_coordinator.cli.epochs import app as epochs
from evopolicy_coordinator.core.contract.records import DocumentRow, submit_group
from evopolicy_coordinator.storage import disk_use
from evopolicy_coordinator.storage.store import Reader, Store

GOLDEN_STATE = Path(__file__).parent / "golden_state" / "state"


@pytest.fixture
def state(tmp_path: Path) -> Path:
    copy = tmp_path / "state"
    shutil.copytree(GOLDEN_STATE, copy)
    copy.chmod(0o700)
    return copy


def test_the_golden_state_is_loaded_with_its_finished_run(state: Path) -> None:
    store = Store(state / "coordinator.sqlite")
    snapshot = store.load()
    store.close()
    (run,) = snapshot.runs
    assert (run.settings.env, run.budget, snapshot.states[0].phase) == ("toy/line", 8, "finished")
    assert snapshot.incarnation == 2
    assert snapshot.submits == ()
    assert snapshot.journal is not None
    assert snapshot.journal.seq == 1


def test_the_golden_states_journal_outcomes_and_result_are_read(state: Path) -> None:
    blobs = BlobStore(state / "blobs")
    with contextlib.closing(Reader(state / "coordinator.sqlite")) as reader:
        entries = reader.journal(0, 1 << 20)
        assert [row.head for row in entries] == list(journal.heads([row.entry for row in entries]))
        opened = journal.read_entry(entries[0].entry)
        assert isinstance(opened, journal.Opened)
        finished = reader.finished(opened.run)
        assert finished is not None
        assert finished.heldout_returns
        assert [
            len(reader.outcomes(submit_group(opened.run, n, "train"), 0, 9, 1 << 20)) for n in (0, 1)
        ] == [2, 3]
        assert reader.one(DocumentRow, run=opened.run, kind="result") is not None
        assert all(blobs.read_blob(digest) for digest in reader.bundles(opened.run) if digest is not None)


def test_commands_on_the_golden_state_find_its_run(state: Path) -> None:
    shown = CliRunner().invoke(epochs, ["list", "--state", str(state)])
    assert shown.exit_code == 0, shown.output
    assert "journal: 2 entries" in shown.output
    (use,) = disk_use.use(state)
    assert (use.env, use.runs, use.train_episodes) == ("toy/line", 1, 8)
    assert disk_use.collect(state, 0.0).episodes == 18
