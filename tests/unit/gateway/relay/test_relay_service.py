"""The relay between an HTTP client and a model API on loopback.

Attacks, each with its defence:
- a provider that answers with web pages, half answers, wrong counts, or a compressed bomb: read within
  bounds; counts that cannot be are estimated and marked.
"""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path
from typing import Any

import httpx
import pytest
from stages import odd_answers
from stages.model_api import CACHED, CREATED, INPUT, OUTPUT, REASONING, Step
from stages.relay_stage import GEMINI, KEY, NOON, PATHS, TOKEN, asked, relay

from evopolicy_gateway.relay import service
from evopolicy_gateway.relay.__main__ import tell
from evopolicy_gateway.relay.apis import Protocol
from evopolicy_gateway.relay.limits import Limits, LoggedRequest, Used, read_ledger
from evopolicy_gateway.relay.provider import Provider, Sent
from evopolicy_gateway.relay.usage import Prices, Usage


@pytest.mark.parametrize(("path", "protocol"), PATHS.items())
def test_an_answer_passes_and_is_counted_with_the_real_key(
    tmp_path: Path, path: str, protocol: Protocol
) -> None:
    (answer,), served = asked(tmp_path, [Step(text="hello")], {}, path=path)
    assert answer.status_code == 200
    assert "hello" in answer.text
    used = served.used.usage
    assert (used.input_noncached, used.cache_read, used.output) == (INPUT - CACHED, CACHED, OUTPUT)
    assert used.cache_creation == (CREATED if path == "messages" else 0)
    assert used.reasoning == (REASONING if path == "responses" or protocol == "google" else None)
    assert served.api.keys == {f"Bearer {KEY}" if protocol == "openai" else KEY}
    assert KEY not in served.ledger.read_text()


async def test_a_request_is_in_the_ledger_before_its_answer_ends(tmp_path: Path) -> None:
    async with relay(tmp_path, [Step(text="hello")]) as served:
        body = {"model": "m", "stream": True, "messages": []}
        async with served.client.stream("POST", "/v1/chat/completions", json=body) as answer:
            async for line in answer.aiter_lines():
                if line == "data: [DONE]":
                    assert served.used.usage.output == OUTPUT
                    return
        raise AssertionError("the stream had no end")


async def test_only_the_agents_token_is_accepted(tmp_path: Path) -> None:
    async with relay(tmp_path, []) as served:
        for name, value in (("x-api-key", TOKEN), ("api-key", TOKEN), ("x-goog-api-key", TOKEN)):
            served.client.headers = httpx.Headers({name: value})
            assert (await served.ask()).status_code == 200
        for wrong in ("", "Bearer", f"Bearer {KEY}", "Bearer é", TOKEN):
            served.client.headers = httpx.Headers({"authorization": wrong.encode()})
            assert (await served.ask()).status_code == 401
    assert served.api.n_asked == 3


def test_a_key_that_the_provider_repeats_does_not_reach_the_agent(tmp_path: Path) -> None:
    """Attack: searches every file and process of its jail for the key. Defence: the key is in the relay
    alone; an answer that repeats it is changed."""
    upstream = {"headers": {"x-team": "other-secret"}}
    (answer,), served = asked(tmp_path, [Step(odd=odd_answers.repeats_its_headers)], {}, upstream=upstream)
    assert answer.status_code == 400
    assert "bad request" in answer.text
    assert KEY not in answer.text
    assert "other-secret" not in answer.text
    assert served.used.failed == 1


def test_azure_gets_its_header_and_version(tmp_path: Path) -> None:
    def shows(handler: Any, _: dict[str, Any]) -> None:
        names = {**dict.fromkeys(handler.headers, ""), "path": handler.path}
        handler._send(400, json.dumps(names).encode(), "application/json")
        assert handler.path.endswith("?api-version=7")
        assert handler.headers["api-key"] == KEY

    script = [Step(text="hello"), Step(odd=shows)]
    upstream = {"key_header": "api-key", "query": {"api-version": "7"}}
    answers, served = asked(tmp_path, script, {}, {}, upstream=upstream)
    assert ["hello" in answers[0].text, "api-key" in answers[1].text] == [True, True]
    assert served.api.keys == set()


