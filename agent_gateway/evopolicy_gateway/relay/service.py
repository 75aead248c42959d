"""The relay's HTTP service: requests of the agent in, requests to the provider out, and the counting between them."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import re
import time
import zlib
from collections.abc import AsyncIterator, Callable, Mapping
from email.utils import parsedate_to_datetime
from pathlib import Path

import httpcore
from msgspec.structs import replace
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from evopolicy_common.records.model_record import Level
from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.relay import apis, limits, requests
from evopolicy_gateway.relay.answers import FREE, SHAPES, AnswerReader
from evopolicy_gateway.relay.apis import RelayRefusal, Route, Upstream
from evopolicy_gateway.relay.limits import RequestLog
from evopolicy_gateway.relay.provider import FAILED, NOT_SENT, Answer, Provider, Sent
from evopolicy_gateway.relay.recording import MAX_ANSWER_BYTES as MAX_RECORDED_BYTES
from evopolicy_gateway.relay.recording import CallRecorder, CallSource, Cleaning, Replayed
from evopolicy_gateway.relay.requests import RequestFacts
from evopolicy_gateway.relay.usage import Usage

MAX_REQUEST_BYTES = 32 << 20
MAX_HELD_BYTES = 128 << 20
"""Of all requests and answers together that the relay holds, whole or not."""
MAX_ANSWER_BYTES = 256 << 20
"""Of one answer, uncompressed."""
MAX_ERROR_BYTES = 1 << 20
MAX_IN_FLIGHT = 32
REQUEST_WAIT_S = 60.0
"""Time in which a request's body has to arrive."""
MAX_RETRY_S = 60.0
"""Longest wait that clients keep within a request; with a longer one their turn fails, and the harness waits."""
_FIRST_RETRY_S = 1.0
_CHUNK = 64 << 10
_SHOWN, _MAX_WORDS = 200, 2000
_FINAL = {"x-should-retry": "false"}
_NO_QUOTA = b"insufficient_quota"
_ADDED = (b"stream_options", b"include_usage")
"""Names of what the relay adds to a request."""
_BROKEN = (*FAILED, ValueError, zlib.error, MemoryError)


class RelaySetup(limits.ModelTerms, frozen=True, kw_only=True):
    """The first line on a relay process's stdin, JSON."""

    upstream: Upstream
    token: str
    """The agent's, which only this relay accepts."""
    ledger: str
    timeout_s: float = 600.0
    """Longest time without a byte from the provider."""
    record: Level = "off"
    folder: str = ""
    """Of the record."""
    replay: str = ""
    """Folder of the record that answers in place of the provider."""
    tokens: tuple[str, ...] = ()
    """The run's own, which have other texts in the record."""
    secrets: tuple[str, ...] = ()
    """Other texts that the record leaves out."""


class _RefusedError(Exception):
    """The relay answers a request itself. Without headers the answer is final."""

    def __init__(self, refusal: RelayRefusal, message: str, headers: Mapping[str, str] = _FINAL) -> None:
        super().__init__(message)
        self.refusal, self.headers = refusal, headers


def _busy(message: str) -> _RefusedError:
    return _RefusedError(apis.TOO_MANY, message, {"retry-after": "1"})


