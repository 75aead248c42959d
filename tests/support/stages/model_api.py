"""A model API on loopback that plays a script: enough of OpenAI's Responses and Chat Completions, Anthropic's Messages
and Google's generateContent for the real CLIs.

Each request with tools is answered by the next step of the script: a shell command to run, or a text that ends the
turn. Requests beside the conversation (titles, token counts, suggestions, an agent's notes) get a short text and move
nothing. Codex and Qwen Code list the tools of MCP servers only when their model searches for them: the script's model
then searches first, which moves nothing either.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

from stages.declared_inputs import as_toml
from stages.loopback import Loopback
from stages.provider_api import CACHED, FRESH, OUTPUT, chat_usage, gemini_usage, responses_usage
from stages.provider_api import REASONING as REASONING

INPUT, CREATED = FRESH + CACHED, 50
"""Tokens that every answer claims. OpenAI counts the cached ones into its input, Anthropic apart."""


SUBMIT = (
    "echo '# better' >> system/policy.py; curl -s --noproxy '*' -X POST"
    " -d '{\"env_instances\": [0, 1]}' $EVOPOLICYGYM_SUBMIT_URL"
)
"""A command that changes the policy and submits it for two episodes."""
BESIDE = ("[SUGGESTION MODE", "Managed memory has")
"""What the last message of a request with tools says that Claude Code or Qwen Code makes beside the conversation, after
a turn."""


class Step:
    """`command`: run it in the agent's shell. `tool`: call the offered tool whose name ends so, with the arguments that
    `given` makes from the request's JSON. `also`: further calls in the same answer, of Codex or Claude Code. `text`:
    say it and end the turn. `status`: an HTTP error instead. `unknown`: call a tool of this name, which the agent does
    not offer. `odd`: answer in a way of its own (`odd_answers.py`)."""

    def __init__(
        self,
        command: str | None = None,
        text: str = "",
        status: int = 200,
        tool: str | None = None,
        unknown: str = "",
        odd: Callable[[Any, dict[str, Any]], None] | None = None,
        given: Callable[[str], dict[str, Any]] = lambda request: {},
        also: Sequence[Step] = (),
    ) -> None:
        self.given = given
        self.also = also
        self.unknown = unknown
        self.odd = odd
        self.command = command
        self.tool = tool
        self.text = text
        self.status = status

    @property
    def calls(self) -> bool:
        return self.command is not None or self.tool is not None or bool(self.unknown)

    def call(self, offered: list[str], request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        """The tool that it calls, of those that an agent offers, and the arguments."""
        if self.unknown:
            return self.unknown, {"path": "policy.py"}
        if self.tool is not None:
            name = next(name for name in offered if name.endswith(self.tool))
            return name, self.given(json.dumps(request))
        return _offered(offered), _shell_arguments(self.command or "")


class ModelApi(Loopback):
    """Serves while the `with` lasts. `base_url` is without `/v1`."""

    def __init__(self, script: Sequence[Step]) -> None:
        self.script = list(script)
        self.played = 0
        self.requests: list[dict[str, Any]] = []
        """Bodies of the requests that moved the script on."""
        self.n_asked = self.n_answered = 0
        """Requests that cost tokens, and those of them that were answered as `INPUT` and the others say; beside the
        conversation too."""
        self.bodies: list[bytes] = []
        """Of all requests, as they came."""
        self.keys: set[str] = set()
        """The keys that came with them."""
        self._lock = threading.Lock()
        api = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def log_message(self, format: str, *args: Any) -> None:
                pass

            def do_HEAD(self) -> None:
                self._send(200, b"", "text/plain")

            def do_GET(self) -> None:
                self._send(200, b'{"data": [], "object": "list", "models": []}', "application/json")

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers.get("content-length") or 0))
                api.bodies.append(body)
                api.answer(self, json.loads(body or b"{}"))

            def _send(self, status: int, data: bytes, kind: str) -> None:
                self.send_response(status)
                self.send_header("content-type", kind)
                self.send_header("content-length", str(len(data)))
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(data)

        super().__init__(Handler)

    def answer(self, handler: Any, request: dict[str, Any]) -> None:
        path = handler.path.partition("?")[0]
        if path.endswith(("/count_tokens", ":countTokens")):
            handler._send(200, b'{"input_tokens": 10, "totalTokens": 10}', "application/json")
            return
        search = self._search(path, request)
        with self._lock:
            self.n_asked += 1
            names = ("authorization", "x-api-key", "x-goog-api-key")
            self.keys |= {handler.headers.get(name, "") for name in names} - {""}
        step = Step() if search else self._next(request)
        if step.odd is not None:
            step.odd(handler, request)
            return
        if step.status != 200:
            error = {"type": "error", "error": {"type": "overloaded_error", "message": step.text or "busy"}}
            handler._send(step.status, json.dumps(error).encode(), "application/json")
            return
        with self._lock:
            self.n_answered += 1
        events = search or _speech(path)(step, request)
        if path.endswith(":generateContent"):
            handler._send(200, json.dumps(next(iter(events))).encode(), "application/json")
            return
        stream = "".join(
            (f"event: {event['type']}\n" if "type" in event else "") + f"data: {json.dumps(event)}\n\n"
            for event in events
        )
        done = "data: [DONE]\n\n" if path.endswith("/completions") else ""
        handler._send(200, (stream + done).encode(), "text/event-stream")

    def _search(self, path: str, request: dict[str, Any]) -> list[dict[str, Any]]:
        """A search for the tool of the next step where the agent offers that and does not list the tool yet."""
        step = self.script[self.played] if self.played < len(self.script) else Step()
        if step.tool is None:
            return []
        if path.endswith("/completions"):
            names = [tool["function"]["name"] for tool in request.get("tools", ())]
            if "tool_search" not in names or _qwen_tool(step.tool, request):
                return []
            return list(_chat_call("tool_search", {"query": step.tool}, request, f"search_{id(step)}"))
        offers = any(tool.get("type") == "tool_search" for tool in request.get("tools", ()))
        if not path.endswith("/responses") or not offers or _codex_tool(step.tool, request):
            return []
        item = {"type": "tool_search_call", "call_id": f"search_{id(step)}", "status": "completed"}
        item |= {"execution": "client", "arguments": {"query": step.tool, "limit": 8}}  # type: ignore[dict-item]
        return list(_responses_with(f"resp_search_{id(step)}", item))

    def _next(self, request: dict[str, Any]) -> Step:
        with self._lock:
            last = json.dumps((request.get("messages") or [""])[-1])
            if not request.get("tools") or any(words in last for words in BESIDE):
                return Step(text="ok")
            self.requests.append(request)
            self.played += 1
            at = self.played - 1
        return self.script[at] if at < len(self.script) else Step(text="Nothing more to do.")


def llm_agent(folder: Path, base_url: str, api: str = "chat", key: str = "MODEL_ACCESS", **more: Any) -> str:
    """`--agent` for the built-in agent with a model API at `base_url`, and further settings."""
    base = f"{base_url}/v1" if api in ("chat", "responses") else base_url
    usual = {"harness": "llm", "model": "m-1", "backoff_s": 0.01, "pause_s": 0.1, "max_pause_s": 0.2}
    lines = [f"{name} = {as_toml(value)}" for name, value in {**usual, **more}.items()]
    table = f'[api]\napi = "{api}"\nbase_url = "{base}"\nkey = "{key}"\n'
    (folder / "agent.toml").write_text("\n".join([*lines, table]))
    return f"file:{folder / 'agent.toml'}"


def _speech(path: str) -> Any:
    """The protocol that is spoken below a path."""
    for ending, speech in (("/responses", _responses), ("/completions", _chat), ("ontent", _contents)):
        if path.endswith(ending):
            return speech
    return _messages


def _chat(step: Step, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
    if not step.calls:
        delta = {"role": "assistant", "content": step.text}
        yield from _chat_with(delta, "stop", request, f"chat_{id(step)}")
        return
    found = _qwen_tool(step.tool, request) if step.tool else None
    names = [tool["function"]["name"] for tool in request["tools"]]
    if found is not None and found not in names and "tool_call" in names:
        name, arguments = "tool_call", {"name": found, "arguments": {}}
    else:
        name, arguments = step.call(names, request)
    yield from _chat_call(name, arguments, request, f"call_{id(step)}")


def _chat_call(
    name: str, arguments: dict[str, Any], request: dict[str, Any], identity: str
) -> Iterator[dict[str, Any]]:
    function = {"name": name, "arguments": json.dumps(arguments)}
    # A tool may be searched for again and again: each call has an id of its own.
    identity = f"{identity}_{len(request['messages'])}"
    call = {"index": 0, "id": identity, "type": "function", "function": function}
    delta = {"role": "assistant", "content": None, "tool_calls": [call]}
    yield from _chat_with(delta, "tool_calls", request, identity)


def _chat_with(
    delta: dict[str, Any], reason: str, request: dict[str, Any], identity: str
) -> Iterator[dict[str, Any]]:
    whole = {"id": identity, "object": "chat.completion.chunk", "model": request["model"]}
    yield whole | {"choices": [{"index": 0, "delta": delta, "finish_reason": None}]}
    yield whole | {"choices": [{"index": 0, "delta": {}, "finish_reason": reason}]}
    yield whole | {"choices": [], "usage": chat_usage()}


def _qwen_tool(name: str, request: dict[str, Any]) -> str | None:
    """The whole name of a tool by its end, listed or found by a search."""
    names = [tool["function"]["name"] for tool in request.get("tools", ())]
    texts = [json.dumps(one.get("content")) for one in request["messages"] if one.get("role") == "tool"]
    names += [found for text in texts for found in re.findall(r'\\"name\\": ?\\"([\w-]+)', text)]
    return next((each for each in names if each.endswith(name)), None)


def _contents(step: Step, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
    part: dict[str, Any] = {"text": step.text}
    if step.calls:
        declared = [one["name"] for tool in request["tools"] for one in tool.get("functionDeclarations", ())]
        name, arguments = step.call(declared, request)
        part = {"functionCall": {"name": name, "args": arguments}}
    candidate = {"content": {"role": "model", "parts": [part]}, "finishReason": "STOP", "index": 0}
    yield {"candidates": [candidate], "usageMetadata": gemini_usage()}


def _offered(names: list[str]) -> str:
    """The shell among the tools that an agent offers."""
    return next(name for name in names if name in ("run_shell_command", "bash", "Bash"))


def _shell_arguments(command: str) -> dict[str, Any]:
    return {"command": command, "description": "edits and submits", "is_background": False}


def _responses(step: Step, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
    content = [{"type": "output_text", "text": step.text, "annotations": []}]
    items: list[dict[str, Any]] = [{"type": "message", "id": "m1", "role": "assistant", "content": content}]
    if step.calls:
        items = [
            {"type": "function_call", "id": "f1", "call_id": f"call_{id(each)}"} | _codex_call(each, request)
            for each in (step, *step.also)
        ]
    yield from _responses_with(f"resp_{id(step)}", *items)


def _responses_with(identity: str, *items: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield {"type": "response.created", "response": {"id": identity}}
    for n, item in enumerate(items):
        yield {"type": "response.output_item.done", "output_index": n, "item": item}
    response = {"id": identity, "output": list(items), "usage": responses_usage()}
    yield {"type": "response.completed", "response": response}


def _codex_call(step: Step, request: dict[str, Any]) -> dict[str, Any]:
    """Name and arguments of the call."""
    if step.unknown:
        return {"name": step.unknown, "arguments": "{}"}
    if step.tool is None:
        name, arguments = _shell_call(step.command or "", request)
        return {"name": name, "arguments": json.dumps(arguments)}
    found = _codex_tool(step.tool, request)
    if found is None:
        raise AssertionError(f"no {step.tool} among the offered tools: {request['tools']}")
    return {**found, "arguments": json.dumps(step.given(json.dumps(request)))}


def _codex_tool(name: str, request: dict[str, Any]) -> dict[str, str] | None:
    """A tool by the end of its name, listed or found by a search; one of an MCP server is in the server's namespace."""
    found = [
        tool for one in request["input"] if one.get("type") == "tool_search_output" for tool in one["tools"]
    ]
    for tool in [*request["tools"], *found]:
        inner = [one["name"] for one in tool.get("tools", ()) if one["name"].endswith(name)]
        if inner:
            return {"namespace": tool["name"], "name": inner[0]}
        if str(tool.get("name")).endswith(name):
            return {"name": tool["name"]}
    return None