async def test_requests_beyond_a_limit_are_refused_in_the_providers_form(tmp_path: Path) -> None:
    """Attack: makes requests beyond its budget, many at once. Defence: requests in flight count."""
    async with relay(tmp_path, [], limits=Limits(max_requests=3)) as served:
        answers = await asyncio.gather(*(served.ask() for _ in range(8)))
        assert sorted(each.status_code for each in answers)[:3] == [200, 200, 200]
        final = await served.ask()
        assert (final.status_code, final.headers["x-should-retry"]) == (400, "false")
        assert final.json()["error"]["code"] == "billing_hard_limit_reached"
        assert "model budget is spent: 3 requests" in final.text
    assert served.api.n_asked == served.used.requests == 3
    assert served.spent[-1] == "3 requests"


@pytest.mark.parametrize(
    ("limits", "what"),
    [(Limits(max_tokens=INPUT), "1,000 tokens"), (Limits(max_cost=0.001), "0.00 dollars")],
)
def test_tokens_and_cost_are_limited_too(tmp_path: Path, limits: Limits, what: str) -> None:
    prices = Prices(input=1.0, output=50.0)
    (first, final), served = asked(tmp_path, [], {}, {}, path="messages", limits=limits, prices=prices)
    assert (first.status_code, final.status_code, final.json()["type"]) == (200, 400, "error")
    assert served.spent == [what]


def test_other_models_are_told_or_refused(tmp_path: Path) -> None:
    (answer,), served = asked(tmp_path, [], {"model": "other"}, model="m")
    assert answer.status_code == 200
    assert served.notes == ["the agent asks for the model 'other' besides m"]
    assert read_ledger(served.ledger, "m").other_models == {"other": 1}
    (tmp_path / "strict").mkdir()
    (answer,), served = asked(tmp_path / "strict", [], {"model": "other"}, model="m", declared_only=True)
    assert answer.status_code == 404
    assert served.api.n_asked == served.used.requests == 0


FUNCTION = {"type": "function", "name": "f"}


@pytest.mark.parametrize(
    ("api", "more", "kinds"),
    [
        ("responses", {"tools": [{"type": "web_search"}, FUNCTION]}, {"web_search": 1}),
        ("chat/completions", {"web_search_options": {"a": None}}, {"web_search_options": 1}),
        ("responses", {"tools": [{"type": "custom"}, {"type": "local_shell"}]}, {}),
        (GEMINI, {"tools": [{"functionDeclarations": [], "googleSearch": {}}]}, {"googleSearch": 1}),
        (
            "messages",
            {"tools": [{"type": "web_fetch_20250910"}], "mcp_servers": [{}]},
            {"mcp_servers": 1, "web_fetch": 1},
        ),
        ("messages", {"tools": [{"name": "f"}, {"type": "bash_20250124"}]}, {}),
    ],
)
def test_tools_that_the_provider_runs_are_recorded_or_refused(
    tmp_path: Path, api: str, more: dict[str, Any], kinds: dict[str, int]
) -> None:
    (answer,), served = asked(tmp_path, [], more, path=api)
    assert answer.status_code == 200
    assert read_ledger(served.ledger).hosted_tools == kinds
    assert len(served.notes) == bool(kinds)
    (tmp_path / "strict").mkdir()
    (answer,), served = asked(tmp_path / "strict", [], more, path=api, own_tools_only=True)
    assert answer.status_code == (400 if kinds else 200)
    assert served.api.n_asked == served.used.requests == (0 if kinds else 1)


