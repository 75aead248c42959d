"""Token accounting as the paper's appendix defines it: uncached input, cache traffic, output including reasoning.

If a stream includes cached tokens in its input (Codex), they are subtracted; if it reports them separately (Claude
Code), the input is used as it is. `output` includes reasoning in both; reasoning is also shown by itself if it is
reported.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

MILLION = 1_000_000


KINDS = ("input_noncached", "cache_read", "cache_creation", "output")
"""Kinds of tokens; each token counts in exactly one."""


Price = Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]


class Prices(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """US dollars per million tokens."""

    input: Price
    """Price of `input_noncached`."""
    output: Price
    cache_read: Price = 0.0
    cache_creation: Price = 0.0
    tiers: dict[str, Annotated[float, msgspec.Meta(ge=0.0, le=1e3)]] = {}
    """Factor on all prices for a service tier, such as `priority`."""


class Usage(msgspec.Struct, frozen=True, kw_only=True):
    input_noncached: int = 0
    cache_read: int = 0
    cache_creation: int = 0
    output: int = 0
    """Output tokens, including reasoning."""
    reasoning: int | None = None

    def __add__(self, other: Usage) -> Usage:
        reasoning = None
        if self.reasoning is not None or other.reasoning is not None:
            reasoning = (self.reasoning or 0) + (other.reasoning or 0)
        return Usage(
            reasoning=reasoning, **{kind: getattr(self, kind) + getattr(other, kind) for kind in KINDS}
        )

    def __sub__(self, other: Usage) -> Usage:
        """Subtracts `other`, a part of this usage; `reasoning` stays unchanged."""
        return msgspec.structs.replace(
            self, **{kind: getattr(self, kind) - getattr(other, kind) for kind in KINDS}
        )

    @property
    def total(self) -> int:
        """All tokens, including cached ones."""
        return tokens_in(msgspec.structs.asdict(self))

    def cost(self, prices: Prices) -> float:
        """Cost in US dollars."""
        return (
            self.input_noncached * prices.input
            + self.cache_read * prices.cache_read
            + self.cache_creation * prices.cache_creation
            + self.output * prices.output
        ) / MILLION

    def recorded(self, prices: Prices | None) -> dict[str, Any]:
        """The form of `run.json`'s `tokens`; reasoning and cost only if they are known."""
        document: dict[str, Any] = msgspec.to_builtins(self)
        if self.reasoning is None:
            del document["reasoning"]
        if prices is not None:
            document["cost"] = round(self.cost(prices), 6)
        return document


MAX_COUNT = 10**12
"""Limit of one reported count, above any real turn, so that sums of counts stay numbers that every reader accepts."""


def count(value: object) -> int:
    """A count from a stream, at most `MAX_COUNT`; 0 for an invalid one."""
    return (
        min(value, MAX_COUNT) if isinstance(value, int) and not isinstance(value, bool) and value > 0 else 0
    )


def tokens_in(counts: dict[str, Any] | None) -> int:
    """Total tokens of a usage from `run.json` or a sweep's index; 0 for None."""
    return 0 if counts is None else sum(int(counts.get(kind) or 0) for kind in KINDS)
