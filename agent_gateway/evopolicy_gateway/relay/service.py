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
from typing import Any

import msgspec
import orjson
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from evopolicy_common.records.model_record import Level
from evopolicy_gateway.relay import apis, limits
from evopolicy_gateway.relay.answers import SHAPES, AnswerReader, Cleaner
from evopolicy_gateway.relay.apis import Refusal, Upstream
from evopolicy_gateway.relay.ledger import Ledger
from evopolicy_gateway.relay.provider import FAILED, Answer, Provider
from evopolicy_gateway.relay.recording import Cleaning, Recorder, Source
from evopolicy_gateway.relay.replaying import Replayed

MAX_REQUEST_BYTES = 32 << 20
MAX_ERROR_BYTES = 1 << 20
MAX_ANSWER_BYTES = 256 << 20
"""Of one answer, uncompressed."""
MAX_IN_FLIGHT = 32
REQUEST_WAIT_S = 60.0
"""Time in which a request's body has to arrive."""
MAX_RETRY_S = 60.0
"""Longest wait that clients keep within a request; with a longer one their turn fails, and the harness waits."""
_FIRST_RETRY_S = 1.0
_CHUNK = 64 << 10
_SHOWN = 200
_MAX_TOOLS = 20


class Order(limits.ModelTerms, frozen=True, kw_only=True):
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