def _shell_call(command: str, request: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The call of whichever shell tool this version of the CLI offers."""
    offered = {tool.get("name"): tool for tool in request["tools"] if tool.get("type") == "function"}
    for name, argument in (("exec_command", "cmd"), ("shell_command", "command"), ("bash", "command")):
        if name in offered:
            return name, {argument: command}
    if "shell" in offered:
        return "shell", {"command": ["bash", "-c", command]}
    raise AssertionError(f"no shell among the offered tools: {sorted(map(str, offered))}")


def _messages(step: Step, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
    usage = {"input_tokens": FRESH, "cache_read_input_tokens": CACHED, "output_tokens": 1}
    usage |= {"cache_creation_input_tokens": CREATED}
    message = {"id": f"msg_{id(step)}", "type": "message", "role": "assistant", "model": request["model"]}
    message |= {"content": [], "stop_reason": None, "stop_sequence": None, "usage": usage}
    yield {"type": "message_start", "message": message}
    for n, each in enumerate((step, *step.also)):
        if not each.calls:
            block: dict[str, Any] = {"type": "text", "text": ""}
            delta = {"type": "text_delta", "text": each.text}
        else:
            name, arguments = each.call([tool["name"] for tool in request["tools"]], request)
            if each.tool is None:
                # Claude Code's shell refuses arguments that it does not know.
                arguments = {key: value for key, value in arguments.items() if key == "command"}
            block = {"type": "tool_use", "id": f"toolu_{id(each)}", "name": name, "input": {}}
            delta = {"type": "input_json_delta", "partial_json": json.dumps(arguments)}
        yield {"type": "content_block_start", "index": n, "content_block": block}
        yield {"type": "content_block_delta", "index": n, "delta": delta}
        yield {"type": "content_block_stop", "index": n}
    stop = {"stop_reason": "tool_use" if step.calls else "end_turn", "stop_sequence": None}
    yield {"type": "message_delta", "delta": stop, "usage": {"output_tokens": OUTPUT}}
    yield {"type": "message_stop"}