class Relay:
    """The ASGI application."""

    def __init__(
        self,
        order: RelaySetup,
        *,
        counted: Callable[[], None],
        note: Callable[[str], None],
        spent: Callable[[str], None],
        now: Callable[[], float] = time.time,
    ) -> None:
        """`counted` is called after each request, `note` with a line for the operator, `spent` with the
        limit that is used up. `now`: Unix time, seconds."""
        self.order = order
        self.upstream = order.upstream
        self._ledger = RequestLog(Path(order.ledger), order.model)
        self.used = self._ledger.used
        self._counted, self._note, self._spent = counted, note, spent
        self.now = now
        self.open: set[_Exchange] = set()
        self.adds_counts = True
        """Whether streams are asked for counts; not after a provider refused that."""
        self._least = Usage()
        """The usage of the largest answer that was above its reserve."""
        self.troubles = 0
        """Failed requests since the last answered one."""
        self._told: set[str] = set()
        keys = order.upstream.key, *order.upstream.headers.values()
        self.clean = Redaction(keys).without_known
        clean, folder = Cleaning(order.tokens, (*order.secrets, *keys)), Path(order.folder)
        self.provider: CallSource
        if order.replay:
            self.provider = Replayed(Path(order.replay), clean, folder, spent)
        else:
            self.provider = Provider(order.upstream.base_url, order.timeout_s)
        if order.record != "off":
            self.provider = CallRecorder(self.provider, folder, order.record, clean, note)

    async def close(self, grace_s: float = 0.0) -> None:
        """Ends the answers that are still coming after `grace_s`; they are counted as broken off."""
        if tasks := [each.task for each in self.open if each.task is not None]:
            await asyncio.wait(tasks, timeout=grace_s)
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
        await self.provider.close()
        self._ledger.close()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        exchange = _Exchange(self)
        try:
            response = await self._answer(exchange, Request(scope, receive))
            await response(scope, receive, send)
        except ClientDisconnect:
            pass
        finally:
            exchange.agent_left()

    async def _answer(self, exchange: _Exchange, request: Request) -> Response:
        try:
            route = self._route(request)
            if len(self.open) >= MAX_IN_FLIGHT:
                raise _busy(f"{MAX_IN_FLIGHT} requests are under way")
            self.open.add(exchange)
            facts = await self._facts(exchange, request, route)
            self._admit(exchange, route, facts)
            return await exchange.begin(request, route, facts)
        except _RefusedError as why:
            return self.refusal(why)
        except MemoryError:
            return self.refusal(_busy("the relay has no memory for this request"))

    def _route(self, request: Request) -> Route:
        headers, path = request.headers, request.scope["path"]
        given = [headers.get("authorization", "").partition(" ")[2]]
        given += [headers.get(name, "") for name in apis.KEY_HEADERS]
        if not any(hmac.compare_digest(each.encode(), self.order.token.encode()) for each in given):
            raise _RefusedError(
                apis.NO_TOKEN, "the relay does not know this key; use the one of your environment"
            )
        if "transfer-encoding" in headers and "content-length" in headers:
            raise _RefusedError(apis.INVALID, "the request has two lengths", {"connection": "close"})
        route = self.upstream.route(path)
        if route is None:
            raise _RefusedError(
                apis.NO_PATH, f"{path[:_SHOWN]} is not served for {self.upstream.protocol}'s APIs"
            )
        if request.method != ("POST" if route.api in requests.RULES else "GET"):
            raise _RefusedError(apis.NO_PATH, f"{request.method} is not served here")
        if headers.get("content-encoding", "identity").lower() != "identity":
            raise _RefusedError(apis.COMPRESSED, "send the request uncompressed")
        return route

    async def _facts(self, exchange: _Exchange, request: Request, route: Route) -> RequestFacts:
        """The facts about the request. Raises _RefusedError."""
        if request.method == "GET":
            return RequestFacts()
        try:
            async with asyncio.timeout(REQUEST_WAIT_S):
                body = await exchange.whole(request.stream(), "request", MAX_REQUEST_BYTES)
        except TimeoutError:
            raise _RefusedError(
                apis.TOO_SLOW, f"the request did not arrive within {REQUEST_WAIT_S:g} s"
            ) from None
        except ValueError as error:
            raise _RefusedError(apis.TOO_LARGE, str(error)) from None
        try:
            return requests.facts(route.api, body, route.model)
        except ValueError as error:
            raise _RefusedError(apis.INVALID, f"the request cannot be read: {error}") from None

    def _admit(self, exchange: _Exchange, route: Route, facts: RequestFacts) -> None:
        """Raises _RefusedError for a request that the run's terms or limits do not allow."""
        order, used = self.order, self.used
        if facts.body:
            self._check(facts)
        exchange.hold(len(facts.body) + len(facts.with_counts or b""))
        if what := used.over(order.limits, order.prices):
            self._spent(what)
            raise _RefusedError(apis.SPENT, f"the run's model budget is spent: {what}")
        least, usage = self._least, Usage()
        if not route.free:
            fresh = max(facts.input, least.total - least.output)
            usage = Usage(input_noncached=fresh, output=max(facts.output, least.output))
        own = limits.Reserve(usage=usage, tier=facts.tier)
        others = [each.reserve for each in self.open if each.task is not None]
        if others or facts.n_answers > 1:
            what = used.over(order.limits, order.prices, others, own)
            if what and not others:
                raise _RefusedError(apis.INVALID, f"{facts.n_answers} answers may exceed the limit of {what}")
            if what:
                raise _busy(f"with the requests under way this one may exceed the limit of {what}")
        exchange.reserve = own

    def _check(self, facts: RequestFacts) -> None:
        """Raises _RefusedError for a request that the run's terms do not allow."""
        order = self.order
        if facts.background:
            # It would go on after its answer, uncounted.
            raise _RefusedError(apis.INVALID, "requests in the background are not served")
        if order.model and facts.asked != order.model:
            if order.declared_only:
                why = f"the run's model is {order.model}; {facts.asked!r} is not allowed"
                raise _RefusedError(apis.OTHER_MODEL, why)
            self.once(f"the agent asks for the model {facts.asked!r} besides {order.model}")
        if facts.hosted:
            kinds = ", ".join(facts.hosted)
            if order.own_tools_only:
                raise _RefusedError(apis.INVALID, f"tools of the provider are refused: {kinds}")
            self.once(f"the agent offers its model tools of the provider: {kinds}")
        if facts.unknown and (order.declared_only or order.own_tools_only):
            which = 'hosted_tools = "refuse"' if order.own_tools_only else 'models = "declared"'
            raise _RefusedError(
                apis.INVALID, f"{facts.unknown} is not among the fields that a run with {which} may use"
            )
        limited = order.prices if order.limits.max_cost is not None else None
        if facts.tier and limited is not None and facts.tier not in limited.tiers:
            why = f"the service tier {facts.tier!r} has no price, and the run's cost is limited"
            raise _RefusedError(apis.INVALID, f"{why}: add it to prices.tiers")

    def refusal(self, why: _RefusedError) -> Response:
        headers = {**why.headers, "content-type": "application/json"}
        body = why.refusal.body(self.upstream.protocol, str(why))
        return Response(self.clean(body), why.refusal.status, headers)

    def count(self, line: limits.LoggedRequest, reserve: limits.Reserve) -> None:
        """Writes a finished request to the ledger. Raises OSError when the disk refuses."""
        if line.usage.total > max(reserve.usage.total, self._least.total):
            self._least = line.usage
        self._ledger.write(line)
        self._counted()

    def headers_of(self, answer: Answer) -> dict[str, str]:
        passed = apis.passed_down(answer.headers).items()
        return {name: self.clean(value.encode()).decode("latin-1") for name, value in passed}

    def once(self, text: str) -> None:
        if text not in self._told and len(self._told) < 20:
            self._told.add(text)
            self._note(text)

    def trouble(self, what: str, stated_s: float | None) -> float:
        """Seconds until the next try, after a failure that another try may resolve: as stated, or longer each time.
        Tells the operator of the first."""
        wait_s = stated_s if stated_s is not None else min(MAX_RETRY_S, _FIRST_RETRY_S * 2.0**self.troubles)
        self.troubles = min(self.troubles + 1, 10)
        if self.troubles == 1:
            at = time.strftime("%H:%M:%S UTC", time.gmtime(self.now() + wait_s))
            self._note(f"{self.upstream.shown} {what}; next try in {wait_s:.0f} s, at {at}")
        return wait_s