class Relay:
    """The ASGI application."""

    def __init__(
        self,
        order: Order,
        *,
        counted: Callable[[], None],
        note: Callable[[str], None],
        spent: Callable[[str], None],
        now: Callable[[], float] = time.time,
    ) -> None:
        """`counted` is called after each request, `note` with a line for the operator, `spent` with the
        limit that is used up. `now`: Unix time, seconds."""
        self._order = order
        self.upstream = order.upstream
        self._ledger = Ledger(Path(order.ledger), order.model)
        self.used = self._ledger.used
        self._counted, self._note, self._spent = counted, note, spent
        self.now = now
        self.in_flight = 0
        self.troubles = 0
        """Failed requests since the last answered one."""
        self._told: set[str] = set()
        keys = order.upstream.key, *order.upstream.headers.values()
        self.secrets = tuple(value.encode() for value in keys if len(value) >= 8)
        base_url = order.upstream.base_url
        clean, folder = Cleaning(order.tokens, (*order.secrets, *keys)), Path(order.folder)
        self._provider: Source
        if order.replay:
            self._provider = Replayed(Path(order.replay), clean, base_url, folder, spent)
        else:
            self._provider = Provider(base_url, order.timeout_s)
        if order.record != "off":
            self._provider = Recorder(self._provider, folder, order.record, clean, base_url, note)
        self._authorization = order.upstream.authorization()

    async def close(self) -> None:
        await self._provider.close()
        self._ledger.close()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        request = Request(scope, receive)
        with contextlib.suppress(ClientDisconnect):
            response = await self._answer(request)
            await response(scope, receive, send)

    async def _answer(self, request: Request) -> Response:
        if not self._is_agents(request.headers):
            why = "the relay does not know this key; use the one of your environment"
            return self.refused(apis.NO_TOKEN, why)
        if "transfer-encoding" in request.headers and "content-length" in request.headers:
            return self.refused(apis.INVALID, "the request has two lengths", more={"connection": "close"})
        protocol = self.upstream.protocol
        api = request.url.path.strip("/").removeprefix("v1/")
        path = f"v1/{api}" if protocol == "anthropic" else api
        if api not in apis.METERED[protocol] + apis.FREE[protocol]:
            served = ", ".join(apis.METERED[protocol])
            return self.refused(apis.NO_PATH, f"{request.url.path[:_SHOWN]} is not served: only {served}")
        if request.headers.get("content-encoding", "identity").lower() != "identity":
            return self.refused(apis.COMPRESSED, "send the request uncompressed")
        body = b""
        if request.method == "POST":
            try:
                async with asyncio.timeout(REQUEST_WAIT_S):
                    body = await _whole(request.stream(), "request", MAX_REQUEST_BYTES)
            except TimeoutError:
                return self.refused(apis.TOO_SLOW, f"the request did not arrive within {REQUEST_WAIT_S:g} s")
            except ValueError as error:
                return self.refused(apis.TOO_LARGE, str(error))
        elif request.method != "GET" or api in SHAPES:
            return self.refused(apis.NO_PATH, f"{request.method} is not served here")
        if api not in SHAPES:
            return await self._free(request, path, body)
        return await self._metered(request, api, path, body)

    async def _free(self, request: Request, path: str, body: bytes) -> Response:
        """Passes on a request that costs nothing."""
        try:
            async with self.sent(request, path, body) as answer:
                data = await _whole(_unpacked(answer), "answer", MAX_ERROR_BYTES)
        except (*FAILED, ValueError, zlib.error) as error:
            return self.refused(apis.UNREACHABLE, self.unreachable(error))
        return Response(self.clean(data), answer.status, self.headers_of(answer))

    async def _metered(self, request: Request, api: str, path: str, body: bytes) -> Response:
        order, used = self._order, self.used
        try:
            document = orjson.loads(body)
        except orjson.JSONDecodeError as error:
            return self.refused(apis.INVALID, f"the request is not JSON: {error}")
        if not isinstance(document, dict):
            return self.refused(apis.INVALID, "the request is not a JSON object")
        if document.get("background"):
            # It would go on after its answer, uncounted.
            return self.refused(apis.INVALID, "requests in the background are not served")
        asked = str(document.get("model", ""))[:_SHOWN]
        if order.model and asked != order.model:
            if order.declared_only:
                why = f"the run's model is {order.model}; {asked!r} is not allowed"
                return self.refused(apis.OTHER_MODEL, why)
            self._once(f"the agent asks for the model {asked!r} besides {order.model}")
        if hosted := tuple(kind[:_SHOWN] for kind in apis.hosted_tools(document)[:_MAX_TOOLS]):
            if order.own_tools_only:
                return self.refused(apis.INVALID, f"tools of the provider are refused: {', '.join(hosted)}")
            self._once(f"the agent offers its model tools of the provider: {', '.join(hosted)}")
        if what := used.over(order.limits, order.prices, self.in_flight):
            if not used.over(order.limits, order.prices):
                why = "the last requests of the model budget are under way"
                return self.refused(apis.TOO_MANY, why, retry_after="1")
            self._spent(what)
            return self.refused(apis.SPENT, f"the run's model budget is spent: {what}")
        if self.in_flight >= MAX_IN_FLIGHT:
            return self.refused(apis.TOO_MANY, f"{MAX_IN_FLIGHT} requests are under way", retry_after="1")
        if order.declared_only or order.own_tools_only:
            # A name that occurs twice is read in one way here, and perhaps in another there.
            body = orjson.dumps(document)
        options = document.get("stream_options")
        options = options if isinstance(options, dict) else {}
        streams = api == "chat/completions" and document.get("stream") is True
        if drops_usage := streams and options.get("include_usage") is not True:
            body = orjson.dumps(document | {"stream_options": options | {"include_usage": True}})
        line = limits.Request(at=round(self.now(), 3), api=api, asked=asked, hosted_tools=hosted, status=0)
        exchange = _Exchange(self, line, body, drops_usage=drops_usage)
        response = None
        try:
            response = await exchange.answer(request, path)
        finally:
            if not isinstance(response, _Streamed):
                await exchange.close()
        return response

    def _is_agents(self, headers: Mapping[str, str]) -> bool:
        given = [headers.get("authorization", "").partition(" ")[2]]
        given += [headers.get(name, "") for name in ("x-api-key", "api-key")]
        return any(hmac.compare_digest(each.encode(), self._order.token.encode()) for each in given)

    def sent(
        self, request: Request, path: str, body: bytes
    ) -> contextlib.AbstractAsyncContextManager[Answer]:
        """The request to the provider, built anew."""
        headers = apis.passed_up(request.headers) | self._authorization
        url = self.upstream.url(path, request.query_params)
        return self._provider.sent(request.method, url, headers, body)

    def refused(
        self, refusal: Refusal, message: str, *, retry_after: str = "", more: Mapping[str, str] = {}
    ) -> Response:
        """An answer of the relay's own. Without `retry_after` or headers in `more`, it is final."""
        headers = {"retry-after": retry_after} if retry_after else dict(more) or {"x-should-retry": "false"}
        headers["content-type"] = "application/json"
        return Response(refusal.body(self.upstream.protocol, message), refusal.status, headers)

    def count(self, request: limits.Request) -> None:
        """Writes a finished request to the ledger. Raises OSError when the disk refuses."""
        self.in_flight -= 1
        self._ledger.write(request)
        self._counted()

    def headers_of(self, answer: Answer) -> dict[str, str]:
        return {
            name: self.clean(value.encode()).decode("latin-1")
            for name, value in apis.passed_down(answer.headers).items()
        }

    def clean(self, data: bytes) -> bytes:
        """The bytes without the key, which some servers repeat in their errors."""
        cleaner = Cleaner(self.secrets)
        return cleaner.feed(data) + cleaner.end()

    def unreachable(self, error: Exception) -> str:
        text = f"base_url {self.upstream.shown} gives no answer: {str(error) or type(error).__name__}"
        return self.clean(text.encode()).decode("utf-8", "replace")

    def _once(self, text: str) -> None:
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
    """One request that costs tokens, and its answer. Call `close` at the end of both."""

    def __init__(self, relay: Relay, line: limits.Request, body: bytes, *, drops_usage: bool) -> None:
        """`line`: of the ledger, as far as it is known now."""
        self._relay, self._line = relay, line
        self._body, self._drops_usage = body, drops_usage
        self._begun = time.monotonic()
        self._first_s: float | None = None
        self._written = False
        self._status = 0
        self._reader: AnswerReader | None = None
        self._opened = contextlib.AsyncExitStack()
        relay.in_flight += 1

    async def answer(self, request: Request, path: str) -> Response:
        relay = self._relay
        try:
            async with _while_there(request.receive):
                got = await self._opened.enter_async_context(relay.sent(request, path, self._body))
        except FAILED as error:
            wait_s = relay.trouble("gives no answer", None)
            self._write(wait_s=wait_s)
            return relay.refused(apis.UNREACHABLE, relay.unreachable(error), retry_after=f"{wait_s:.0f}")
        self._status = got.status
        kind = got.headers.get("content-type", "").partition(";")[0].strip().lower()
        events = kind == "text/event-stream"
        if 200 <= got.status < 300 and (events or kind.endswith("json")):
            relay.troubles = 0
            self._reader = AnswerReader(SHAPES[self._line.api], events=events, drops_usage=self._drops_usage)
            return _Streamed(self, self._passed(got, self._reader), got.status, relay.headers_of(got))
        try:
            data = await _whole(_unpacked(got), "answer", MAX_ERROR_BYTES)
        except (*FAILED, ValueError, zlib.error):
            data = b""
        return self._failed(got, kind, data)

    async def close(self) -> None:
        """Counts an answer that broke off, and ends the provider's."""
        self._write(broken=True)
        await self._opened.aclose()

    def _failed(self, got: Answer, kind: str, data: bytes) -> Response:
        """The answer for one that is no success of this API."""
        relay, status = self._relay, got.status
        shown = relay.clean(data[:_SHOWN]).decode("utf-8", "replace").strip()
        base, kind_shown = relay.upstream.shown, kind or "no content type"
        came = f"base_url {base} answered {status} with {kind_shown}: {shown!r}"
        if status < 400:
            self._write(broken=True)
            return relay.refused(apis.INVALID, f"{came}; the base URL of a model API answers with JSON")
        headers, wait_s = relay.headers_of(got), 0.0
        if status in (408, 429) or status >= 500:
            wait_s = relay.trouble(f"answered {status}", _stated_s(got.headers, relay.now()))
            headers["retry-after"] = f"{wait_s:.0f}"
            if wait_s > MAX_RETRY_S:
                headers["x-should-retry"] = "false"
        self._write(wait_s=wait_s)
        if kind.endswith("json"):
            return Response(relay.clean(data), status, headers)
        return relay.refused(apis.UNREACHABLE._replace(status=status), came, more=headers)

    async def _passed(self, got: Answer, reader: AnswerReader) -> AsyncIterator[bytes]:
        """The answer's bytes, the last of them after the request is in the ledger."""
        cleaner = Cleaner(self._relay.secrets)
        async for data in _unpacked(got):
            if self._first_s is None:
                self._first_s = time.monotonic() - self._begun
            passed = reader.feed(data)
            if reader.complete:
                self._write()
            if passed and (cleaned := cleaner.feed(passed)):
                yield cleaned
        last = reader.end()
        self._write()
        if cleaned := cleaner.feed(last) + cleaner.end():
            yield cleaned

    def _write(self, **more: Any) -> None:
        """Counts the request, once."""
        if self._written:
            return
        self._written = True
        if self._reader is not None:
            more |= self._reader.metered(len(self._body))
        more["first_s"] = None if self._first_s is None else round(self._first_s, 4)
        more["whole_s"] = round(time.monotonic() - self._begun, 4)
        self._relay.count(msgspec.structs.replace(self._line, status=self._status, **more))


