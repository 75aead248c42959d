"""Token accounting as the paper's appendix defines it: input that no cache served, cache traffic, output with reasoning.

A stream that counts cached tokens into its input (Codex) has them taken off; one that reports them apart (Claude Code) is
taken as it is. Reasoning is part of `output` in both, and shown beside it where it is told.
"""

from __future__ import annotations

from typing import Any

import msgspec

MILLION = 1_000_000


KINDS = ("input_noncached", "cache_read", "cache_creation", "output")
"""Of tokens, each counted once."""


class Prices(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """US dollars per million tokens."""

    input: float
    """Of `input_noncached`."""
    output: float
    cache_read: float = 0.0
    cache_creation: float = 0.0


class Usage(msgspec.Struct, frozen=True, kw_only=True):
    """Counts of tokens."""

    input_noncached: int = 0
    cache_read: int = 0
    cache_creation: int = 0
    output: int = 0
    """Reasoning included."""
    reasoning: int | None = None

    def __add__(self, other: Usage) -> Usage:
        reasoning = None
        if self.reasoning is not None or other.reasoning is not None:
            reasoning = (self.reasoning or 0) + (other.reasoning or 0)
        return Usage(
            reasoning=reasoning, **{kind: getattr(self, kind) + getattr(other, kind) for kind in KINDS}
        )

    def __sub__(self, other: Usage) -> Usage:
        """Without `other`, which is part of it; `reasoning` stays."""
        return msgspec.structs.replace(
            self, **{kind: getattr(self, kind) - getattr(other, kind) for kind in KINDS}
        )

    @property
    def total(self) -> int:
        """All tokens, cached ones too."""
        return tokens_in(msgspec.structs.asdict(self))

    def cost(self, prices: Prices) -> float:
        """US dollars."""
        return (
            self.input_noncached * prices.input
            + self.cache_read * prices.cache_read
            + self.cache_creation * prices.cache_creation
            + self.output * prices.output
        ) / MILLION

    def recorded(self, prices: Prices | None) -> dict[str, Any]:
        """As `run.json`'s `tokens`; reasoning and cost only where they are known."""
        document: dict[str, Any] = msgspec.to_builtins(self)
        if self.reasoning is None:
            del document["reasoning"]
        if prices is not None:
            document["cost"] = round(self.cost(prices), 6)
        return document


MAX_COUNT = 10**12
"""No turn takes more tokens: sums of what a stream claims stay numbers that every reader takes."""


def count(value: Any) -> int:
    """A count of a stream, at most `MAX_COUNT`; 0 for what is none."""
    return (
        min(value, MAX_COUNT) if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0
    )


def tokens_in(told: dict[str, Any] | None) -> int:
    """All tokens of a usage as `run.json` has it, or a sweep's index; 0 for none."""
    return 0 if told is None else sum(int(told.get(kind) or 0) for kind in KINDS)
