"""Records the calls that go to a provider (`evopolicy_common/records/model_record.py` has the form).

The run has precedence: at a limit, or when the disk refuses, recording stops with a note.

`Replayed` answers calls from a run's record in place of a provider, which is not asked. A call takes the first unused
one of the record whose canonical request has the same digest. One that has none ends the replay: `DIFFERENCE` in the
new record's folder then has the recorded request beside the new one.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import httpcore
import msgspec
import orjson
from msgspec.structs import replace

from evopolicy_common.errors import ConfigError
from evopolicy_common.records import model_record
from evopolicy_common.records.model_record import (
    Level,
    ModelCall,
    Pack,
    StoredRequest,
    key_of,
    read_calls,
    request_of,
)
from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.relay import apis
from evopolicy_gateway.relay.canonical import canonical, difference
from evopolicy_gateway.relay.provider import Answer, Sent

MAX_ANSWER_BYTES = 8 << 20
"""Limit of an answer whose content is kept."""
_MAX_HEADERS, _MAX_HEADER = 30, 200


class CallSource(Protocol):
    """Where answers come from."""

    def sent(self, sent: Sent) -> contextlib.AbstractAsyncContextManager[Answer]: ...

    async def close(self) -> None: ...


class Cleaning:
    """Takes secrets out of what is recorded, by the rules of logs."""

    def __init__(self, tokens: tuple[str, ...], secrets: tuple[str, ...]) -> None:
        """`tokens`: those that only this run's own services accept. Each has a text in its place, which a replay
        replaces by the token."""
        self._tokens = [(token.encode(), f"[token-{n}]".encode()) for n, token in enumerate(tokens)]
        self._redact = Redaction(secrets)

    def __call__(self, data: bytes) -> bytes:
        for token, text in self._tokens:
            data = data.replace(token, text)
        return self._redact(data)

    def restored(self, data: bytes) -> bytes:
        """The data with the run's tokens in their places."""
        for token, text in self._tokens:
            data = data.replace(text, token)
        return data


class CallRecorder:
    """A provider whose calls are recorded."""

    def __init__(
        self,
        source: CallSource,
        folder: Path,
        level: Level,
        clean: Cleaning,
        note: Callable[[str], None],
    ) -> None:
        self._source, self._clean, self._note = source, clean, note
        self._stopped = folder / model_record.STOPPED
        self._on = not self._stopped.exists()
        self._n = self._begun = 0
        self._pack: Pack | None = None
        self._opened = contextlib.ExitStack()
        if self._on:
            with self._stopping():
                self._open(folder, level)

    async def close(self) -> None:
        self._opened.close()
        await self._source.close()

    def _open(self, folder: Path, level: Level) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._calls = self._opened.enter_context((folder / model_record.CALLS).open("ab", buffering=0))
        if self._calls.tell():
            self._calls.write(b"\n")  # a kill may have left half a line
            known = model_record.read_calls(folder)
            self._n, self._begun = len(known), max((call.n for call in known), default=-1) + 1
        if level == "full":
            self._pack = self._opened.enter_context(contextlib.closing(Pack(folder, writes=True)))

    @contextlib.asynccontextmanager
    async def sent(self, sent: Sent) -> AsyncIterator[Answer]:
        n, self._begun = self._begun, self._begun + 1
        answer: _Heard | None = None
        try:
            async with self._source.sent(sent) as got:
                answer = _Heard(got)
                yield got._replace(pieces=answer.pieces())
        finally:
            if self._on:
                with self._stopping():
                    self._keep(n, sent, answer)

    @contextlib.contextmanager
    def _stopping(self) -> Iterator[None]:
        """An error inside the `with` ends the record, and not the run."""
        try:
            yield
        except (OSError, ValueError, ConfigError) as error:
            self._on = False
            self._note(f"the record of model calls stops here, and the run continues: {error}")
            with contextlib.suppress(OSError):
                # `run.json` has this text, which is published: no paths.
                why = str(error) if isinstance(error, ValueError) else getattr(error, "strerror", None)
                self._stopped.write_text(f"{why or 'its files cannot be read'}\n")

    def _keep(self, n: int, sent: Sent, answer: _Heard | None) -> None:
        if self._n >= model_record.MAX_CALLS:
            raise ValueError(f"its limit of {model_record.MAX_CALLS:,} calls is reached")
        request = canonical(sent.name, self._clean(sent.body))
        line = ModelCall(
            n=n, api=sent.name, method=sent.method, digest=key_of(request), status=0, broken=True
        )
        if answer is not None:
            data = self._clean(bytes(answer.heard))
            passed = itertools.islice(apis.passed_down(answer.got.headers).items(), _MAX_HEADERS)
            cleaned = (
                (name, self._clean(value.encode()).decode("utf-8", "replace")) for name, value in passed
            )
            headers = {name: value[:_MAX_HEADER] for name, value in cleaned}
            line = replace(line, status=answer.got.status, headers=headers, broken=not answer.ended)
            line = replace(line, answer="" if answer.left_out else key_of(data), left_out=answer.left_out)
            if self._pack is not None and not answer.left_out:
                self._pack.put(data)
        if self._pack is not None:
            line = replace(line, request=_put_request(self._pack, request))
        self._calls.write(msgspec.json.encode(line) + b"\n")
        self._n += 1


