"""Limits of a run's use of its model, and its use so far. No I/O."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from evopolicy_gateway.relay.apis import Upstream
from evopolicy_gateway.relay.usage import Prices, Usage

_MAX_NAMES = 20


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of one run. The defaults are far above the published runs, the largest of which used 45 million tokens."""

    max_requests: Annotated[int, Meta(ge=1)] = 5_000
    max_tokens: Annotated[int, Meta(ge=1)] = 100_000_000
    """All kinds of tokens together."""
    max_cost: Annotated[float, Meta(gt=0)] | None = None
    """US dollars."""

    def __str__(self) -> str:
        dollars = "" if self.max_cost is None else f", {self.max_cost:,.2f} dollars"
        return f"{self.max_requests:,} requests, {self.max_tokens:,} tokens{dollars}"


class ModelTerms(msgspec.Struct, frozen=True, kw_only=True):
    """The terms on which an agent may use its model."""

    upstream: Upstream | None
    """The API behind the relay; None: the agent cannot use the relay."""
    limits: Limits = Limits()
    prices: Prices | None = None
    model: str | None = None
    """The declared model."""
    declared_only: bool = False
    """Whether requests for other models are refused."""
    own_tools_only: bool = False
    """Whether requests with tools that the provider runs are refused."""


class Request(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One line of the ledger: a request that went to the provider."""

    at: float
    """Unix time of its start, seconds."""
    api: str
    asked: str
    """The model that the agent asked for."""
    answered: str = ""
    """The model that the answer names."""
    hosted_tools: tuple[str, ...] = ()
    """Kinds of tools in the request that the provider runs."""
    status: int
    """HTTP status; 0 where no answer came."""
    broken: bool = False
    """Whether the answer broke off."""
    usage: Usage = Usage()
    estimated: bool = False
    first_s: float | None = None
    """From the request to the answer's first bytes, seconds."""
    whole_s: float = 0.0
    wait_s: float = 0.0
    """Time that the provider told the agent to wait, seconds."""


class Used(msgspec.Struct, kw_only=True):
    """The sum over requests."""

    requests: int = 0
    failed: int = 0
    """Requests without a whole answer."""
    estimated: int = 0
    """Requests with an estimated count."""
    usage: Usage = Usage()
    models: dict[str, int] = {}
    """Requests by model that answered."""
    other_models: dict[str, int] = {}
    """Requests by model that was asked for and is not the declared one."""
    hosted_tools: dict[str, int] = {}
    """Requests by kind of tool that the provider runs."""
    first_s: float = 0.0
    """Sum over the answered requests, seconds."""
    wait_s: float = 0.0

    def take(self, request: Request, declared: str | None = None) -> None:
        """Adds a request."""
        self.requests += 1
        self.usage += request.usage
        self.failed += not 200 <= request.status < 300 or request.broken
        self.estimated += request.estimated
        self.first_s += request.first_s or 0.0
        self.wait_s += request.wait_s
        if request.answered:
            _count(self.models, request.answered)
        for kind in request.hosted_tools:
            _count(self.hosted_tools, kind)
        if declared and request.asked != declared:
            _count(self.other_models, request.asked)

    def over(self, limits: Limits, prices: Prices | None, in_flight: int = 0) -> str:
        """Which limit is used up; empty for none. `in_flight`: requests without a line yet."""
        if self.requests + in_flight >= limits.max_requests:
            return f"{limits.max_requests:,} requests"
        if self.usage.total >= limits.max_tokens:
            return f"{limits.max_tokens:,} tokens"
        if limits.max_cost is not None and prices and self.usage.cost(prices) >= limits.max_cost:
            return f"{limits.max_cost:,.2f} dollars"
        return ""

    def recorded(self, prices: Prices | None) -> dict[str, Any]:
        """The form of `run.json`'s `tokens`, with the number of requests."""
        return self.usage.recorded(prices) | {"requests": self.requests}

    def words(self, prices: Prices | None) -> str:
        """One line for people."""
        cost = "" if prices is None else f", {self.usage.cost(prices):,.2f} dollars"
        failed = f" ({self.failed:,} failed)" if self.failed else ""
        return f"{self.requests:,} requests{failed}, {self.usage.total:,} tokens{cost} so far"


def _count(counts: dict[str, int], name: str) -> None:
    if name in counts or len(counts) < _MAX_NAMES:
        counts[name] = counts.get(name, 0) + 1
