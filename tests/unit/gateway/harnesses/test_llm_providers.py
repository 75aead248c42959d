"""The built-in agent's conversation with each provider, on servers that follow the documented rules or break them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from stages.provider_api import (
    CACHED,
    FRESH,
    OUTPUT,
    Document,
    ProviderApi,
    Said,
    Sends,
    chat_chunk,
    chat_usage,
    conversation_settings,
)

from evopolicy_gateway.agents.llm.agent import EventWriter, Session, play_turn
from evopolicy_gateway.agents.llm.conversation import ApiError, Conversation, ModelReply
from evopolicy_gateway.harnesses.interface.agent_config import PROVIDERS, ApiName, ProviderName

pytestmark = pytest.mark.slow

apis = pytest.mark.parametrize("api", ["chat", "responses", "messages", "gemini"])
SCRIPT = [
    Said(text="I look.", commands=("ls", "pwd"), reasoning="two\n\nthings "),
    Said(commands=("cat x",), reasoning="and this"),
    Said(text=" <think>no reasoning</think> Half done."),
    Said(text="Done.", reasoning="enough"),
]
SPENT = {
    "input_tokens": FRESH,
    "cache_read_input_tokens": CACHED,
    "cache_creation_input_tokens": 0,
    "output_tokens": OUTPUT,
}


async def conversed(server: ProviderApi, api: str, n: int, **more: Any) -> list[ModelReply]:
    """The replies of a conversation that is begun anew from what was kept before each request."""
    settings = conversation_settings(server.base_url, api, **more)
    replies, kept, outputs = [], b"", 0
    for _ in range(n):
        conversation = Conversation(settings, "key", kept)
        if not outputs:
            conversation.say("Go on.")
        reply = await conversation.ask_model()
        outputs = len(reply.calls)
        if outputs:
            conversation.answer(reply.calls, ["an output"] * outputs)
        replies.append(reply)
        kept = conversation.dumped()
    return replies


def fault(message: str, **more: Any) -> Document:
    return {"error": {"message": message} | more}


def said(replies: list[ModelReply]) -> list[tuple[str, tuple[str, ...]]]:
    assert not any(call.fault for reply in replies for call in reply.calls)
    return [(reply.text, tuple(call.command for call in reply.calls)) for reply in replies]


WHOLE = [(one.text, one.commands) for one in SCRIPT]


@apis
async def test_a_providers_messages_come_back_unchanged_after_each_restart(api: ApiName) -> None:
    with ProviderApi(api, SCRIPT) as server:
        replies = await conversed(server, api, 4)
    assert said(replies) == WHOLE
    assert [reply.usage for reply in replies] == [SPENT] * 4
    assert [request["stream"] for request in server.requests] == [True] * 4


@pytest.mark.parametrize("provider", PROVIDERS)
async def test_each_provider_by_its_name(provider: ProviderName) -> None:
    api = PROVIDERS[provider].api
    with ProviderApi("openrouter" if provider == "openrouter" else api, SCRIPT) as server:
        assert said(await conversed(server, api, 4, provider=provider, model="maker/m-1")) == WHOLE


@apis
async def test_a_request_is_the_same_each_time(api: ApiName) -> None:
    requests = []
    for _ in range(2):
        with ProviderApi(api, SCRIPT) as server:
            await conversed(server, api, 4)
        requests.append(server.requests)
    assert requests[0] == requests[1]


@pytest.mark.parametrize("api", ["chat", "responses", "messages"])
async def test_a_server_without_streams_is_asked_for_whole_answers(api: ApiName) -> None:
    with ProviderApi(api, SCRIPT, streams=False) as server:
        assert said(await conversed(server, api, 4)) == WHOLE
    # Only the first stream was tried, also after the restarts.
    assert [bool(request["stream"]) for request in server.requests] == [True, *[False] * 4]


Calls = Callable[[list[Document]], Iterator[Document]]


def in_pieces(index: int | None) -> Calls:
    """Each call in two chunks, all with this index."""

    def chunks(calls: list[Document]) -> Iterator[Document]:
        at = {} if index is None else {"index": index}
        for call in calls:
            name, given = call["function"]["name"], call["function"]["arguments"]
            begun = {**call, "function": {"name": name, "arguments": given[:4]}}
            yield chat_chunk({"tool_calls": [begun | at]})
            yield chat_chunk({"tool_calls": [at | {"function": {"arguments": given[4:]}}]})

    return chunks


def nulls(calls: list[Document]) -> Iterator[Document]:
    yield chat_chunk(None)
    yield {"id": "c", "object": "chat.completion.chunk", "choices": None}
    yield chat_chunk({"tool_calls": [call | {"index": at} for at, call in enumerate(calls)], "content": None})
    yield chat_chunk(None, "tool_calls")


def streaming(chunks: Calls) -> Sends:
    """Streams the calls in chunks of another form; whole answers are as usual."""

    def sends(provider: ProviderApi, handler: Any, request: Document, said: Said) -> bool:
        if not said.commands or not request.get("stream"):
            return False
        message = provider.took(said)
        texts = {name: message[name] for name in ("content", "reasoning_content") if message.get(name)}
        usage = {"id": "c", "object": "chat.completion.chunk", "created": 1, "choices": []}
        usage["usage"] = chat_usage()
        calls = chunks(message["tool_calls"])
        handler.stream(iter([chat_chunk(texts), *calls, chat_chunk({}, "tool_calls"), usage]))
        return True

    return sends


def changing(change: Callable[[Document], Any], *, ids: bool = True) -> Sends:
    """Changes each call of an answer, of a whole one and of a stream."""

    def sends(provider: ProviderApi, handler: Any, request: Document, said: Said) -> bool:
        message = provider.took(said, ids=ids)
        calls = json.loads(json.dumps(message.get("tool_calls", [])))
        for call, known in zip(calls, message.get("tool_calls", []), strict=True):
            change(call)
            if isinstance(given := call["function"]["arguments"], dict):
                known["function"]["arguments"] = json.dumps(given, separators=(",", ":"))
        sent = message | ({"tool_calls": calls} if calls else {})
        if request.get("stream"):
            handler.stream(provider.events(sent, said, "m-1"))
        else:
            handler.send(200, provider.document(sent, said, "m-1"))
        return True

    return sends


@pytest.mark.parametrize(
    ("sends", "n_more"),
    [
        (streaming(in_pieces(0)), 1),
        (streaming(in_pieces(None)), 0),
        (streaming(nulls), 0),
        (changing(lambda call: call["function"].pop("name")), 1),
        (changing(lambda call: call["function"].update(name=None)), 1),
        (changing(lambda call: call.update(id=None), ids=False), 0),
        (changing(lambda call: None, ids=False), 0),
        (
            changing(
                lambda call: call["function"].update(arguments=json.loads(call["function"]["arguments"]))
            ),
            0,
        ),
    ],
    ids=["one index", "no index", "nulls", "no name", "null as name", "null as id", "no id", "object"],
)
async def test_calls_in_another_form_are_understood(sends: Sends, n_more: int) -> None:
    """`n_more`: requests without a stream, after one that could not be used."""
    with ProviderApi("chat", SCRIPT, sends=sends) as server:
        assert said(await conversed(server, "chat", 4)) == WHOLE
    assert len(server.requests) == 4 + n_more


def refusing_stream_options(request: Document) -> tuple[Any, ...] | None:
    """As Mistral and others whose schema is closed."""
    detail = {"type": "extra_forbidden", "loc": ["body", "stream_options"]}
    detail["msg"] = "Extra inputs are not permitted"
    return (422, {"detail": [detail]}) if "stream_options" in request else None


async def test_a_refused_option_of_streams_is_left_out() -> None:
    with ProviderApi("chat", SCRIPT, refuses=refusing_stream_options) as server:
        assert said(await conversed(server, "chat", 4, provider="mistral")) == WHOLE
    assert len(server.requests) == 5


def without_reasoning_in_chat(request: Document) -> tuple[Any, ...] | None:
    """As OpenAI's newest models: tools and reasoning together only in Responses."""
    if "messages" in request and request.get("reasoning_effort") != "none":
        words = "Function tools with reasoning are not supported in /v1/chat/completions. Use /v1/responses."
        return 400, fault(words, type="invalid_request_error", code=None)
    return None


