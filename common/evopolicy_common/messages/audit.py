"""A run's audits and its entries in the journal: reported to operators and kept in `run.json`, never sent to a gateway.

An audit replays an episode's recorded actions on another worker and compares the two records bit for bit.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Int, Many, Named, Number, Text, Word


class AuditFinding(msgspec.Struct, frozen=True, kw_only=True):
    """An audited episode on which workers disagree."""

    split: Literal["train", "validation", "heldout", "random"]
    submit_index: Int
    """-1 for the random reference."""
    episode: Int
    """Position in the submit's list, or in the split."""
    player: Word
    """The worker whose result counts."""
    auditors: Many[Text]
    """The workers that replayed it, in order."""
    difference: Text
    """The first difference between player and first auditor, such as `step 3: reward 1.0 and 2.0`."""
    forger: Word = ""
    """The worker that disagreed with two others; empty when it could not be determined."""


class AuditRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The audits of one run. Counts are of episodes."""

    share: Number
    """Share of the run's episodes that was drawn, 0 to 1."""
    sampled: Int = 0
    """Episodes drawn."""
    audited: Int = 0
    """Episodes replayed and judged."""
    agreed: Int = 0
    """Audited episodes whose result was confirmed."""
    disputed: Int = 0
    """Audited episodes whose result was refuted, or on which workers disagree without a majority."""
    not_audited: Named[Int] = {}
    """Sampled episodes without an audit, by reason, such as `one worker only`."""
    forgers: Named[Int] = {}
    """Workers found to report forged results, with the number of this run's episodes that each of them played."""
    findings: Many[AuditFinding] = ()
    """The first disagreements."""

    def counts(self) -> AuditRecord:
        """The part that is published: no names of workers."""
        return msgspec.structs.replace(self, not_audited={}, forgers={}, findings=())

    @property
    def in_question(self) -> bool:
        """Whether the run's numbers may be forged: a result is disputed, or a forger played some of its episodes."""
        return self.disputed > 0 or any(self.forgers.values())


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
