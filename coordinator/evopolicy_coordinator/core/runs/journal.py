"""The coordinator's journal entries and their consequences (`evopolicy_common.records.journal`).

Rules that this module owns:
- Every run has an entry from its opening on, whatever happens to it, and another when it is over.
- The content that an entry commits to is stored with it, as the bytes that were hashed.
- An epoch is revealed when one of its runs is published, and not while any run of it is unfinished. No new run gets a
  revealed epoch's secret cases; public cases may still be played, and a replay, no new run, has those of its run.
"""

from __future__ import annotations

import msgspec

from evopolicy_common.messages.operator import Committed, Done, RunFinished
from evopolicy_common.records import journal
from evopolicy_coordinator.core.contract import events
from evopolicy_coordinator.core.contract.reasons import NotDoneError
from evopolicy_coordinator.core.contract.records import DocumentRow, JournalRow, RunRow
from evopolicy_coordinator.core.tables.state import State
from evopolicy_coordinator.core.tables.step import CoreStep


def check_epoch(state: State, row: RunRow) -> None:
    """Raises NotDoneError when no run may be opened on these cases."""
    if row.cases_secret and row.epoch in state.revealed and not row.settings.replay_of:
        raise NotDoneError("epoch_revealed", epoch=row.epoch)


def opened(state: State, row: RunRow, step: CoreStep) -> Committed:
    """Commit to a run that is about to be created."""
    opening = journal.Opening(**{name: getattr(row, name) for name in journal.Opening.__struct_fields__})
    # The document is published unchanged, so it leaves out the operator's private labels and machine.
    settings = msgspec.structs.replace(row.settings, notes={}, agent_host="")
    document = journal.document(msgspec.structs.replace(opening, settings=settings))
    commitment = journal.commitment(row.salt, document)
    step.persist(DocumentRow(run=row.run, kind="opening", data=document))
    entry = journal.Opened(
        run=row.run,
        commitment=commitment,
        epoch=row.epoch,
        entry=settings.entry,
        model=settings.model,
        env=settings.env,
        exp_id=settings.exp_id,
        repeat=settings.repeat,
        attempt=settings.attempt,
        at=step.now,
        replay_of=settings.replay_of,
        start=settings.start,
    )
    last = _append(state, entry, step)
    return Committed(commitment=commitment, epoch=row.epoch, opened=last.seq, opened_head=last.head)


def ended(state: State, finished: RunFinished, step: CoreStep) -> RunFinished:
    """Commit to a run's result."""
    document = journal.document(finished.result)
    step.persist(DocumentRow(run=finished.run, kind="result", data=document))
    entry = journal.Ended(
        run=finished.run, status=finished.status, result=journal.digest(document), at=step.now
    )
    last = _append(state, entry, step)
    place = msgspec.structs.replace(finished.committed, ended=last.seq, ended_head=last.head)
    return msgspec.structs.replace(finished, committed=place)


def disclose(state: State, event: events.DisclosureRequested, step: CoreStep) -> None:
    """Reveal the epochs of runs that are to be published. Refuses (BUSY) while a run of them is unfinished.
    Revealed epochs stay so."""
    for run in state.runs.values():
        if run.row.epoch in event.epochs:
            raise NotDoneError("epoch_in_use", run=run.id)
    for epoch in event.epochs:
        if epoch not in state.revealed:
            state.revealed.add(epoch)
            _append(state, journal.Revealed(epoch=epoch, runs=event.message.runs, at=step.now), step, epoch)
            step.log("info", "epoch_revealed", epoch=epoch)
    step.reply(event.request, Done())


def _append(state: State, entry: journal.EpochEntry, step: CoreStep, reveals: str = "") -> JournalRow:
    last = state.journal
    data = journal.document(entry)
    head = journal.EMPTY_HEAD if last is None else last.head
    row = JournalRow(
        seq=0 if last is None else last.seq + 1,
        head=journal.head_after(head, data),
        entry=data,
        reveals=reveals,
    )
    step.persist(row)
    state.journal = row
    return row
