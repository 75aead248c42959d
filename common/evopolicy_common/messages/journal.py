"""A run's entries in its coordinator's journal, as `run.json` has them."""

from __future__ import annotations

import msgspec

from evopolicy_common.messages.bounds import Int, Word


class Committed(msgspec.Struct, frozen=True, kw_only=True):
    """The coordinator's commitment before the run's agent started, with its journal entries. See `records.journal`."""

    commitment: Word
    """Salted SHA-256 (hex) of the run's splits and settings."""
    epoch: Word
    """The epoch of the run's cases: all runs of an epoch derive theirs from one secret."""
    opened: Int
    """Index of the journal entry that holds the commitment, from 0."""
    opened_head: Word
    """Hash (hex) of the journal up to that entry."""
    ended: Int | None = None
    """Index of the entry that holds the digest of the run's result; None until the run is finished."""
    ended_head: Word = ""
    """Hash (hex) of the journal up to that entry."""