async def test_openais_models_reason_with_tools_over_responses() -> None:
    with ProviderApi("responses", SCRIPT, refuses=without_reasoning_in_chat) as server:
        api = PROVIDERS["openai"].api
        assert said(await conversed(server, api, 4, provider="openai", effort="high")) == WHOLE
    first = server.requests[0]
    assert first["reasoning"]["effort"] == "high"
    # Nothing is kept at the provider: reasoning comes and goes encrypted.
    assert (first["store"], first["include"]) == (False, ["reasoning.encrypted_content"])


@pytest.mark.parametrize(
    ("api", "field", "value"),
    [
        ("chat", "reasoning_effort", "high"),
        ("messages", "output_config", {"effort": "high"}),
        (
            "gemini",
            "generationConfig",
            {"responseModalities": ["TEXT"], "thinkingConfig": {"thinking_level": "HIGH"}},
        ),
    ],
)
async def test_effort_and_further_parameters_are_in_each_request(
    api: ApiName, field: str, value: Any
) -> None:
    with ProviderApi(api, SCRIPT) as server:
        await conversed(server, api, 1, effort="high", parameters={"own": 7})
    assert (server.requests[0][field], server.requests[0]["own"]) == (value, 7)


@pytest.mark.parametrize("streamed", [True, False])
async def test_an_error_in_a_success_is_told_in_the_servers_words(streamed: bool) -> None:
    error = fault("the backend fell over", code=502)

    def sends(provider: ProviderApi, handler: Any, request: Document, said: Said) -> bool:
        if streamed:
            handler.stream(iter([error]))
        else:
            handler.send(200, error)
        return True

    with (
        ProviderApi("chat", SCRIPT, sends=sends) as server,
        pytest.raises(ApiError, match="backend fell over"),
    ):
        await conversed(server, "chat", 1)


