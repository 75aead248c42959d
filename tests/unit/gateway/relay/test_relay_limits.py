"""Agents that try to use more than their run's limits of tokens, cost, requests and memory."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import httpx
import msgspec
import pytest
from stages import odd_answers
from stages.model_api import INPUT, OUTPUT, Step
from stages.relay_stage import GEMINI, KEY, TOKEN, asked, relay

from evopolicy_common.wire.http import bound
from evopolicy_gateway.processes.child_messages import StartRelay
from evopolicy_gateway.relay import service
from evopolicy_gateway.relay.apis import Upstream
from evopolicy_gateway.relay.limits import Limits
from evopolicy_gateway.relay.service import RelaySetup
from evopolicy_gateway.relay.usage import Prices

PRICES = Prices(input=1.0, output=50.0, tiers={"priority": 2.0})
MANY = {"prompt_tokens": 1_200_000, "completion_tokens": 1_000_000}


@pytest.mark.parametrize("streams", [True, False])
async def test_an_answer_is_read_to_its_end_when_the_agent_has_gone(tmp_path: Path, streams: bool) -> None:
    """A stream that was cut before its last event counted 300 tokens of 2,200,000."""
    gone = threading.Event()

    def long(handler: Any, request: dict[str, Any]) -> None:
        document = {"choices": [], "usage": MANY}
        if streams:
            odd_answers.stream(odd_answers.says("x", end=False), whole=False)(handler, request)
        gone.wait(20.0)
        if streams:
            handler.wfile.write(b"".join(odd_answers.chunk(each) for each in (document, None)))
        else:
            odd_answers.answers(200, document)(handler, request)

    async with relay(tmp_path, [Step(odd=long)]) as served:
        body = {"model": "m", "stream": streams, "tools": [{}]}
        with contextlib.suppress(httpx.ReadTimeout):
            async with served.client.stream("POST", "/v1/chat/completions", json=body, timeout=1.0) as answer:
                async for _ in answer.aiter_bytes():
                    break
        gone.set()
        while not served.used.requests:
            await asyncio.sleep(0.02)
    used = served.used
    assert (used.usage.total, used.estimated, used.failed) == (2_200_000, 0, 0)


async def test_requests_at_once_do_not_exceed_the_limit_together(tmp_path: Path) -> None:
    """32 requests at once spent 3.2 million tokens with a limit of 1,000."""
    async with relay(tmp_path, [], limits=Limits(max_tokens=INPUT)) as served:
        answers = await asyncio.gather(*(served.ask(max_completion_tokens=INPUT) for _ in range(32)))
        assert sum(each.status_code == 200 for each in answers) == 1
    assert (served.api.n_asked, served.used.usage.total) == (1, INPUT + OUTPUT)


async def test_requests_that_fit_together_are_served_together(tmp_path: Path) -> None:
    async with relay(tmp_path, [], limits=Limits(max_tokens=100_000)) as served:
        answers = await asyncio.gather(*(served.ask(max_completion_tokens=100) for _ in range(8)))
        assert {each.status_code for each in answers} == {200}


@pytest.mark.parametrize(
    ("path", "more"),
    [("chat/completions", {"n": 50}), (GEMINI, {"generationConfig": {"candidateCount": 50}})],
)
def test_many_answers_to_one_request_do_not_exceed_the_limit(
    tmp_path: Path, path: str, more: dict[str, Any]
) -> None:
    (answer,), served = asked(tmp_path, [], more, path=path, limits=Limits(max_tokens=1_000_000))
    assert (answer.status_code, served.api.bodies) == (400, [])
    assert "50 answers may exceed the limit of 1,000,000 tokens" in answer.text


def test_a_request_that_ran_out_of_time_is_charged_its_reserve(tmp_path: Path) -> None:
    script = [Step(odd=odd_answers.hang(1.0))]
    (answer,), served = asked(tmp_path, script, {"max_completion_tokens": 5000}, timeout_s=0.3)
    assert answer.status_code == 502
    assert (served.used.usage.output, served.used.estimated) == (5000, 1)


async def test_an_answer_above_its_reserve_makes_the_next_reserves_larger(tmp_path: Path) -> None:
    """A server that ignores the stated maximum must not let many requests pass at once."""
    usage = {"prompt_tokens": 10, "completion_tokens": 90_000}
    odd = Step(odd=odd_answers.stream({"choices": [], "usage": usage}))
    async with relay(tmp_path, [odd] * 40, limits=Limits(max_tokens=250_000)) as served:
        assert (await served.ask(max_completion_tokens=1)).status_code == 200
        answers = await asyncio.gather(*(served.ask(max_completion_tokens=1) for _ in range(32)))
        assert sum(each.status_code == 200 for each in answers) <= 2


@pytest.mark.parametrize(
    ("path", "tier"),
    [
        ("chat/completions", {"service_tier": "priority"}),
        ("responses", {"service_tier": "priority"}),
        ("messages", {"speed": "fast"}),
        (GEMINI, {"serviceTier": "priority"}),
        ("responses", {"Service_Tier": "flex"}),
    ],
)
def test_a_tier_without_a_price_is_refused_under_a_cost_limit(
    tmp_path: Path, path: str, tier: dict[str, str]
) -> None:
    for n, (prices, status) in enumerate(
        [
            (Prices(input=1.0, output=50.0), 400),
            (Prices(input=1.0, output=50.0, tiers={next(iter(tier.values())): 2.0}), 200),
            (None, 200),
        ]
    ):
        (tmp_path / str(n)).mkdir()
        limits = Limits(max_cost=1.0)
        (answer,), served = asked(tmp_path / str(n), [], tier, path=path, limits=limits, prices=prices)
        assert (answer.status_code, served.api.n_asked) == (status, int(status == 200))
        if prices is not None and status == 200:
            assert served.used.cost(prices) == 2 * served.used.usage.cost(prices) > 0


def test_a_tier_that_the_provider_names_is_charged(tmp_path: Path) -> None:
    usage = {"prompt_tokens": 10, "completion_tokens": 90}
    odd = odd_answers.stream({"choices": [], "usage": usage, "service_tier": "priority"})
    _, served = asked(
        tmp_path, [Step(odd=odd)], {"service_tier": "auto"}, limits=Limits(max_cost=1.0), prices=PRICES
    )
    assert list(served.used.tiers) == ["priority"]
    assert served.used.recorded(PRICES)["cost"] == round(2 * (10 * 1.0 + 90 * 50.0) / 1e6, 6)


@pytest.mark.parametrize(
    ("protocol", "method", "path"),
    [
        ("openai", "GET", "v1/models"),
        ("anthropic", "POST", "v1/messages/count_tokens"),
        ("google", "GET", "v1beta/models"),
        ("google", "POST", "v1beta/models/m:countTokens"),
    ],
)
async def test_requests_without_cost_are_counted_and_limited(
    tmp_path: Path, protocol: Any, method: str, path: str
) -> None:
    async with relay(tmp_path, [], protocol=protocol, limits=Limits(max_requests=1)) as served:
        for status in (200, 400):
            body = {"json": {}} if method == "POST" else {}
            assert (await served.client.request(method, f"/{path}", **body)).status_code == status
    assert (served.used.requests, served.used.failed, served.used.usage.total) == (1, 0, 0)


async def test_bodies_that_never_end_do_not_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "MAX_HELD_BYTES", 4 << 20)

    async def endless() -> Any:
        for _ in range(20):
            yield b" " * (1 << 20)
        await asyncio.sleep(60.0)

    async with relay(tmp_path, []) as served:
        posts = [
            asyncio.ensure_future(served.client.post("/v1/responses", content=endless())) for _ in range(3)
        ]
        done, _ = await asyncio.wait(posts, timeout=30.0, return_when=asyncio.FIRST_COMPLETED)
        with contextlib.suppress(httpx.HTTPError):
            assert {each.result().status_code for each in done} == {429}
        for each in posts:
            each.cancel()
        await asyncio.wait(posts)
        # Their memory is free again.
        while (await served.ask("responses", input="x" * (3 << 20))).status_code != 200:
            await asyncio.sleep(0.05)
    assert served.used.requests == 1


def test_hostile_documents_leave_the_relays_memory_bounded(tmp_path: Path) -> None:
    """Four bodies of 32 MB took 1.9 GB."""
    sock = bound("127.0.0.1", 0)
    sock.listen(64)
    order = RelaySetup(
        upstream=Upstream(protocol="openai", base_url="http://127.0.0.1:1/v1", key=KEY),
        token=TOKEN,
        ledger=str(tmp_path / "ledger.jsonl"),
    )
    line = msgspec.json.encode(StartRelay(order=msgspec.to_builtins(order))) + b"\n"
    program = [sys.executable, "-m", "evopolicy_gateway.relay", str(sock.fileno())]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, pass_fds=(sock.fileno(),)
    ) as process:
        assert process.stdin is not None
        process.stdin.write(line)
        process.stdin.flush()
        statuses = asyncio.run(_flood(sock))
        status = Path(f"/proc/{process.pid}/status").read_text()
        limit = Path(f"/proc/{process.pid}/limits").read_text()
        process.stdin.close()
    sock.close()
    peak_kb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    assert set(statuses) <= {400, 429}
    assert peak_kb < 500_000
    data = next(line for line in limit.splitlines() if line.startswith("Max data size"))
    assert data.split()[3:5] == [str(1 << 30)] * 2


async def _flood(sock: socket.socket) -> list[int]:
    body = b'{"model": "m", "input": [' + b"{}," * ((32 << 20) // 3 - 20) + b"{}]}"
    address = f"http://127.0.0.1:{sock.getsockname()[1]}"
    headers = {"authorization": f"Bearer {TOKEN}"}
    async with httpx.AsyncClient(base_url=address, headers=headers, trust_env=False, timeout=120.0) as client:
        posts = [client.post("/v1/responses", content=body) for _ in range(6)]
        answers = await asyncio.gather(*posts, return_exceptions=True)
        # A refused body is not read to its end.
        return [each.status_code for each in answers if isinstance(each, httpx.Response)]


def test_what_the_relay_adds_is_taken_back_after_a_refusal(tmp_path: Path) -> None:
    """Some servers refuse `stream_options`, and no setting helped."""

    def refuses(handler: Any, request: dict[str, Any]) -> None:
        if "stream_options" in request or request.get("seed"):
            refusal = {"detail": "stream_options: extra fields not permitted"}
            odd_answers.answers(422, refusal)(handler, request)
        else:
            odd_answers.stream(odd_answers.says("x" * 400))(handler, request)

    # An agent that provokes such an error does not end the counting.
    bodies: list[dict[str, Any]] = [{"seed": 1}, {}, {}, {"stream_options": {"a": 1}}]
    answers, served = asked(tmp_path, [Step(odd=refuses)] * 9, *bodies)
    assert [each.status_code for each in answers] == [422, 200, 200, 422]
    added = ["stream_options" in each for each in served.api.requests]
    assert added == [True, False, True, False, False, True]
    used = served.used
    assert (used.requests, used.failed, used.estimated, used.usage.output) == (6, 4, 2, 200)


@pytest.mark.parametrize("kind", ["text/plain", "application/json", ""])
def test_a_providers_own_words_pass_on_without_secrets(tmp_path: Path, kind: str) -> None:
    words = json.dumps([{"error": {"message": f"thought_signature is missing for {KEY}" + "." * 900}}])
    spelt = words.replace("sk-the", "sk\\u002dthe").encode()

    script = [Step(odd=odd_answers.garbage(spelt, kind, 400))]
    (answer,), _ = asked(tmp_path, script, {}, path=GEMINI, protocol="google")
    assert answer.status_code == 400
    assert "thought_signature is missing for [redacted]..." in answer.text
    assert "." * 900 in answer.text


def test_an_account_without_quota_is_told_and_not_tried_again(tmp_path: Path) -> None:
    says = odd_answers.answers(429, {"error": {"code": "insufficient_quota", "message": "no money"}})
    (answer,), served = asked(tmp_path, [Step(odd=says)], {})
    assert (answer.status_code, answer.headers["x-should-retry"]) == (429, "false")
    assert "retry-after" not in answer.headers
    assert served.notes == [f"{served.api.base_url}/v1 answered 429: the account has no quota left"]


def test_google_without_events_is_counted_too(tmp_path: Path) -> None:
    usage = {"promptTokenCount": 7, "candidatesTokenCount": 3, "thoughtsTokenCount": 2}
    one = {"candidates": [], "usageMetadata": usage | {"candidatesTokenCount": 1}}
    documents = [one, {"usageMetadata": usage, "modelVersion": "g-1"}]

    script = [Step(odd=odd_answers.answers(200, documents))]
    path = "models/g:streamGenerateContent"
    _, served = asked(tmp_path, script, {}, path=path, protocol="google", model="g")
    used = served.used
    assert (used.usage.input_noncached, used.usage.output, used.usage.reasoning) == (7, 5, 2)
    assert (used.models, used.other_models, used.estimated) == ({"g-1": 1}, {}, 0)
