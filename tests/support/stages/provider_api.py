"""Model providers on loopback, written after their documented rules: what each API streams, and what each refuses.

A `ProviderApi` plays a script of `Said`. It refuses a request that does not bring back the model's earlier messages as
they were sent, with reasoning, signatures and ids, and it counts what it claims to have generated.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from typing import Any

from stages.loopback import Loopback

Document = dict[str, Any]
Refuses = Callable[[Document], tuple[Any, ...] | None]
"""A request's document → status and body of an error, perhaps with its headers, or None."""
Sends = Callable[["ProviderApi", Any, Document, "Said"], bool]
"""Writes an answer of its own to the server's handler; False: the usual one is sent."""
FRESH, CACHED, OUTPUT, REASONING = 300, 700, 20, 5
"""Tokens that every answer claims: input without the cached ones, cached input, output, reasoning in it."""


def conversation_settings(base_url: str, api: str = "chat", **more: Any) -> dict[str, Any]:
    """What a `Conversation` with a model on that server is begun with."""
    settings: dict[str, Any] = {"api": api, "provider": "compatible", "model": "m-1", "base_url": base_url}
    settings |= {"effort": None, "system": "", "parameters": {}, "retries": 0, "timeout_s": 9.0}
    return settings | {"context_tokens": 1000, "max_output_tokens": 9} | more


@dataclass(frozen=True)
class Said:
    """One answer of the model."""

    text: str = ""
    commands: tuple[str, ...] = ()
    reasoning: str = ""
    finish: str = ""
    """Why it ended, in the API's words; empty: as usual."""


def _chat_message(said: Said, n: int) -> Document:
    functions = ({"name": "bash", "arguments": json.dumps({"command": each})} for each in said.commands)
    calls = [{"id": f"call_{n}_{at}", "type": "function", "function": f} for at, f in enumerate(functions)]
    message: Document = {"role": "assistant", "content": said.text or None}
    message |= {"reasoning_content": said.reasoning} if said.reasoning else {}
    return message | ({"tool_calls": calls} if calls else {})


def _router_message(said: Said, n: int) -> Document:
    """As OpenRouter has it: the reasoning of any provider in one form."""
    message = _chat_message(said, n)
    if text := message.pop("reasoning_content", ""):
        detail = {"type": "reasoning.text", "text": text, "signature": "signed", "id": f"r{n}", "index": 0}
        message["reasoning_details"] = [detail | {"format": "anthropic-claude-v1"}]
    return message


def chat_usage() -> Document:
    both = FRESH + CACHED
    details = {"prompt_tokens_details": {"cached_tokens": CACHED}}
    return {"prompt_tokens": both, "completion_tokens": OUTPUT, "total_tokens": both + OUTPUT, **details}


def responses_usage() -> Document:
    known = {"input_tokens": FRESH + CACHED, "input_tokens_details": {"cached_tokens": CACHED}}
    known |= {"output_tokens": OUTPUT, "output_tokens_details": {"reasoning_tokens": REASONING}}
    return known | {"total_tokens": FRESH + CACHED + OUTPUT}


def gemini_usage() -> Document:
    known = {"promptTokenCount": FRESH + CACHED, "cachedContentTokenCount": CACHED}
    known |= {"candidatesTokenCount": OUTPUT - REASONING, "thoughtsTokenCount": REASONING}
    return known | {"totalTokenCount": FRESH + CACHED + OUTPUT}


def _chat_document(message: Document, said: Said, model: str) -> Document:
    finish = said.finish or ("tool_calls" if said.commands else "stop")
    choice = {"index": 0, "message": message, "finish_reason": finish}
    known = {"id": "c", "object": "chat.completion", "created": 1, "model": model, "provider": "p"}
    return known | {"choices": [choice], "usage": chat_usage()}


def chat_chunk(delta: Document | None, finish: str | None = None) -> Document:
    known = {"id": "c", "object": "chat.completion.chunk", "created": 1, "model": "m", "provider": "p"}
    return known | {"choices": [{"index": 0, "delta": delta, "finish_reason": finish}]}