class _Heard:
    """An answer whose bytes are kept as they pass."""

    def __init__(self, got: Answer) -> None:
        self.got = got
        self.heard = bytearray()
        self.ended = False
        coding = got.headers.get("content-encoding", "identity").strip().lower()
        self.left_out = "" if coding == "identity" else f"it came compressed as {coding[:20]}"

    async def pieces(self) -> AsyncIterator[bytes]:
        async for data in self.got.pieces:
            if len(self.heard) + len(data) > MAX_ANSWER_BYTES:
                self.left_out = "it is too long"
                self.heard.clear()
            if not self.left_out:
                self.heard += data
            yield data
        self.ended = True


def document_of(request: bytes) -> dict[str, Any]:
    """A canonical request as a JSON object; one that is none, as the text in `body`."""
    try:
        document = orjson.loads(request)
    except orjson.JSONDecodeError:
        document = None
    return document if isinstance(document, dict) else {"body": request.decode("utf-8", "replace")}


def _put_request(pack: Pack, request: bytes) -> str:
    kept = StoredRequest(plain={}, lists={})
    for name, value in document_of(request).items():
        if isinstance(value, list):
            kept.lists[name] = [pack.put(orjson.dumps(each)) for each in value]
        else:
            kept.plain[name] = value
    return pack.put(msgspec.json.encode(kept))


DIFFERENCE = "difference.txt"
_PIECE = 64 << 10


class Replayed:
    """The record of a run as a source of answers."""

    def __init__(self, folder: Path, clean: Cleaning, out: Path, differs: Callable[[str], None]) -> None:
        """`out`: where `DIFFERENCE` is written. `differs` is called with the first line of it. Raises ConfigError."""
        self._left = read_calls(folder)
        self._pack = Pack(folder)
        self._clean, self._out, self._differs = clean, out, differs

    async def close(self) -> None:
        self._pack.close()

    @contextlib.asynccontextmanager
    async def sent(self, sent: Sent) -> AsyncIterator[Answer]:
        api = sent.name
        request = canonical(api, self._clean(sent.body))
        digest = key_of(request)
        call = next((each for each in self._left if each.digest == digest and each.api == api), None)
        if call is None or call.left_out:
            why = f"answer {call.n} was not kept: {call.left_out}" if call else self._unmatched(api, request)
            if not (path := self._out / DIFFERENCE).exists():
                path.write_text(why + "\n")
            self._differs(why.partition("\n")[0])
            refusal = {"error": {"message": "the replay has ended", "type": "invalid_request_error"}}
            ended = {"content-type": "application/json", "x-should-retry": "false"}
            yield Answer(400, ended, _pieces(json.dumps(refusal).encode()))
            return
        self._left.remove(call)
        if not call.status:
            raise httpcore.NetworkError("no answer came when this was recorded")
        data = self._clean.restored(self._pack.get(call.answer))
        yield Answer(call.status, call.headers, _pieces(data, broken=call.broken))

    def _unmatched(self, api: str, request: bytes) -> str:
        expected = next((call for call in self._left if call.api == api), None)
        if expected is None:
            return f"a request to {api} comes after all that were recorded"
        recorded = request_of(self._pack, expected)
        return f"request {expected.n} to {api} differs:\n{difference(recorded, document_of(request))}"


async def _pieces(data: bytes, *, broken: bool = False) -> AsyncIterator[bytes]:
    for at in range(0, len(data), _PIECE):
        yield data[at : at + _PIECE]
    if broken:
        raise httpcore.ReadError("the answer broke off when this was recorded")