def test_a_web_page_is_an_error_that_names_the_base_url(tmp_path: Path) -> None:
    (answer,), served = asked(tmp_path, [Step(odd=odd_answers.page)], {})
    assert (answer.status_code, answer.headers["x-should-retry"]) == (400, "false")
    message = answer.json()["error"]["message"]
    assert f"base_url {served.api.base_url}/v1 answered 200 with text/html" in message
    assert "Sign in" in message
    assert served.used.failed == 1


@pytest.mark.parametrize(
    ("status", "retry_after", "wait", "final"),
    [
        (429, "7", "7", False),
        (429, "3600", "3600", True),
        (429, None, "1", False),
        (500, None, "1", False),
        (500, "soon", "1", False),
        (503, "Fri, 16 Jan 2026 12:00:20 GMT", "20", False),
    ],
)
async def test_the_operator_is_told_of_the_first_failure_with_the_next_try(
    tmp_path: Path, status: int, retry_after: str | None, wait: str, final: bool
) -> None:
    odd = odd_answers.busy(status, **({} if retry_after is None else {"retry_after": retry_after}))
    async with relay(tmp_path, [Step(odd=odd), Step(odd=odd), Step(text="ok"), Step(odd=odd)]) as served:
        answer = await served.ask()
        assert (answer.headers["retry-after"], "x-should-retry" in answer.headers) == (wait, final)
        await served.ask()
        assert len(served.notes) == 1
        at = time.strftime("%H:%M:%S UTC", time.gmtime(NOON + int(wait)))
        assert served.notes[0].endswith(f"answered {status}; next try in {wait} s, at {at}")
        await served.ask()
        await served.ask()
    assert len(served.notes) == 2
    assert (served.used.requests, served.used.failed) == (4, 3)
    assert served.used.wait_s >= 3 * int(wait)


def test_a_provider_that_cannot_be_reached_is_named(tmp_path: Path) -> None:
    (answer,), served = asked(tmp_path, [Step(odd=odd_answers.hang(1.0))], {}, timeout_s=0.3)
    assert answer.status_code == 502
    assert f"base_url {served.api.base_url}/v1 gives no answer" in answer.text
    assert served.used.failed == 1


async def test_half_a_stream_is_no_whole_answer(tmp_path: Path) -> None:
    half = odd_answers.stream(odd_answers.says("x" * 400, end=False), whole=False)
    async with relay(tmp_path, [Step(odd=half)]) as served:
        with pytest.raises(httpx.RemoteProtocolError):
            await served.ask()
    used = served.used
    assert (used.failed, used.estimated, used.usage.output) == (1, 1, 100)


@pytest.mark.parametrize("wanted", [None, {"include_usage": False}, {"include_usage": True}])
def test_a_stream_is_asked_for_its_counts_which_only_who_asks_sees(tmp_path: Path, wanted: Any) -> None:
    options = {} if wanted is None else {"stream_options": wanted}
    (answer,), served = asked(tmp_path, [Step(text="hello")], options)
    assert ('"usage"' in answer.text) is (wanted == {"include_usage": True})
    assert answer.text.endswith("data: [DONE]\n\n")
    assert served.api.requests[0]["stream_options"]["include_usage"] is True
    assert (served.used.usage.output, served.used.estimated) == (OUTPUT, 0)


WRONG = [
    {"prompt_tokens": -5, "completion_tokens": "many"},
    {"prompt_tokens": 1e30, "completion_tokens": 10**30},
]


@pytest.mark.parametrize("usage", [None, *WRONG])
def test_missing_and_wrong_counts_are_estimated_and_marked(tmp_path: Path, usage: Any) -> None:
    documents = [odd_answers.says("x" * 400)] + ([] if usage is None else [{"choices": [], "usage": usage}])
    (answer,), served = asked(tmp_path, [Step(odd=odd_answers.stream(*documents))], {})
    assert "x" * 400 in answer.text
    used = served.used
    assert (used.estimated, used.failed, used.usage.output) == (1, 0, 100)