async def test_the_words_in_a_list_of_errors_are_told() -> None:
    words = "Function call is missing a thought_signature"
    error = [fault(words, code=400, status="INVALID_ARGUMENT")]
    known = pytest.raises(ApiError, match=f"^{words}$")
    with ProviderApi("chat", SCRIPT, refuses=lambda request: (400, error)) as server, known as raised:
        await conversed(server, "chat", 1)
    assert raised.value.status == 400


NO_KEY = {"@type": "type.googleapis.com/google.rpc.ErrorInfo", "reason": "API_KEY_INVALID"}
ERRORS: list[tuple[ApiName, int, Any, str]] = [
    (
        "chat",
        429,
        fault("You exceeded your current quota.", code="insufficient_quota", type="x"),
        "^quota exceeded: You exceeded your current quota",
    ),
    ("chat", 402, fault("Insufficient Balance"), "^quota exceeded: Insufficient Balance"),
    (
        "messages",
        401,
        {"type": "error"} | fault("invalid x-api-key", type="authentication_error"),
        "^the provider does not accept the key in THE_KEY: invalid x-api-key",
    ),
    (
        "gemini",
        400,
        fault("API key not valid.", code=400, status="INVALID_ARGUMENT", details=[NO_KEY]),
        "^the provider does not accept the key in THE_KEY: API key not valid",
    ),
    (
        "chat",
        404,
        fault("The model does not exist", code="model_not_found"),
        "^there is no model m-1 for this key: The model does not exist; the server lists m-2, other$",
    ),
    (
        "responses",
        400,
        fault("Your input exceeds the context window", code="context_length_exceeded"),
        "longer than the model's context, set context_tokens below it: Your input exceeds",
    ),
    (
        "chat",
        400,
        {"object": "error", "message": '"auto" tool choice requires --enable-auto-tool-choice', "code": 400},
        "takes no tools, which the agent needs: .*--enable-auto-tool-choice",
    ),
    ("chat", 404, fault("No endpoints found that support tool use."), "takes no tools"),
]


