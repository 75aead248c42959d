"""What a run's audits came to: told to operators and kept in `run.json`, never to a gateway.

An audit plays an episode's recorded actions again on another worker and compares what comes of them, bit for bit.
"""

from __future__ import annotations

from typing import Literal

import msgspec


class AuditFinding(msgspec.Struct, frozen=True, kw_only=True):
    """An audited episode over which workers did not agree."""

    split: Literal["train", "validation", "heldout", "random"]
    submit_index: int
    """-1 for the random reference."""
    episode: int
    """Position in the submit's list, or in the split."""
    player: str
    """The worker whose result stands."""
    auditors: tuple[str, ...]
    """Those that played it again, in order."""
    difference: str
    """Where player and first auditor part, such as `step 3: reward 1.0 and 2.0`."""
    forger: str = ""
    """Who was alone against the two others; empty where that could not be told."""


class AuditRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The audits of one run. Counts are of episodes."""

    share: float
    """Of the run's episodes that were drawn, 0 to 1."""
    sampled: int = 0
    """Drawn."""
    audited: int = 0
    """Played again and judged."""
    agreed: int = 0
    """Of the audited: the result was confirmed."""
    disputed: int = 0
    """Of the audited: the result was refuted, or workers disagree and nobody could tell who is right."""
    not_audited: dict[str, int] = {}
    """Of the sampled: why they were not, such as `one worker only`."""
    forgers: dict[str, int] = {}
    """Workers that were found to hand in what did not happen, to the episodes of this run that each of them played."""
    findings: tuple[AuditFinding, ...] = ()
    """The first of what workers did not agree on."""

    @property
    def in_question(self) -> bool:
        """Whether the run's numbers may be forged: a result is in dispute, or a forger's episodes are among them."""
        return self.disputed > 0 or any(self.forgers.values())
