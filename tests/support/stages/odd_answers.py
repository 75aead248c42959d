"""Answers of a model API that no client should trust, for `Step(odd=…)`. Each writes a whole HTTP answer."""

from __future__ import annotations

import gzip
import json
import time
from collections.abc import Callable
from typing import Any

Odd = Callable[[Any, dict[str, Any]], None]
PAGE = b"<!doctype html><html><title>Sign in</title></html>"
BOMB_BYTES = 400 << 20


def page(handler: Any, _: dict[str, Any]) -> None:
    """A web page with status 200, as behind a wrong base URL."""
    handler._send(200, PAGE, "text/html")


def garbage(body: bytes, kind: str = "text/event-stream", status: int = 200) -> Odd:
    """Any bytes."""
    return lambda handler, _: handler._send(status, body, kind)


def answers(status: int, document: Any) -> Odd:
    """A document, which need be none of the API's."""
    return garbage(json.dumps(document).encode(), "application/json", status)


def busy(status: int = 429, **headers: str) -> Odd:
    """An error with further headers, such as `retry_after="2"`."""

    def answer(handler: Any, _: dict[str, Any]) -> None:
        body = json.dumps({"error": {"type": "rate_limit_error", "message": "slow down"}}).encode()
        _send(handler, status, body, **{name.replace("_", "-"): value for name, value in headers.items()})

    return answer


def hang(seconds: float) -> Odd:
    """No byte for some time, then the end of the connection."""

    def answer(handler: Any, _: dict[str, Any]) -> None:
        time.sleep(seconds)
        handler.close_connection = True

    return answer


def stream(*documents: dict[str, Any], whole: bool = True) -> Odd:
    """A stream of Chat Completions; without its end where it is not `whole`."""

    def answer(handler: Any, request: dict[str, Any]) -> None:
        handler.send_response(200)
        handler.send_header("content-type", "text/event-stream")
        handler.send_header("transfer-encoding", "chunked")
        handler.end_headers()
        for document in documents:
            event = {"id": "c1", "object": "chat.completion.chunk", "model": request["model"], **document}
            _chunk(handler, f"data: {json.dumps(event)}\n\n".encode())
        if whole:
            _chunk(handler, b"data: [DONE]\n\n")
            handler.wfile.write(b"0\r\n\r\n")
        handler.close_connection = True

    return answer


def says(text: str, end: bool = True) -> dict[str, Any]:
    """A chunk with text."""
    choice = {"index": 0, "delta": {"role": "assistant", "content": text}}
    return {"choices": [choice | {"finish_reason": "stop" if end else None}]}


def bomb(handler: Any, _: dict[str, Any]) -> None:
    """Few bytes that unpack to very many."""
    _send(handler, 200, gzip.compress(b" " * BOMB_BYTES, 1), **{"content-encoding": "gzip"})


def repeats_its_headers(handler: Any, _: dict[str, Any]) -> None:
    """An error that repeats the key, as some servers do."""
    text = json.dumps({"error": {"message": f"bad request: {dict(handler.headers)}"}}).encode()
    handler._send(400, text, "application/json")


def _send(handler: Any, status: int, body: bytes, **headers: str) -> None:
    handler.send_response(status)
    for name, value in {
        "content-type": "application/json",
        **headers,
        "content-length": str(len(body)),
    }.items():
        handler.send_header(name, value)
    handler.end_headers()
    handler.wfile.write(body)


def _chunk(handler: Any, data: bytes) -> None:
    handler.wfile.write(f"{len(data):x}\r\n".encode() + data + b"\r\n")
    handler.wfile.flush()


def chunk(document: dict[str, Any] | None) -> bytes:
    """A further event of a stream that is not whole yet, as bytes of HTTP; None: its end."""
    if document is None:
        return b"0\r\n\r\n"
    event = f"data: {json.dumps(document)}\n\n".encode()
    return f"{len(event):x}\r\n".encode() + event + b"\r\n"