@pytest.mark.parametrize(("api", "status", "body", "words"), ERRORS)
async def test_errors_say_what_is_wrong_in_the_users_words(
    api: ApiName, status: int, body: Any, words: str
) -> None:
    with (
        ProviderApi(api, SCRIPT, refuses=lambda request: (status, body), models=["other", "m-2"]) as server,
        pytest.raises(ApiError, match=words) as raised,
    ):
        await conversed(server, api, 1, variable="THE_KEY")
    assert raised.value.too_long is ("context" in words)


@pytest.mark.parametrize(("stated", "wait_s"), [("2", None), ("3600", 3600.0)])
async def test_only_a_long_stated_wait_counts_for_a_spent_quota(stated: str, wait_s: float | None) -> None:
    error = fault("You exceeded your current quota.", code="insufficient_quota")
    headers = {"retry_after": stated, "x_should_retry": "false"}
    with (
        ProviderApi("chat", SCRIPT, refuses=lambda request: (429, error, headers)) as server,
        pytest.raises(ApiError, match="quota exceeded") as raised,
    ):
        await conversed(server, "chat", 1)
    assert raised.value.retry_after_s == wait_s


async def turn(
    tmp_path: Path, script: list[Said], api: str = "chat"
) -> tuple[int, list[Document], ProviderApi]:
    out = io.StringIO()
    with ProviderApi(api, script) as server:
        settings = conversation_settings(server.base_url, api, variable="KEY", context_tokens=10**6)
        session = Session(tmp_path / "s.json")
        status = await play_turn(Conversation(settings, "key"), "Go on.", session, EventWriter(out, "s"))
    return status, [json.loads(line) for line in out.getvalue().splitlines()], server


CUT = {"chat": "length", "responses": "max_output_tokens", "messages": "max_tokens", "gemini": "MAX_TOKENS"}


@apis
async def test_an_answer_that_is_cut_at_its_length_ends_no_turn(tmp_path: Path, api: ApiName) -> None:
    cut = Said(text="I will", finish=CUT[api])
    status, lines, _ = await turn(tmp_path, [cut, cut, Said(text="done")], api)
    assert (status, lines[-1]["result"]) == (0, "done")
    status, lines, server = await turn(tmp_path, [cut] * 4, api)
    assert (status, len(server.requests)) == (1, 3)
    assert "3 faulty answers in a row, the last: the answer was cut at its length" in lines[-1]["result"]


@pytest.mark.parametrize(
    "text",
    [
        '<tool_call>\n{"name": "bash", "arguments": {"command": "ls"}}\n</tool_call>',
        "I look. <|tool_calls_section_begin|>functions.bash:0",
        '[TOOL_CALLS][{"name": "bash"}]',
        "<function=bash><parameter=command>ls</parameter></function>",
        '```json\n{"name": "bash", "arguments": {}}\n```',
    ],
)
async def test_a_call_that_is_written_as_text_is_named_so(tmp_path: Path, text: str) -> None:
    status, lines, server = await turn(tmp_path, [Said(text=text)] * 4)
    assert (status, len(server.requests)) == (1, 3)
    assert "the server's tool parser is off" in lines[-1]["result"]
    assert "tool parser" in server.requests[1]["messages"][-1]["content"]


async def test_a_model_that_repeats_a_command_is_told_and_then_ended(tmp_path: Path) -> None:
    status, lines, server = await turn(tmp_path, [Said(commands=("echo same",))] * 12)
    assert (status, len(server.requests)) == (1, 10)
    outputs = [line["message"]["content"][0]["content"] for line in lines if line["type"] == "user"]
    assert outputs[3] == "[exit status 0]\nsame\n"
    assert outputs[4].endswith("[This was the 5th time in a row with this output. Do something else.]")
    assert lines[-1]["result"] == "10 times in a row the same command with the same output: echo same"
    other = [Said(commands=(f"echo {n % 2}",)) for n in range(12)]
    status, _, server = await turn(tmp_path, [*other, Said(text="done")])
    assert (status, len(server.requests)) == (0, 13)
