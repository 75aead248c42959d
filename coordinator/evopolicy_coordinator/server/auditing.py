"""Reads the stored recordings for an audit: extracts the actions, and compares two records.

Rules that this module owns:
- A worker that replays an episode gets its actions and none of their results.
- A player's report is never trusted to be a valid recording. An unreadable recording is the player's fault; one lost
  by the store is not. What cannot be compared differs: otherwise odd content would evade the audit.
- A difference is described in at most `MAX_TEXT` characters, as the message of a run's end has many.
"""

from __future__ import annotations

from evopolicy_common.errors import ProtocolError, StorageError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_coordinator.core.contract.effects import AuditEffect, CompareAudit, PrepareAudit
from evopolicy_coordinator.core.contract.events import AuditCompared, AuditEvent, AuditPrepared
from evopolicy_coordinator.storage.store import Reader

MAX_TEXT = 500
_LOST = "its record is not in the store any more"


def carry_out(effect: AuditEffect, reader: Reader, blobs: BlobStore) -> AuditEvent:
    """Carries out an audit's effect: reads, stores, compares. Never raises for a bad report of a worker or a store
    error."""
    return (
        _prepare(effect, reader, blobs)
        if isinstance(effect, PrepareAudit)
        else _compare(effect, reader, blobs)
    )


def _prepare(effect: PrepareAudit, reader: Reader, blobs: BlobStore) -> AuditPrepared:
    actions: BlobRef | None = None
    error, at_fault = "", False
    try:
        recorded = _recording(_outcome(reader, effect.group, effect.index), blobs)
        packed = _actions(recorded)
        actions = BlobRef(digest=blobs.put(packed), size=len(packed))
    except ProtocolError as caught:
        error, at_fault = f"its recording cannot be read: {caught}", True
    except StorageError as caught:
        error = f"{_LOST}: {caught}"
    return AuditPrepared(
        stimulus_id=effect.stimulus_id,
        run=effect.run,
        audit=effect.audit,
        actions=actions,
        error=error[:MAX_TEXT],
        at_fault=at_fault,
    )


def _compare(effect: CompareAudit, reader: Reader, blobs: BlobStore) -> AuditCompared:
    with_player: str | None = None
    with_first: str | None = None
    error = ""
    try:
        player = _outcome(reader, effect.group, effect.index)
        replays = [_outcome(reader, group, 0) for group in effect.replays]
        with_player = outcome_difference(player, replays[-1], blobs)
        if len(replays) > 1:
            with_first = outcome_difference(replays[0], replays[-1], blobs)
    except StorageError as caught:
        error = f"{_LOST}: {caught}"
    return AuditCompared(
        stimulus_id=effect.stimulus_id,
        run=effect.run,
        audit=effect.audit,
        replay=len(effect.replays),
        with_player=with_player,
        with_first=with_first,
        error=error,
    )


def outcome_difference(ours: EpisodeOutcome, theirs: EpisodeOutcome, blobs: BlobStore) -> str | None:
    """Describes the first difference of two outcomes of the same actions; None when they are equal bit for bit.

    Ignores the policy's side (failure, output, times). Raises StorageError when the store has lost a recording.
    """
    recordings = []
    for outcome in (ours, theirs):
        try:
            recordings.append(_recording(outcome, blobs))
        except ProtocolError as error:
            return f"a recording cannot be read: {error}"
    left, right = recordings
    if (left.record, left.observations) != (right.record, right.observations):
        return f"records of {left.record}, {left.observations} and of {right.record}, {right.observations}"
    try:
        difference = compare.episode_difference(ours, left, theirs, right)
    except Exception as error:
        # Their content may be anything that a worker makes up.
        difference = f"the recordings cannot be compared: {type(error).__name__}: {error}"
    return None if difference is None else difference[:MAX_TEXT]


def _actions(recorded: Trajectory) -> bytes:
    """The recorded actions by themselves. Raises ProtocolError when they cannot be written again."""
    try:
        return compare.action_log(recorded.actions)
    except Exception as error:
        raise ProtocolError(f"its actions: {type(error).__name__}: {error}") from error


def _outcome(reader: Reader, group: str, index: int) -> EpisodeOutcome:
    row = reader.outcome(group, index)
    if row is None:
        raise StorageError(f"there is no outcome {index} of {group}")
    return row.outcome


def _recording(outcome: EpisodeOutcome, blobs: BlobStore) -> Trajectory:
    """Decodes the outcome's recording. Raises ProtocolError when there is none or it is unreadable."""
    ref = outcome.trajectory
    if ref is None:
        raise ProtocolError("there is none")
    return decode(blobs.read(ref.digest) if ref.inline is None else ref.inline)
