"""A run's place in its coordinator's journal, as `run.json` tells it."""

from __future__ import annotations

import msgspec

from evopolicy_common.messages.bounds import Int, Word


class Committed(msgspec.Struct, frozen=True, kw_only=True):
    """What the coordinator fixed before the run's agent began, and where the journal says so. See `records.journal`."""

    commitment: Word
    """Salted SHA-256 (hex) of the run's splits and settings."""
    epoch: Word
    """Of the cases: all runs of an epoch derive theirs from one secret."""
    opened: Int
    """Number of the journal's entry that holds the commitment, from 0."""
    opened_head: Word
    """Hash (hex) of the journal up to that entry."""
    ended: Int | None = None
    """Number of the entry that holds the digest of the run's result; None while it is not finished."""
    ended_head: Word = ""
    """Hash (hex) of the journal up to that entry."""
