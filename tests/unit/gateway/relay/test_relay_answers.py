"""The counts of an answer, however its bytes arrive and whatever its sender says."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.relay.answers import CHARS_PER_TOKEN, MAX_TOKENS, SHAPES, AnswerReader
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
    if api == "generateContent":
        counts = {"promptTokenCount": fresh + cached, "cachedContentTokenCount": cached}
        counts |= {"candidatesTokenCount": output - reasoning, "thoughtsTokenCount": reasoning}
        parts = {"candidates": [{"content": {"parts": [{"text": "hello"}]}}]}
        return [{"modelVersion": "m"} | parts, {"modelVersion": "m", "usageMetadata": counts}]
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
    counted = reader.metered(250)
    expected = Usage(
        input_noncached=fresh,
        cache_read=cached,
        output=output,
        reasoning=None if api == "messages" else reasoning,
    )
    assert (passed, counted) == (data, (expected, False, "m", ""))


@pytest.mark.parametrize("api", SHAPES)
@given(st.binary(max_size=300), st.lists(anything, max_size=4), st.booleans())
def test_any_bytes_pass_on_and_give_counts(
    api: str, noise: bytes, documents: list[Any], events: bool
) -> None:
    data = noise + b"".join(b"data: " + json.dumps(each).encode() + b"\n\n" for each in documents)
    reader = AnswerReader(SHAPES[api], events=events)
    passed = reader.feed(data) + reader.end()
    counted = reader.metered(100)[0]
    assert passed == data
    assert min(counted.input_noncached, counted.cache_read, counted.cache_creation, counted.output) >= 0
    assert counted.total <= 4 * MAX_TOKENS


@pytest.mark.parametrize("api", SHAPES)
@given(anything)
def test_counts_of_any_kind_are_believed_only_if_they_can_be(api: str, wrong: Any) -> None:
    shape = SHAPES[api]
    reader = AnswerReader(shape, events=False)
    counts: dict[str, Any] = {}
    for path in {paths[0] for paths in shape.counts.values()}:
        inner, _, last = path.rpartition(".")
        (counts.setdefault(inner, {}) if inner else counts)[last] = wrong
    for inner in reversed(shape.usage[0].split(".")):
        counts = {inner: counts}
    reader.feed(json.dumps(counts).encode())
    reader.end()
    usage, estimated, *_ = reader.metered(100)
    believed = isinstance(wrong, int) and not isinstance(wrong, bool) and 0 <= wrong <= MAX_TOKENS
    assert estimated is not believed
    if not believed:
        assert usage.input_noncached == 100


@pytest.mark.parametrize("api", SHAPES)
def test_a_stream_that_breaks_off_is_estimated_and_marked(api: str) -> None:
    first = answer_of(api, 10, 5, 20, 2)[:-1]
    if api == "messages":
        first = first[:2]
    reader = AnswerReader(SHAPES[api], events=True)
    for each in first:
        reader.feed(event(each))
    usage, estimated, *_ = reader.metered(20)
    assert estimated
    assert usage.output == len("hello") // CHARS_PER_TOKEN
    assert usage.input_noncached == (10 if api == "messages" else 20)


def test_counts_that_were_not_asked_for_are_read_and_left_out() -> None:
    reader = AnswerReader(SHAPES["chat/completions"], events=True, drops_usage=True)
    text, usage = (event(each) for each in answer_of("chat/completions", 10, 5, 20, 2))
    assert reader.feed(text + usage + b"data: [DONE]\n\n") == text + b"data: [DONE]\n\n"
    assert reader.metered(0)[0].total == 35


def test_an_endless_event_ends_the_answer_and_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evopolicy_gateway.relay.answers.MAX_EVENT_BYTES", 1000)
    reader = AnswerReader(SHAPES["messages"], events=True)
    for _ in range(7):
        assert reader.feed(b"data: x" * 20) == b""
    with pytest.raises(ValueError, match="an event of more than 1,000 bytes"):
        reader.feed(b"data: x" * 20)
    assert reader.held_bytes == 0
    usage, estimated, *_ = reader.metered(0)
    assert estimated
    assert usage.output >= 1000 // 4


SPELLINGS = st.lists(st.sampled_from(["plain", "\\u%04x", "\\u%04X", "\\\\u%04x"]), min_size=10, max_size=10)


@given(SPELLINGS, st.lists(st.integers(0, 200), max_size=8), st.sampled_from([True, False]))
def test_no_division_or_spelling_of_an_answer_lets_a_secret_through(
    spellings: list[str], cuts: list[int], events: bool
) -> None:
    """A provider that repeats the key may write any of its characters as an escape of JSON, such as `\\u002d`."""
    spelt = "".join(
        each if how == "plain" else how % ord(each) for each, how in zip("sk-the/key", spellings, strict=True)
    )
    whole = f'data: {{"error": "your key {spelt} is wrong"}}\n\n'.encode()
    places = sorted({0, len(whole), *(cut for cut in cuts if cut < len(whole))})
    reader, clean = AnswerReader(SHAPES["messages"], events=events), Redaction(["sk-the/key"]).without_known
    passed = b"".join(clean(reader.feed(whole[a:b])) for a, b in pairwise(places)) + clean(reader.end())
    assert passed == b'data: {"error": "your key [redacted] is wrong"}\n\n'