class _Streamed(StreamingResponse):
    """Closes the exchange, also when the agent has gone before the first byte."""

    def __init__(self, exchange: _Exchange, *given: Any) -> None:
        super().__init__(*given)
        self._exchange = exchange

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            async with _while_there(receive):
                await self.stream_response(send)
        finally:
            await self._exchange.close()


@contextlib.asynccontextmanager
async def _while_there(receive: Receive) -> AsyncIterator[None]:
    """Ends what is inside when the agent goes, and raises ClientDisconnect then. The request's body has to
    be read before."""
    task, watching = asyncio.current_task(), True
    assert task is not None

    def hung_up(_: asyncio.Future[Any]) -> None:
        if watching:
            task.cancel()

    # After the body, the next message is the end of the connection.
    gone = asyncio.ensure_future(receive())
    gone.add_done_callback(hung_up)
    try:
        yield
    except asyncio.CancelledError:
        if not gone.done():
            raise
        task.uncancel()
        raise ClientDisconnect from None
    finally:
        watching = False
        gone.cancel()


async def _whole(pieces: AsyncIterator[bytes], what: str, limit: int) -> bytes:
    """All pieces together. Raises ValueError when they are longer."""
    data = bytearray()
    async for piece in pieces:
        data += piece
        if len(data) > limit:
            raise ValueError(f"the {what} has more than {limit:,} bytes")
    return bytes(data)


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
