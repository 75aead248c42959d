"""The journal: every run that is opened, what was fixed of it, what became of it, and when its cases became public.

Attacks, each with its defence:
- edit a result: its digest is in the entry that ended the run.
"""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from rigs.core_rig import Rig

from evopolicy_common.messages import operator
from evopolicy_common.messages.operator import Done, RunResult
from evopolicy_common.messages.worker import Refused
from evopolicy_common.records import journal
from evopolicy_common.records.journal import Ended, Opened, Opening, Revealed
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.records import DocumentRow, JournalRow, RunRow, RunStateRow


def entries(rig: Rig) -> list[bytes]:
    rows = sorted((row for row in rig.rows.values() if isinstance(row, JournalRow)), key=lambda row: row.seq)
    assert [row.seq for row in rows] == list(range(len(rows)))
    assert [row.head for row in rows] == journal.heads(row.entry for row in rows)
    return [row.entry for row in rows]


def entries_of(rig: Rig) -> list[journal.EpochEntry]:
    return [journal.read_entry(entry) for entry in entries(rig)]


def disclose(rig: Rig, *runs: str, epochs: tuple[str, ...] = ("e1",)) -> object:
    request = rig.request()
    message = operator.Disclose(token="", runs=runs)
    return rig.tell(events.DisclosureRequested(request=request, message=message, epochs=epochs))


def finish(rig: Rig, session: str = "", **run: Any) -> None:
    """Play run r1 to its end; begin it first where no session is given."""
    session = session or rig.begin(run=run)
    rig.submit(0)
    rig.work_off(session)
    rig.finish(session)


def test_a_run_is_committed_to_in_the_transaction_that_makes_it(rig: Rig) -> None:
    """Attack: choose splits or settings after the agent played. Defence: they do not match the commitment
    in the journal."""
    rig.create(agent=None)
    row = rig.row(RunRow, "r1")
    document = rig.row(DocumentRow, "r1", "opening").data
    (entry,) = entries_of(rig)
    assert isinstance(entry, Opened)
    place = rig.row(RunStateRow, "r1").committed
    assert entry.commitment == place.commitment == journal.commitment(row.salt, document)
    assert (place.opened, place.opened_head) == (0, journal.heads(entries(rig))[0])
    opening = msgspec.json.decode(document, type=Opening)
    assert (opening.train, opening.validation, opening.heldout) == (row.train, row.validation, row.heldout)


def test_what_is_committed_to_tells_nothing_of_the_operators_own(rig: Rig) -> None:
    rig.create(agent=None, notes={"invoice": "4711"}, agent_host="boot-of-mine")
    document = rig.row(DocumentRow, "r1", "opening").data
    assert b"4711" not in document
    assert b"boot-of-mine" not in document
    assert set(msgspec.json.decode(document)) == set(
        Opening.__struct_fields__
    )  # no secret, key, or capability


@pytest.mark.parametrize("cancelled", [False, True])
def test_whatever_becomes_of_a_run_its_result_is_fixed(rig: Rig, cancelled: bool) -> None:
    """Attack: leave out a run that went badly, was cancelled, or was replaced. Defence: its entry stays."""
    session = rig.begin()
    if cancelled:
        rig.ask(operator.CancelRun, run="r1")
    else:
        finish(rig, session)
    opened, ended = entries_of(rig)
    assert isinstance(opened, Opened)
    assert isinstance(ended, Ended)
    finished = rig.finished()
    document = rig.row(DocumentRow, "r1", "result").data
    assert ended.result == journal.digest(document)
    assert msgspec.json.decode(document, type=RunResult) == finished.result
    assert ended.status == finished.status == ("cancelled" if cancelled else "completed")
    assert (finished.committed.ended, finished.committed.ended_head) == (1, journal.heads(entries(rig))[1])


def test_a_run_that_is_asked_for_twice_is_entered_once(rig: Rig) -> None:
    rig.create(key="k", agent=None)
    rig.create("r2", key="k", agent=None)
    assert len(entries(rig)) == 1


def test_the_journal_goes_on_after_a_restart_where_it_was(rig: Rig) -> None:
    rig.create(agent=None)
    rig.load()
    rig.create("r2", agent=None)
    assert [entry.run for entry in entries_of(rig) if isinstance(entry, Opened)] == ["r1", "r2"]


def test_no_cases_are_revealed_while_a_run_of_their_epoch_is_open(rig: Rig) -> None:
    """Attack: publish the cases of an epoch with a run whose agent is alive. Defence: refused while any
    run of the epoch is unfinished."""
    session = rig.begin(run={"hidden_from": 0})
    rig.create("r2", hidden_from=5000)
    finish(rig, session)
    answer = disclose(rig, "r1")
    assert isinstance(answer, Refused)
    assert "run 'r2' is not finished" in answer.message
    rig.ask(operator.CancelRun, run="r2")
    assert disclose(rig, "r1") == Done()
    assert isinstance(entries_of(rig)[-1], Revealed)


def test_no_new_run_gets_a_revealed_epoch_after_a_restart(rig: Rig) -> None:
    """Attack: play new runs on cases that a publication revealed. Defence: refused, also after a restart."""
    finish(rig)
    disclose(rig, "r1")
    for _ in range(2):
        answer = rig.create("r2", agent=None)
        assert isinstance(answer, Refused)
        assert "epoch new" in answer.message
        rig.load()
    assert isinstance(rig.create("r3", agent=None, epoch="next"), operator.RunCreated)


def test_cases_that_are_public_anyway_may_be_played_on(rig: Rig) -> None:
    finish(rig, cases_secret=False)
    disclose(rig, "r1")
    assert isinstance(rig.create("r2", agent=None, cases_secret=False), operator.RunCreated)


def test_what_is_revealed_already_gets_no_second_entry(rig: Rig) -> None:
    finish(rig)
    disclose(rig, "r1")
    before = entries(rig)
    assert disclose(rig, "r1") == Done()
    assert entries(rig) == before


def test_epochs_are_listed_with_their_runs(rig: Rig) -> None:
    session = rig.begin(run={"epoch": "a"})
    finish(rig, session)
    disclose(rig, "r1", epochs=("a",))
    rig.create("r2", epoch="b", agent=None)
    first, second = journal.epochs(entries_of(rig))
    assert (first.epoch, first.opened, first.ended, first.revealed_at is not None) == ("a", 1, 1, True)
    assert (second.epoch, second.opened, second.ended, second.revealed_at) == ("b", 1, 0, None)