def _chat_events(message: Document, said: Said, model: str) -> Iterator[Document]:
    if said.reasoning:
        fields = {name: value for name, value in message.items() if name.startswith("reasoning")}
        yield chat_chunk({"role": "assistant", "content": "", **fields})
    if said.text:
        yield chat_chunk({"content": said.text})
    for at, call in enumerate(message.get("tool_calls", ())):
        whole = call["function"]["arguments"]
        if not isinstance(whole, str):
            yield chat_chunk({"tool_calls": [call | {"index": at}]})
            continue
        begun = call | {"index": at, "function": call["function"] | {"arguments": ""}}
        yield chat_chunk({"tool_calls": [begun]})
        for piece in (whole[:5], whole[5:]):
            yield chat_chunk({"tool_calls": [{"index": at, "function": {"arguments": piece}}]})
    yield chat_chunk({}, said.finish or ("tool_calls" if said.commands else "stop"))
    yield {"id": "c", "object": "chat.completion.chunk", "created": 1, "choices": [], "usage": chat_usage()}


def _responses_message(said: Said, n: int) -> Document:
    items: list[Document] = []
    if said.reasoning:
        sealed = f"sealed({said.reasoning})"
        items.append({"id": f"rs_{n}", "type": "reasoning", "summary": [], "encrypted_content": sealed})
    if said.text:
        part = {"type": "output_text", "text": said.text, "annotations": []}
        message = {"id": f"msg_{n}", "type": "message", "role": "assistant", "status": "completed"}
        items.append(message | {"content": [part]})
    for at, command in enumerate(said.commands):
        call = {"id": f"fc_{n}_{at}", "type": "function_call", "call_id": f"call_{n}_{at}", "name": "bash"}
        items.append(call | {"arguments": json.dumps({"command": command}), "status": "completed"})
    return {"output": items}


def _responses_document(message: Document, said: Said, model: str) -> Document:
    usage = responses_usage()
    known = {"id": "resp", "object": "response", "created_at": 1, "model": model, "status": "completed"}
    known |= {"parallel_tool_calls": True, "tool_choice": "auto", "tools": [], "usage": usage}
    if said.finish:
        known |= {"status": "incomplete", "incomplete_details": {"reason": said.finish}}
    return known | message


def _responses_events(message: Document, said: Said, model: str) -> Iterator[Document]:
    whole = _responses_document(message, said, model)
    response = whole | {"output": [], "usage": None, "status": "in_progress"}
    yield {"type": "response.created", "response": response}
    for at, item in enumerate(message["output"]):
        known = {"output_index": at, "item_id": item["id"]}
        begun = item | {"status": "in_progress"} | ({"arguments": ""} if "arguments" in item else {})
        yield {"type": "response.output_item.added", "output_index": at, "item": begun | {"content": []}}
        if item["type"] == "message":
            part, known = item["content"][0] | {"text": ""}, known | {"content_index": 0}
            yield {"type": "response.content_part.added", "part": part, **known}
            yield {"type": "response.output_text.delta", "delta": said.text, **known}
        elif item["type"] == "function_call":
            for piece in (item["arguments"][:5], item["arguments"][5:]):
                yield {"type": "response.function_call_arguments.delta", "delta": piece, **known}
        yield {"type": "response.output_item.done", "output_index": at, "item": item}
    kind = "response.incomplete" if said.finish else "response.completed"
    yield {"type": kind, "response": whole}


def _messages_message(said: Said, n: int) -> Document:
    blocks: list[Document] = []
    if said.reasoning:
        signature = f"signed({said.reasoning})"
        blocks.append({"type": "thinking", "thinking": said.reasoning, "signature": signature})
    blocks += [{"type": "text", "text": said.text}] if said.text else []
    for at, command in enumerate(said.commands):
        block = {"type": "tool_use", "id": f"toolu_{n}_{at}", "name": "bash"}
        blocks.append(block | {"input": {"command": command}})
    return {"role": "assistant", "content": blocks}


def _messages_document(message: Document, said: Said, model: str) -> Document:
    usage = {"input_tokens": FRESH, "cache_read_input_tokens": CACHED, "cache_creation_input_tokens": 0}
    stop = said.finish or ("tool_use" if said.commands else "end_turn")
    known = {"id": "msg", "type": "message", "model": model, "stop_reason": stop, "stop_sequence": None}
    return known | message | {"usage": usage | {"output_tokens": OUTPUT}}


