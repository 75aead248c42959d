"""The counts of an answer, however its bytes arrive and whatever its sender says."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_gateway.relay.answers import CHARS_PER_TOKEN, MAX_TOKENS, SHAPES, AnswerReader, Cleaner
from evopolicy_gateway.relay.usage import Usage

counts = st.integers(0, MAX_TOKENS)
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)


def event(document: Any, kind: str = "", end: str = "\n") -> bytes:
    name = f"event: {kind}{end}" if kind else ""
    return f"{name}data: {json.dumps(document)}{end}{end}".encode()


def answer_of(api: str, fresh: int, cached: int, output: int, reasoning: int) -> list[dict[str, Any]]:
    """A whole stream of an API with these counts."""
    if api == "messages":
        usage = {"input_tokens": fresh, "cache_read_input_tokens": cached, "output_tokens": 1}
        return [
            {"type": "message_start", "message": {"model": "m", "usage": usage}},
            {"type": "content_block_delta", "delta": {"type": "text_delta", "text": "hello"}},
            {"type": "message_delta", "usage": {"output_tokens": output}},
            {"type": "message_stop"},
        ]
    inside = {"cached_tokens": cached}
    if api == "responses":
        usage = {"input_tokens": fresh + cached, "input_tokens_details": inside, "output_tokens": output}
        usage["output_tokens_details"] = {"reasoning_tokens": reasoning}
        return [
            {"type": "response.output_text.delta", "delta": "hello"},
            {"type": "response.completed", "response": {"model": "m", "usage": usage}},
        ]
    usage = {"prompt_tokens": fresh + cached, "prompt_tokens_details": inside, "completion_tokens": output}
    usage["completion_tokens_details"] = {"reasoning_tokens": reasoning}
    return [
        {"model": "m", "choices": [{"delta": {"content": "hello"}}]},
        {"model": "m", "choices": [], "usage": usage},
    ]


@pytest.mark.parametrize("api", SHAPES)
@given(counts, counts, counts, st.integers(1, 60), st.sampled_from(["\n", "\r\n", "\r"]))
def test_a_stream_is_counted_however_it_is_cut(
    api: str, fresh: int, cached: int, output: int, size: int, end: str
) -> None:
    fresh, cached, reasoning = fresh // 2, cached // 2, output // 3
    data = b"".join(
        event(each, each.get("type", ""), end) for each in answer_of(api, fresh, cached, output, reasoning)
    )
    reader = AnswerReader(SHAPES[api], events=True)
    passed = b"".join(reader.feed(data[at : at + size]) for at in range(0, len(data), size)) + reader.end()
    counted = reader.metered(1000)
    expected = Usage(
        input_noncached=fresh,
        cache_read=cached,
        output=output,
        reasoning=None if api == "messages" else reasoning,
    )
    assert (passed, counted) == (data, {"usage": expected, "estimated": False, "answered": "m"})


@pytest.mark.parametrize("api", SHAPES)
@given(st.binary(max_size=300), st.lists(anything, max_size=4), st.booleans())
def test_any_bytes_pass_on_and_give_counts(
    api: str, noise: bytes, documents: list[Any], events: bool
) -> None:
    data = noise + b"".join(b"data: " + json.dumps(each).encode() + b"\n\n" for each in documents)
    reader = AnswerReader(SHAPES[api], events=events)
    passed = reader.feed(data) + reader.end()
    counted = reader.metered(400)["usage"]
    assert passed == data
    assert min(counted.input_noncached, counted.cache_read, counted.cache_creation, counted.output) >= 0
    assert counted.total <= 4 * MAX_TOKENS


@pytest.mark.parametrize("api", SHAPES)
@given(anything)
def test_counts_of_any_kind_are_believed_only_if_they_can_be(api: str, wrong: Any) -> None:
    shape = SHAPES[api]
    reader = AnswerReader(shape, events=False)
    reader.feed(json.dumps({"usage": dict.fromkeys(shape.counts.values(), wrong)}).encode())
    reader.end()
    counted = reader.metered(400)
    believed = isinstance(wrong, int) and not isinstance(wrong, bool) and 0 <= wrong <= MAX_TOKENS
    assert counted["estimated"] is not believed
    if not believed:
        assert counted["usage"].input_noncached == 400 // CHARS_PER_TOKEN


@pytest.mark.parametrize("api", SHAPES)
def test_a_stream_that_breaks_off_is_estimated_and_marked(api: str) -> None:
    first = answer_of(api, 10, 5, 20, 2)[:-1]
    if api == "messages":
        first = first[:2]
    reader = AnswerReader(SHAPES[api], events=True)
    for each in first:
        reader.feed(event(each))
    counted = reader.metered(80)
    assert counted["estimated"]
    assert counted["usage"].output == len("hello") // CHARS_PER_TOKEN
    assert counted["usage"].input_noncached == (10 if api == "messages" else 80 // CHARS_PER_TOKEN)


def test_counts_that_were_not_asked_for_are_read_and_left_out() -> None:
    reader = AnswerReader(SHAPES["chat/completions"], events=True, drops_usage=True)
    text, usage = (event(each) for each in answer_of("chat/completions", 10, 5, 20, 2))
    assert reader.feed(text + usage + b"data: [DONE]\n\n") == text + b"data: [DONE]\n\n"
    assert reader.metered(0)["usage"].total == 35


def test_an_endless_event_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evopolicy_gateway.relay.answers.MAX_EVENT_BYTES", 1000)
    reader = AnswerReader(SHAPES["messages"], events=True)
    passed = b"".join(reader.feed(b"data: x" * 20) for _ in range(100))
    assert len(passed) + len(reader.end()) == 100 * 140
    counted = reader.metered(0)
    assert counted["estimated"]
    assert counted["usage"].output >= len(passed) // 4


@given(
    st.lists(st.sampled_from([b"sk-secret-1", b"token-22", b"s", b"sk-", b"data: ", b"\n\n"]), max_size=12),
    st.lists(st.integers(0, 80), max_size=8),
)
def test_no_division_of_an_answer_lets_a_secret_through(parts: list[bytes], cuts: list[int]) -> None:
    secrets = (b"sk-secret-1", b"token-22")
    whole = b"".join(parts)
    places = sorted({0, len(whole), *(cut for cut in cuts if cut < len(whole))})
    cleaner = Cleaner(secrets)
    passed = b"".join(cleaner.feed(whole[a:b]) for a, b in pairwise(places)) + cleaner.end()
    expected = whole
    for secret in secrets:
        expected = expected.replace(secret, b"[key]")
    assert passed == expected