class _Exchange:
    """A request of the agent and its answer. The provider's answer is read in a task of its own, to its end: an agent
    that leaves does not change what is counted."""

    def __init__(self, relay: Relay) -> None:
        self.reserve = limits.Reserve(usage=Usage())
        """Most that it may use, once it is sent."""
        self.task: asyncio.Task[None] | None = None
        self._relay = relay
        self._held = self._recorded = 0
        self._left = self._written = self._refused = False
        self._begun = time.monotonic()
        self._first_s: float | None = None
        self._reader: AnswerReader | None = None
        self._head: asyncio.Future[Response] = asyncio.get_running_loop().create_future()
        self._pieces: asyncio.Queue[bytes | Exception | None] = asyncio.Queue(1)

    def hold(self, n_bytes: int) -> None:
        """Tells how many bytes it holds. Raises _RefusedError when the relay holds too many."""
        self._held = n_bytes
        if sum(each._held + each._recorded for each in self._relay.open) > MAX_HELD_BYTES:
            raise _busy("the relay holds too many bytes of requests and answers; wait until one is done")

    async def whole(self, pieces: AsyncIterator[bytes], what: str, limit: int) -> bytes:
        """All pieces together. Raises ValueError when they are longer."""
        data, before = bytearray(), self._held
        async for piece in pieces:
            data += piece
            if len(data) > limit:
                raise ValueError(f"the {what} has more than {limit:,} bytes")
            self.hold(before + len(data))
        return bytes(data)

    async def begin(self, request: Request, route: Route, facts: RequestFacts) -> Response:
        """Sends the request, and returns the answer, whose bytes are still to come."""
        relay = self._relay
        headers = apis.passed_up(request.headers) | relay.upstream.authorization()
        url = relay.upstream.url(route.path, request.query_params)
        counts = facts.with_counts if relay.adds_counts else None
        bodies = [facts.body] if counts is None else [counts, facts.body]
        self._facts, self._route, self._base = facts, route, sum(map(len, bodies))
        self._line = limits.LoggedRequest(
            at=round(relay.now(), 3), api=route.api, asked=facts.asked, hosted_tools=facts.hosted, status=0
        )
        sent = [Sent(route.name, request.method, url, headers, body) for body in bodies]
        self.task = asyncio.create_task(self._run(sent))
        return await asyncio.shield(self._head)

    def agent_left(self) -> None:
        """The agent has its answer, or is gone: what still comes is only counted."""
        self._left = True
        while not self._pieces.empty():
            self._pieces.get_nowait()
        if self.task is None:
            self._relay.open.discard(self)

    async def _run(self, tries: list[Sent]) -> None:
        """Sends the first of `tries`, and the next one where the provider refuses what the relay has added."""
        relay, error = self._relay, None
        try:
            while not await self._sent(tries.pop(0), is_last=not tries):
                pass
        except (*_BROKEN, _RefusedError, OSError) as caught:
            error = caught
        finally:
            fails = error is not None and not self._head.done()
            wait_s = relay.trouble("gives no answer", None) if fails else 0.0
            with contextlib.suppress(OSError):
                self._write(error, broken=True, wait_s=wait_s)
            relay.open.discard(self)
            if not self._head.done():
                why = f"base_url {relay.upstream.shown} gives no answer: {str(error) or type(error).__name__}"
                retry = {"retry-after": f"{wait_s:.0f}"}
                self._head.set_result(relay.refusal(_RefusedError(apis.UNREACHABLE, why, retry)))
        await self._put(error)

    async def _sent(self, sent: Sent, *, is_last: bool) -> bool:
        """Sends a request and reads its answer. Returns False where the next try should be sent."""
        relay = self._relay
        async with relay.provider.sent(sent) as got:
            self._line = replace(self._line, status=got.status)
            kind = got.headers.get("content-type", "").partition(";")[0].strip().lower()
            events = kind == "text/event-stream"
            if 200 <= got.status < 300 and (events or kind.endswith("json")):
                relay.troubles = 0
                # Only a provider that takes the same request without the addition has refused the addition.
                relay.adds_counts &= not self._refused
                await self._pass(got, events=events, drops_usage=not is_last)
                return True
            data = b""
            with contextlib.suppress(*_BROKEN, _RefusedError):
                data = await self.whole(_unpacked(got), "answer", MAX_ERROR_BYTES)
            if not is_last and got.status in (400, 422) and any(each in data for each in _ADDED):
                self._refused = True
                relay.count(self._line, self.reserve)
                return False
            self._head.set_result(self._failed(got, kind, data))
            return True

    async def _pass(self, got: Answer, *, events: bool, drops_usage: bool) -> None:
        """Passes on the answer's bytes, the last of them after the request is in the ledger."""
        relay = self._relay
        shape = FREE if self._route.free else SHAPES[self._route.api]
        reader = self._reader = AnswerReader(shape, events=events, drops_usage=drops_usage)
        self._head.set_result(StreamingResponse(self._stream(), got.status, relay.headers_of(got)))
        async for data in _unpacked(got):
            if self._first_s is None:
                self._first_s = time.monotonic() - self._begun
            if relay.order.record != "off":
                self._recorded = min(self._recorded + len(data), MAX_RECORDED_BYTES)
            passed = reader.feed(data)
            self.hold(self._base + reader.held_bytes + len(passed))
            if reader.complete:
                self._write()
            await self._put(relay.clean(passed))
        passed = relay.clean(reader.end())
        self._write()
        await self._put(passed)

    def _failed(self, got: Answer, kind: str, data: bytes) -> Response:
        """The answer for one that is no success of this API."""
        relay, status = self._relay, got.status
        is_words = kind == "text/plain"
        shown = relay.clean(data)[: _MAX_WORDS if is_words else _SHOWN].decode("utf-8", "replace").strip()
        came = (
            f"base_url {relay.upstream.shown} answered {status} with {kind or 'no content type'}: {shown!r}"
        )
        if status < 400:
            why = f"{came}; the base URL of a model API answers with JSON"
            return relay.refusal(_RefusedError(apis.INVALID, why))
        headers, wait_s = relay.headers_of(got), 0.0
        if _NO_QUOTA in data:
            relay.once(f"{relay.upstream.shown} answered {status}: the account has no quota left")
            headers = {name: each for name, each in headers.items() if name != "retry-after"} | _FINAL
        elif status in (408, 429) or status >= 500:
            wait_s = relay.trouble(f"answered {status}", _stated_s(got.headers, relay.now()))
            headers |= {"retry-after": f"{wait_s:.0f}"} | (_FINAL if wait_s > MAX_RETRY_S else {})
        self._write(wait_s=wait_s)
        if kind.endswith("json") or data.lstrip()[:1] in (b"{", b"["):
            return Response(relay.clean(data), status, headers | {"content-type": "application/json"})
        return relay.refusal(_RefusedError(apis.UNREACHABLE._replace(status=status), came, headers))

    async def _stream(self) -> AsyncIterator[bytes]:
        while (piece := await self._pieces.get()) is not None:
            if isinstance(piece, Exception):
                raise piece
            yield piece

    async def _put(self, piece: bytes | Exception | None) -> None:
        parts: list[bytes | Exception | None] = [piece]
        if isinstance(piece, bytes):
            parts = [piece[at : at + _CHUNK] for at in range(0, len(piece), _CHUNK)]
        for part in parts:
            if not self._left:
                await self._pieces.put(part)

    def _write(self, error: Exception | None = None, *, broken: bool = False, wait_s: float = 0.0) -> None:
        """Counts the request, once. One that broke off is charged for its input at least, and for all that it might
        have used if its provider had the time for that."""
        if self._written:
            return
        self._written = True
        line, tier = replace(self._line, broken=broken, wait_s=wait_s), self._facts.tier
        if self._reader is not None and not self._route.free:
            usage, estimated, answered, named = self._reader.metered(self._facts.input)
            line, tier = replace(line, usage=usage, estimated=estimated, answered=answered), named or tier
        elif not self._line.status and not isinstance(error, NOT_SENT) and not self._route.free:
            late = isinstance(error, httpcore.ReadTimeout)
            usage = self.reserve.usage if late else Usage(input_noncached=self._facts.input)
            line = replace(line, usage=usage, estimated=True)
        tier = "" if tier in requests.USUAL_TIERS else tier
        first_s = None if self._first_s is None else round(self._first_s, 4)
        whole_s = round(time.monotonic() - self._begun, 4)
        self._relay.count(replace(line, tier=tier, first_s=first_s, whole_s=whole_s), self.reserve)