def _messages_events(message: Document, said: Said, model: str) -> Iterator[Document]:
    whole = _messages_document(message, said, model)
    usage = whole["usage"] | {"output_tokens": 1}
    yield {"type": "message_start", "message": whole | {"content": [], "stop_reason": None, "usage": usage}}
    for at, block in enumerate(message["content"]):
        begun, deltas = block, []
        if block["type"] == "thinking":
            begun = block | {"thinking": "", "signature": ""}
            deltas = [{"type": "thinking_delta", "thinking": block["thinking"]}]
            deltas += [{"type": "signature_delta", "signature": block["signature"]}]
        elif block["type"] == "text":
            begun, deltas = block | {"text": ""}, [{"type": "text_delta", "text": block["text"]}]
        elif block["type"] == "tool_use":
            given = json.dumps(block["input"])
            begun = block | {"input": {}}
            deltas = [{"type": "input_json_delta", "partial_json": piece} for piece in (given[:5], given[5:])]
        yield {"type": "content_block_start", "index": at, "content_block": begun}
        yield from ({"type": "content_block_delta", "index": at, "delta": delta} for delta in deltas)
        yield {"type": "content_block_stop", "index": at}
    stop = {"stop_reason": whole["stop_reason"], "stop_sequence": None}
    yield {"type": "message_delta", "delta": stop, "usage": {"output_tokens": OUTPUT}}
    yield {"type": "message_stop"}


def _gemini_message(said: Said, n: int) -> Document:
    parts: list[Document] = [{"text": said.text}] if said.text else []
    for at, command in enumerate(said.commands):
        part: Document = {"functionCall": {"name": "bash", "args": {"command": command}}}
        # Only the first call of an answer is signed.
        parts.append(part | ({"thoughtSignature": "c2lnbmVk"} if said.reasoning and at == 0 else {}))
    return {"role": "model", "parts": parts}


def _gemini_document(message: Document, said: Said, model: str) -> Document:
    candidate = {"content": message, "finishReason": said.finish or "STOP", "index": 0}
    known = {"candidates": [candidate], "usageMetadata": gemini_usage()}
    return known | {"modelVersion": model, "responseId": "g"}


def _gemini_events(message: Document, said: Said, model: str) -> Iterator[Document]:
    whole = _gemini_document(message, said, model)
    for part in message["parts"]:
        candidate = {"content": {"role": "model", "parts": [part]}, "index": 0}
        yield {"candidates": [candidate], "modelVersion": model, "responseId": "g"}
    end = {"content": {"role": "model", "parts": [{"text": ""}]}, "index": 0}
    end |= {"finishReason": said.finish or "STOP"}
    yield whole | {"candidates": [end]}


def _items(request: Document) -> list[Document]:
    mine = ("reasoning", "function_call")
    return [item for item in request["input"] if item.get("type") in mine or item.get("role") == "assistant"]


def _assistants(request: Document) -> list[Document]:
    return [message for message in request["messages"] if message["role"] == "assistant"]


def _models(request: Document) -> list[Document]:
    return [content for content in request["contents"] if content["role"] == "model"]


SPEECHES: dict[str, tuple[str, Any, Any, Any, Any]] = {
    "chat": ("/v1/chat/completions", _chat_message, _chat_document, _chat_events, _assistants),
    "openrouter": ("/v1/chat/completions", _router_message, _chat_document, _chat_events, _assistants),
    "responses": ("/v1/responses", _responses_message, _responses_document, _responses_events, _items),
    "messages": ("/v1/messages", _messages_message, _messages_document, _messages_events, _assistants),
    "gemini": ("/v1beta/models/", _gemini_message, _gemini_document, _gemini_events, _models),
}
"""By API, and for a provider with a form of its own: the path; an answer's message, document and events; and the
model's messages in a request."""


def _holds(got: Any, sent: Any) -> bool:
    """Whether a message came back as it was sent; further fields do no harm."""
    if isinstance(sent, dict) and isinstance(got, dict):
        return all(_holds(got.get(name), value) for name, value in sent.items() if name != "status")
    if isinstance(sent, list) and isinstance(got, list):
        return len(got) == len(sent) and all(map(_holds, got, sent))
    return bool(got == sent)


