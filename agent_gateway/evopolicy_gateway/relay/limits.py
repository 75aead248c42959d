"""Limits of a run's use of its model, and its use so far. No I/O."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from evopolicy_common.errors import DECODE_ERRORS
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


class LoggedRequest(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
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
    tier: str = ""
    """Service tier by whose prices it is charged; empty: the usual one."""
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


class Reserve(msgspec.Struct, frozen=True, kw_only=True):
    """Most that a request in flight may use: its estimated input, uncached, and its most output."""

    usage: Usage
    tier: str = ""

    def cost(self, prices: Prices) -> float:
        """Most US dollars."""
        dearest = msgspec.structs.replace(prices, input=max(prices.input, prices.cache_creation))
        return self.usage.cost(dearest) * prices.tiers.get(self.tier, 1.0)


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
    tiers: dict[str, Usage] = {}
    """The part of the usage that is charged by the prices of a service tier."""
    first_s: float = 0.0
    """Sum over the answered requests, seconds."""
    wait_s: float = 0.0

    def count_request(self, request: LoggedRequest, declared: str | None = None) -> None:
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
        if request.tier and (request.tier in self.tiers or len(self.tiers) < _MAX_NAMES):
            self.tiers[request.tier] = self.tiers.get(request.tier, Usage()) + request.usage
        if declared and request.asked not in (declared, ""):
            _count(self.other_models, request.asked)

    def cost(self, prices: Prices) -> float:
        """Cost in US dollars."""
        more = (each.cost(prices) * (prices.tiers.get(tier, 1.0) - 1.0) for tier, each in self.tiers.items())
        return self.usage.cost(prices) + sum(more)

    def over(
        self,
        limits: Limits,
        prices: Prices | None,
        others: Iterable[Reserve] = (),
        own: Reserve | None = None,
    ) -> str:
        """Which limit is used up; empty for none. `others`: of the requests in flight; `own`: of one that is to be
        sent beside them, or that may use more than one answer's tokens."""
        reserved = [*others]
        n, reserved = len(reserved), reserved + ([own] if own else [])
        if self.requests + n >= limits.max_requests:
            return f"{limits.max_requests:,} requests"
        if self.usage.total + sum(each.usage.total for each in reserved) >= limits.max_tokens:
            return f"{limits.max_tokens:,} tokens"
        if limits.max_cost is not None and prices is not None:
            cost = self.cost(prices) + sum(each.cost(prices) for each in reserved)
            return f"{limits.max_cost:,.2f} dollars" if cost >= limits.max_cost else ""
        return ""

    def recorded(self, prices: Prices | None) -> dict[str, Any]:
        """The form of `run.json`'s `tokens`."""
        cost = {} if prices is None else {"cost": round(self.cost(prices), 6)}
        return self.usage.recorded(None) | cost


def _count(counts: dict[str, int], name: str) -> None:
    if name in counts or len(counts) < _MAX_NAMES:
        counts[name] = counts.get(name, 0) + 1


_decoder = msgspec.json.Decoder(LoggedRequest)


class RequestLog:
    """Appends requests, unbuffered: a line that is written survives the end of any process."""

    def __init__(self, path: Path, declared: str | None) -> None:
        self.used = read_ledger(path, declared)
        self._declared = declared
        self._file = path.open("ab", buffering=0)
        if self._file.tell():
            self._file.write(b"\n")  # a kill may have left half a line

    def close(self) -> None:
        self._file.close()

    def write(self, request: LoggedRequest) -> None:
        """Raises OSError when the disk refuses."""
        self.used.count_request(request, self._declared)
        self._file.write(msgspec.json.encode(request) + b"\n")


def read_ledger(path: Path, declared: str | None = None) -> Used:
    """The use of a ledger's requests; none where there is no ledger. Lines that cannot be read are skipped."""
    used = Used()
    with contextlib.suppress(OSError):
        for line in path.read_bytes().splitlines():
            with contextlib.suppress(*DECODE_ERRORS):
                used.count_request(_decoder.decode(line), declared)
    return used
