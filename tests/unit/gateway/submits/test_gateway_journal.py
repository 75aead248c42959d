"""The gateway's journal and the small files of a run's folder, also damaged ones."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs.finished_run import mark_opened

from evopolicy_common.errors import ConfigError, StorageError
from evopolicy_common.messages.gateway import Submit, SubmitAccepted
from evopolicy_common.records.open_run import (
    AnyLine,
    Rejected,
    Settled,
    SubmitRequested,
)
from evopolicy_common.records.run_record import RejectedSubmit
from evopolicy_gateway.run_folder.journal import Journal
from evopolicy_gateway.run_folder.layout import RunFolder

REQUESTED = SubmitRequested(
    submit=Submit(key="k", env_instances=(1, 2), bundle="b" * 64), client_key=None, body_digest="d"
)
ENTRIES: list[AnyLine] = [
    REQUESTED,
    SubmitAccepted(submit_index=0, first_global_episode=0, remaining_budget=3),
    Settled(key="k", status="ok", summary='{\n  "a": "é\u2028"\n}\n'),
    Rejected(submit=RejectedSubmit(status="budget_invalid", message="no", at="1.5", after_submits=1)),
]


def entries_in(path: Path) -> list[AnyLine]:
    journal = Journal(path)
    journal.close()
    return list(journal.entries.values())


def written(path: Path) -> bytes:
    journal = Journal(path)
    for entry in ENTRIES:
        journal.append(entry)
    journal.close()
    return path.read_bytes()


def test_appended_entries_are_read_back(tmp_path: Path) -> None:
    written(tmp_path / "j")
    assert entries_in(tmp_path / "j") == ENTRIES
    assert (tmp_path / "j").stat().st_mode & 0o077 == 0


def test_a_journal_cut_anywhere_keeps_its_whole_lines_and_goes_on(tmp_path: Path) -> None:
    data = written(tmp_path / "j")

    @given(st.integers(0, len(data)))
    def check(cut: int) -> None:
        path = tmp_path / "cut"
        path.write_bytes(data[:cut])
        journal = Journal(path)
        whole = data[:cut].count(b"\n")
        assert list(journal.entries.values()) == ENTRIES[:whole]
        journal.append(ENTRIES[-1])
        journal.close()
        assert entries_in(path) == [*ENTRIES[:whole], ENTRIES[-1]]

    check()


def test_a_line_is_read_again_from_its_place(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j")
    places = [journal.append(entry) for entry in ENTRIES]
    journal.close()
    journal = Journal(tmp_path / "j")
    assert list(journal.entries) == places
    assert [journal.read_line(place) for place in places] == ENTRIES
    journal.close()


def test_a_damaged_line_in_the_middle_is_reported(tmp_path: Path) -> None:
    data = written(tmp_path / "j")
    (tmp_path / "j").write_bytes(b"junk\n" + data)
    with pytest.raises(StorageError, match="line 1"):
        Journal(tmp_path / "j")


def test_a_line_that_the_disk_refuses_is_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path / "j")
    journal.append(REQUESTED)

    def full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(StorageError, match="No space left"):
            journal.append(ENTRIES[1])
    journal.append(ENTRIES[2])
    journal.close()
    assert entries_in(tmp_path / "j") == [REQUESTED, ENTRIES[2]]


def test_a_file_that_a_disk_has_damaged_is_reported(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.state.mkdir()
    mark_opened(folder)
    assert folder.run == "r-1"
    for damaged in (b"", b"{", b"\xff", b"[" * 100_000, b'{"run": 1}'):
        folder.intended.write_bytes(damaged)
        with pytest.raises(ConfigError, match=f"{folder.intended} is damaged.*--overwrite"):
            _ = folder.run