class ProviderApi(Loopback):
    """Serves while the `with` lasts. `base_url` is as the vendor's library takes it."""

    def __init__(
        self,
        api: str,
        script: Sequence[Said],
        *,
        refuses: Refuses = lambda request: None,
        sends: Sends = lambda server, handler, request, said: False,
        models: Sequence[str] = ("m-1",),
        streams: bool = True,
    ) -> None:
        """`streams`: whether it heeds a request's wish for a stream."""
        self.script = tuple(script)
        self.requests: list[Document] = []
        """All that cost tokens, in order; Gemini's with the field `stream`."""
        self.n_answered = 0
        """Answers with usage."""
        path, self.message, self.document, self.events, self.repeated = SPEECHES[api]
        self._sent: list[list[Any]] = []
        """The model's messages, by answer. A request without the last of them gets another in their place."""
        self._lock = threading.Lock()
        provider = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def log_message(self, format: str, *args: Any) -> None:
                pass

            def do_GET(self) -> None:
                listed = [{"id": name, "object": "model"} for name in models]
                self.send(200, {"object": "list", "data": listed})

            def do_POST(self) -> None:
                request = json.loads(self.rfile.read(int(self.headers["content-length"])))
                if not self.path.startswith(path):
                    self.send(404, {"error": {"message": f"there is no {self.path}"}})
                    return
                if api == "gemini":
                    request["stream"] = "stream" in self.path
                with provider._lock:
                    provider.requests.append(request)
                    if (refused := refuses(request) or provider._changed(request)) is not None:
                        self.send(*refused[:2], **dict(*refused[2:]))
                        return
                    n, more = len(provider._sent), Said(text="Nothing more to do.")
                    said = provider.script[n] if n < len(provider.script) else more
                    if sends(provider, self, request, said):
                        return
                    provider.answer(self, request, said, streams and bool(request.get("stream")))

            def send(self, status: int, document: Any, **headers: str) -> None:
                self.send_bytes(status, json.dumps(document).encode(), "application/json", **headers)

            def stream(self, events: Iterator[Document]) -> None:
                lines = (
                    (f"event: {each['type']}\n" if "type" in each else "") + f"data: {json.dumps(each)}\n\n"
                    for each in events
                )
                end = "data: [DONE]\n\n" if path.endswith("/completions") else ""
                self.send_bytes(200, ("".join(lines) + end).encode(), "text/event-stream")

            def send_bytes(self, status: int, data: bytes, kind: str, **headers: str) -> None:
                self.send_response(status)
                named = {name.replace("_", "-"): value for name, value in headers.items()}
                for name, value in {"content-type": kind, "content-length": str(len(data)), **named}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(data)

        super().__init__(Handler)
        self.base_url += "" if api in ("messages", "gemini") else "/v1"

    def answer(self, handler: Any, request: Document, said: Said, streamed: bool) -> None:
        """Sends the next answer of the script, which counts as said."""
        message, model = self.took(said), str(request.get("model", "m-1"))
        if streamed:
            handler.stream(self.events(message, said, model))
        else:
            handler.send(200, self.document(message, said, model))

    def took(self, said: Said, *, ids: bool = True) -> Document:
        """The message of the next answer, which the requests after it have to bring back. `ids`: those of calls too."""
        message: Document = self.message(said, len(self._sent))
        for call in () if ids else message.get("tool_calls", ()):
            del call["id"]
        self._sent.append(message.get("output", [message]))
        self.n_answered += 1
        return message

    def _changed(self, request: Document) -> tuple[int, Any] | None:
        """Drops the answers that the request does not know. The error if it has others."""
        got = self.repeated(request)
        for n in range(len(self._sent), -1, -1):
            sent = [message for answer in self._sent[:n] for message in answer]
            if _holds(got, sent):
                del self._sent[n:]
                return None
        why = f"the model's messages came back changed: {json.dumps(got)} and not {json.dumps(self._sent)}"
        return 400, {"error": {"message": why, "code": 400, "status": "INVALID_ARGUMENT"}}