async def test_a_compressed_bomb_is_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "MAX_ANSWER_BYTES", 8 << 20)
    monkeypatch.setattr(odd_answers, "BOMB_BYTES", 64 << 20)
    async with relay(tmp_path, [Step(odd=odd_answers.bomb)]) as served:
        with pytest.raises(httpx.RemoteProtocolError):
            await served.ask()
    assert served.used.failed == 1


@pytest.mark.parametrize(
    ("path", "body", "headers", "status"),
    [
        ("/v1/chat/completions", b"{}", {"content-encoding": "gzip"}, 415),
        ("/v1/chat/completions", b" " * 2000, {}, 413),
        ("/v1/chat/completions", b"[1]", {}, 400),
        ("/v1/chat/completions", b"{", {}, 400),
        ("/v1/responses", b'{"model": "m", "background": true}', {}, 400),
        ("/v1/files", b"{}", {}, 404),
        ("/v1/messages", b"{}", {}, 404),
        ("/v1/../v1/fine_tuning/jobs", b"{}", {}, 404),
        ("/v1/responses/../files", b"{}", {}, 404),
    ],
)
async def test_hostile_requests_do_not_reach_the_provider(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str, body: bytes, headers: Any, status: int
) -> None:
    monkeypatch.setattr(service, "MAX_REQUEST_BYTES", 1000)
    async with relay(tmp_path, []) as served:
        answer = await served.client.post(path, content=body, headers=headers)
        assert answer.status_code == status
        assert "error" in answer.json()
    assert served.api.n_asked == 0


@pytest.mark.parametrize(
    "framing",
    [
        "content-length: 4\r\ntransfer-encoding: chunked\r\n\r\n0\r\n\r\n",
        "content-length: 2\r\ncontent-length: 3\r\n\r\n{}x",
        "transfer-encoding: xchunked\r\n\r\n0\r\n\r\n",
        "transfer-encoding:\tchunked, identity\r\n\r\n0\r\n\r\n",
    ],
)
async def test_a_request_of_two_lengths_is_not_read_in_two_ways(tmp_path: Path, framing: str) -> None:
    inner = f"POST /v1/responses HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {TOKEN}\r\ncontent-length: 2\r\n\r\n{{}}"
    head = f"POST /v1/chat/completions HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {TOKEN}\r\n"
    async with relay(tmp_path, []) as served:
        reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
        writer.write((head + framing + inner).encode())
        answer = await asyncio.wait_for(reader.read(), 30.0)
        writer.close()
        assert answer.count(b"HTTP/1.1") == 1
        assert answer.startswith(b"HTTP/1.1 4")
    assert served.api.n_asked == 0


async def test_only_chosen_headers_reach_the_provider(tmp_path: Path) -> None:
    seen: dict[str, str] = {}

    def shows(handler: Any, _: dict[str, Any]) -> None:
        seen.update({name.lower(): value for name, value in handler.headers.items()})
        handler._send(200, b"{}", "application/json")

    async with relay(tmp_path, [Step(odd=shows)]) as served:
        served.client.headers.update({"openai-organization": "other", "openai-beta": "b"})
        served.client.headers.update({"x-forwarded-for": "1.2.3.4"})
        await served.ask(stream=False)
    assert (seen["authorization"], seen["openai-beta"]) == (f"Bearer {KEY}", "b")
    assert not {"openai-organization", "x-forwarded-for"} & set(seen)


async def test_an_agent_that_goes_away_leaves_no_request_behind(tmp_path: Path) -> None:
    async with relay(tmp_path, [Step(odd=odd_answers.hang(2.0))], limits=Limits(max_requests=2)) as served:
        with pytest.raises(httpx.ReadTimeout):
            await served.client.post("/v1/chat/completions", json={"model": "m", "tools": [{}]}, timeout=0.3)
        while served.used.requests == 0:
            await asyncio.sleep(0.02)
        assert (await served.ask()).status_code == 200
    assert (served.used.requests, served.used.failed) == (2, 1)


