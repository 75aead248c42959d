"""What a run's audits came to: told to operators and kept in `run.json`, never to a gateway.

An audit plays an episode's recorded actions again on another worker and compares what comes of them, bit for bit.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.messages.bounds import Int, Many, Named, Number, Text, Word


class AuditFinding(msgspec.Struct, frozen=True, kw_only=True):
    """An audited episode over which workers did not agree."""

    split: Literal["train", "validation", "heldout", "random"]
    submit_index: Int
    """-1 for the random reference."""
    episode: Int
    """Position in the submit's list, or in the split."""
    player: Word
    """The worker whose result stands."""
    auditors: Many[Text]
    """Those that played it again, in order."""
    difference: Text
    """Where player and first auditor part, such as `step 3: reward 1.0 and 2.0`."""
    forger: Word = ""
    """Who was alone against the two others; empty where that could not be told."""


class AuditRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The audits of one run. Counts are of episodes."""

    share: Number
    """Of the run's episodes that were drawn, 0 to 1."""
    sampled: Int = 0
    """Drawn."""
    audited: Int = 0
    """Played again and judged."""
    agreed: Int = 0
    """Of the audited: the result was confirmed."""
    disputed: Int = 0
    """Of the audited: the result was refuted, or workers disagree and nobody could tell who is right."""
    not_audited: Named[Int] = {}
    """Of the sampled: why they were not, such as `one worker only`."""
    forgers: Named[Int] = {}
    """Workers that were found to report what did not happen, to the episodes of this run that each of them played."""
    findings: Many[AuditFinding] = ()
    """The first of what workers did not agree on."""

    @property
    def in_question(self) -> bool:
        """Whether the run's numbers may be forged: a result is in dispute, or a forger's episodes are among them."""
        return self.disputed > 0 or any(self.forgers.values())
