"""Reads the stored recordings for an audit: extracts the actions, and compares two records.

Rules that this module owns:
- A worker that replays an episode gets its actions and none of their results.
- A player's report is never trusted to be a valid recording. An unreadable recording is the player's fault; one lost
  by the store is not. Recordings that cannot be compared differ: otherwise odd
  content would evade the audit.
- A difference is described in at most `MAX_TEXT` characters, as the message of a run's end has many.
"""

from __future__ import annotations

from typing import Any

from evopolicy_common.errors import ProtocolError, StorageError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.episodes import compare
from evopolicy_common.records.episodes.rendered import decode
from evopolicy_common.records.episodes.trajectory import Trajectory
from evopolicy_coordinator.core.contract.effects import AuditEffect, CompareAudit
from evopolicy_coordinator.core.contract.events import AuditCompared, AuditEvent, AuditPrepared
from evopolicy_coordinator.core.contract.records import OutcomeRow
from evopolicy_coordinator.storage.store import Reader

MAX_TEXT = 500
_LOST = "its record is not in the store any more"


def carry_out(effect: AuditEffect, reader: Reader, blobs: BlobStore) -> AuditEvent:
    """Carries out an audit's effect: reads, stores, compares. Never raises for a bad report of a worker or a store
    error."""
    about: dict[str, Any] = {"stimulus_id": effect.stimulus_id, "run": effect.run, "audit": effect.audit}
    if isinstance(effect, CompareAudit):
        return _compare(effect, reader, blobs, about)
    try:
        packed = _actions(_recording(_outcome(reader, effect.group, effect.index), blobs))
        actions = BlobRef(digest=blobs.put(packed), size=len(packed))
    except ProtocolError as error:
        text = f"its recording cannot be read: {error}"[:MAX_TEXT]
        return AuditPrepared(**about, actions=None, error=text, at_fault=True)
    except StorageError as error:
        return AuditPrepared(**about, actions=None, error=f"{_LOST}: {error}"[:MAX_TEXT])
    return AuditPrepared(**about, actions=actions)


def _compare(effect: CompareAudit, reader: Reader, blobs: BlobStore, about: dict[str, Any]) -> AuditCompared:
    about |= {"replay": len(effect.replays)}
    try:
        player = _outcome(reader, effect.group, effect.index)
        first, *others = [_outcome(reader, group, 0) for group in effect.replays]
        last = others[-1] if others else first
        with_player = outcome_difference(player, last, blobs)
        with_first = outcome_difference(first, last, blobs) if others else None
    except StorageError as error:
        return AuditCompared(**about, with_player=None, error=f"{_LOST}: {error}")
    return AuditCompared(**about, with_player=with_player, with_first=with_first)


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
    first, second = recordings
    if (first.record, first.observations) != (second.record, second.observations):
        return (
            f"records of {first.record}, {first.observations} and of {second.record}, {second.observations}"
        )
    try:
        difference = compare.episode_difference(ours, first, theirs, second)
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
    row = reader.one(OutcomeRow, grp=group, idx=index)
    if row is None:
        raise StorageError(f"there is no outcome {index} of {group}")
    return row.outcome


def _recording(outcome: EpisodeOutcome, blobs: BlobStore) -> Trajectory:
    """Decodes the outcome's recording. Raises ProtocolError when there is none or it is unreadable."""
    ref = outcome.trajectory
    if ref is None:
        raise ProtocolError("there is none")
    return decode(blobs.read(ref.digest) if ref.inline is None else ref.inline)