def test_a_ledger_with_half_a_line_goes_on(tmp_path: Path) -> None:
    asked(tmp_path, [], {})
    whole = (tmp_path / "ledger.jsonl").read_bytes()
    (tmp_path / "ledger.jsonl").write_bytes(whole + whole[:30])
    assert asked(tmp_path, [], {})[1].used.requests == 2


def test_a_line_a_minute_has_requests_tokens_and_cost() -> None:
    used = Used()
    said: list[str] = []
    slept: list[float] = []
    requests = iter([2, 0, 1])

    async def sleep(seconds: float) -> None:
        slept.append(seconds)
        for _ in range(next(requests)):
            usage = Usage(input_noncached=1000, output=100)
            used.count_request(LoggedRequest(at=NOON, api="responses", asked="m", status=200, usage=usage))

    with pytest.raises(RuntimeError, match="StopIteration"):
        asyncio.run(tell(used, Prices(input=1000.0, output=10000.0), said.append, sleep))
    # A minute without requests has no line.
    assert said == [
        "2 requests, 2,200 tokens, 4.00 dollars so far",
        "3 requests, 3,300 tokens, 6.00 dollars so far",
    ]
    assert slept == [60.0] * 4


def head_of(monkeypatch: pytest.MonkeyPatch, base: str, proxy: str, no_proxy: str = "") -> list[bytes]:
    """The head of a request to `base`, as the server on loopback gets it that stands at `{}` in both
    addresses."""
    heads: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        heads.append(await reader.readuntil(b"\r\n\r\n"))
        writer.write(b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\nX-Odd: \xe9\r\n\r\nok")
        writer.close()

    async def main() -> None:
        server = await asyncio.start_server(serve, "0.0.0.0", 0)
        port = server.sockets[0].getsockname()[1]
        for name, value in {"http_proxy": proxy.format(port), "no_proxy": no_proxy}.items():
            monkeypatch.setenv(name, value)
            monkeypatch.delenv(name.upper(), raising=False)
        url = base.format(port)
        provider = Provider(url, 10.0)
        sent = Sent("responses", "POST", f"{url}/responses", {"x-team": "é"}, b"{}")
        async with provider.sent(sent) as answer:
            assert (answer.status, answer.headers["x-odd"]) == (200, "é")
            assert b"".join([piece async for piece in answer.pieces]) == b"ok"
        await provider.close()
        server.close()

    asyncio.run(main())
    return heads[0].split(b"\r\n")


def test_a_login_in_the_address_becomes_a_header(monkeypatch: pytest.MonkeyPatch) -> None:
    head = head_of(monkeypatch, "http://me:p%40ss@localhost:{}/v1", "http://127.0.0.1:1")
    assert head[0] == b"POST /v1/responses HTTP/1.1"
    lines = {line.lower() for line in head}
    assert {b"authorization: basic bwu6cebzcw==", b"x-team: \xe9", b"content-length: 2"} <= lines
    assert {b"accept-encoding: identity", b"user-agent: evopolicy"} <= lines


def test_the_operators_proxy_leads_elsewhere_but_not_here(monkeypatch: pytest.MonkeyPatch) -> None:
    head = head_of(monkeypatch, "http://model.invalid/v1", "http://me:pw@127.0.0.1:{}")
    assert head[0] == b"POST http://model.invalid/v1/responses HTTP/1.1"
    assert b"proxy-authorization: basic bwu6chc=" in {line.lower() for line in head}
    # Loopback, and hosts of `no_proxy`, are reached without it: port 1 answers nothing.
    head_of(monkeypatch, "http://127.0.0.1:{}/v1", "http://127.0.0.1:1")
    head_of(monkeypatch, "http://127.0.0.2:{}/v1", "http://127.0.0.1:1", "127.0.0.2")