async def _unpacked(answer: Answer) -> AsyncIterator[bytes]:
    """The answer's bytes, unpacked in pieces of bounded size: a small compressed answer may hold very many. Raises
    ValueError."""
    coding = answer.headers.get("content-encoding", "identity").strip().lower()
    if coding not in ("identity", "gzip", "x-gzip", "deflate"):
        why = f"the answer is compressed as {coding[:_SHOWN]}, though no compression was asked for"
        raise ValueError(why)
    unpack = None if coding == "identity" else zlib.decompressobj(wbits=zlib.MAX_WBITS | 32)
    n_bytes = 0
    async for data in answer.pieces:
        rest = data
        while rest:
            if unpack is None:
                piece, rest = rest, b""
            else:
                piece = unpack.decompress(rest, _CHUNK)
                rest = unpack.unconsumed_tail
            n_bytes += len(piece)
            if n_bytes > MAX_ANSWER_BYTES:
                raise ValueError(f"the answer has more than {MAX_ANSWER_BYTES:,} bytes")
            yield piece


_NUMBER = re.compile(r"\d{1,9}(\.\d{1,6})?")


def _stated_s(headers: Mapping[str, str], now: float) -> float | None:
    """Seconds from `now` to `retry-after`, which is a number or a date; None without."""
    text = headers.get("retry-after", "").strip()
    if _NUMBER.fullmatch(text):
        return float(text)
    try:
        return max(0.0, parsedate_to_datetime(text).timestamp() - now)
    except (ValueError, TypeError, OverflowError):
        return None
