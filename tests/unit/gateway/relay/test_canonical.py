"""Which requests a replay takes for the same, and how it shows two that are not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from evopolicy_gateway.relay import canonical as canonical_module
from evopolicy_gateway.relay.canonical import MAX_LINES, canonical, difference


def said(text: str, **more: Any) -> dict[str, Any]:
    return {"messages": [{"role": "user", "content": text}], **more}


FIELDS = [
    ("chat/completions", said("a", user="u1"), said("a", user="u2", metadata={"x": 1})),
    (
        "responses",
        {"input": [{"id": "m1", "text": "a"}]},
        {"input": [{"id": "m2", "text": "a"}], "metadata": {}},
    ),
    (
        "messages",
        {"messages": [{"content": [{"text": "a", "cache_control": {"type": "ephemeral"}}]}]},
        {"messages": [{"content": [{"text": "a"}]}], "metadata": {"user_id": "s"}},
    ),
]
ONE = {"wall_time_seconds": 0.31, "submit_started_at": "2026-01-02T03:04:05.678Z"}
OTHER = {"wall_time_seconds": 1e-05, "submit_started_at": "2026-11-12T13:14:15.1Z"}
TASK = "Command running in background with ID: {0}. Output: /tmp/c/tasks/{0}.output"
TEXTS = [
    ("Today's date is 2026-01-02.", "Today's date is 2027-11-30."),
    ("-rw-r--r-- 1 a a 9 Jan  2 03:04 x", "-rw-r--r-- 1 a a 9 Nov 30 11:22 x"),
    ("-r--r--r-- 1 r r  599 Jan  2 03:04 summary.json", "-r--r--r-- 1 r r 1600 Nov 30 11:22 summary.json"),
    ("Fri Nov 27 01:48:51 UTC 2026", "Sat Nov 28 02:00:00 UTC 2026"),
    (json.dumps(ONE), json.dumps(OTHER)),
    ("Chunk ID: 0a1b2c\nWall time: 0.2 seconds", "Chunk ID: ffffff\nWall time: 9 seconds"),
    ("running with session ID 54321", "running with session ID 9876"),
    (TASK.format("bsk6m4i4a"), TASK.format("b00000000")),
    ("<task-id>b5782nkfk</task-id>", "<task-id>baijofz2f</task-id>"),
    ("CLAUDE_CODE_MESSAGING_TOKEN=74c8", "CLAUDE_CODE_MESSAGING_TOKEN=3a02b"),
    ("Original token count: 180\n", "Original token count: 1181\n"),
    ("saved to: /r/tool-results/bx1.txt", "saved to: /r/tool-results/b9z.txt"),
    ("real\t0m0.013s\nuser\t0m1.2s", "real\t1m0.011s\nuser\t0m0.9s"),
    (json.dumps("sys\t0m0.013s"), json.dumps("sys\t0m0.011s")),
    ("Ran 1 test in 0.000s", "Ran 1 test in 0.012s"),
    ("<P object at 0x7fb98a3c5d10>", "<P object at 0x7f11c2a09d90>"),
    ("Go on. Left: 11 h 58 min of time, 99,000 tokens", "Go on. Left: 0 h 02 min of time, 1,000,000 tokens"),
    ('{"left": {"wall_time_s": 43100}}', '{"left": {"wall_time_s": 7, "model_tokens": 12}}'),
    ("Inode: 2360997     Links: 1", "Inode: 99          Links: 1"),
]
SAME = [*FIELDS, *(("messages", said(one), said(other)) for one, other in TEXTS)]
OTHERS = [
    ("mean return 97.62", "mean return 97.63"),
    ("Ran 1 test in 0.1s", "Ran 2 tests in 0.1s"),
    ("at 0x7fb98a3c5d10 it fails", "at 0x7f11c2a09d90 it fails"),
    ("-rw-r--r-- 1 a a 9 Jan  2 03:04 x", "-rw-r--r-- 1 a a 8 Jan  2 03:04 x"),
    ("TOKEN=74c8", "TOKEN=3a02"),
    ("<task-id>b5782</task-id> failed", "<task-id>b5782</task-id> completed"),
    ("/a/tasks/one.output", "/b/tasks/one.output"),
]
DIFFERENT = [
    ("chat/completions", said("a", temperature=0), said("a", temperature=1)),
    ("messages", said("a", system=[{"text": "x"}]), said("a", system=[{"text": "y"}])),
    *(("messages", said(one), said(other)) for one, other in OTHERS),
]


@pytest.mark.parametrize(
    ("api", "one", "other", "same"), [(*each, True) for each in SAME] + [(*each, False) for each in DIFFERENT]
)
def test_requests_are_the_same_only_if_time_or_chance_tell_them_apart(
    api: str, one: Any, other: Any, same: bool
) -> None:
    forms = [canonical(api, json.dumps(each).encode()) for each in (one, other)]
    assert (forms[0] == forms[1]) is same


def test_bytes_that_are_no_request_have_a_form_too() -> None:
    nested = b"[" * 5000 + b"]" * 5000
    for body in (b"", b"\xff", b"null", b'{"input": 3}', b'{"input": [[]]}', nested):
        assert canonical("responses", body) == canonical("responses", body)


def test_a_difference_is_short_and_names_both_sides() -> None:
    shown = difference(said("a\nb"), said("a\nc\n" + "d\n" * 999)).splitlines()
    assert shown[0].startswith("--- recorded")
    assert " b" not in shown
    assert any(line.startswith("-b") for line in shown)
    assert any(line.startswith("+c") for line in shown)
    assert len(shown) <= MAX_LINES + 1
    assert shown[-1].endswith("more lines")


def test_a_difference_is_sought_in_no_more_lines_than_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attack: an agent whose long requests differ in every line keeps a replay's diff, which is quadratic, busy for
    hours. Defence: it compares what it shows."""
    compared: list[int] = []
    known = canonical_module.difflib.unified_diff

    def counted(ours: list[str], theirs: list[str], *more: str, **named: Any) -> Iterator[str]:
        compared.extend([len(ours), len(theirs)])
        return known(ours, theirs, *more, **named)

    monkeypatch.setattr(canonical_module.difflib, "unified_diff", counted)
    same = "same\n" * 5000
    texts = (same + "".join(f"{sign}{n % 7}\n" for n in range(50_000)) for sign in "ab")
    shown = difference(*map(said, texts)).splitlines()
    assert max(compared) <= MAX_LINES
    assert "from line 5,0" in shown[0]
    assert any(line.startswith("-a") for line in shown)
    assert any(line.startswith("+b") for line in shown)
