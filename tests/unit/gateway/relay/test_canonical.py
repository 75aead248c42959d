"""Which requests a replay takes for the same, and how it shows two that are not."""

from __future__ import annotations

import json
from typing import Any

import pytest

from evopolicy_gateway.relay.canonical import MAX_LINES, canonical, difference


def said(text: str, **more: Any) -> dict[str, Any]:
    return {"messages": [{"role": "user", "content": text}], **more}


SAME = [
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
    ("messages", said("Today's date is 2026-01-02."), said("Today's date is 2027-11-30.")),
    ("messages", said("-rw-r--r-- 1 a a 9 Jan  2 03:04 x"), said("-rw-r--r-- 1 a a 9 Nov 30 11:22 x")),
    (
        "responses",
        said("-r--r--r-- 1 root root  599 Jan  2 03:04 summary.json"),
        said("-r--r--r-- 1 root root 1600 Nov 30 11:22 summary.json"),
    ),
    ("messages", said("Fri Nov 27 01:48:51 UTC 2026"), said("Sat Nov 28 02:00:00 UTC 2026")),
    (
        "messages",
        said(json.dumps({"wall_time_seconds": 0.31, "submit_started_at": "2026-01-02T03:04:05.678Z"})),
        said(json.dumps({"wall_time_seconds": 1e-05, "submit_started_at": "2026-11-12T13:14:15.1Z"})),
    ),
    (
        "responses",
        said("Chunk ID: 0a1b2c\nWall time: 0.2 seconds"),
        said("Chunk ID: ffffff\nWall time: 9 seconds"),
    ),
    ("responses", said("running with session ID 54321"), said("running with session ID 9876")),
    (
        "messages",
        said("Command running in background with ID: bsk6m4i4a. Output: /tmp/c/tasks/bsk6m4i4a.output"),
        said("Command running in background with ID: b00000000. Output: /tmp/c/tasks/b00000000.output"),
    ),
    ("messages", said("<task-id>b5782nkfk</task-id>"), said("<task-id>baijofz2f</task-id>")),
    ("messages", said("CLAUDE_CODE_MESSAGING_TOKEN=74c8"), said("CLAUDE_CODE_MESSAGING_TOKEN=3a02b")),
    ("responses", said("Original token count: 180\n"), said("Original token count: 1181\n")),
    ("messages", said("saved to: /r/tool-results/bx1.txt"), said("saved to: /r/tool-results/b9z.txt")),
    ("messages", said("real\t0m0.013s\nuser\t0m1.2s"), said("real\t1m0.011s\nuser\t0m0.9s")),
    ("messages", said(json.dumps("sys\t0m0.013s")), said(json.dumps("sys\t0m0.011s"))),
    ("messages", said("Ran 1 test in 0.000s"), said("Ran 1 test in 0.012s")),
    ("messages", said("<P object at 0x7fb98a3c5d10>"), said("<P object at 0x7f11c2a09d90>")),
    ("messages", said("Inode: 2360997     Links: 1"), said("Inode: 99          Links: 1")),
]
DIFFERENT = [
    ("chat/completions", said("a", temperature=0), said("a", temperature=1)),
    ("messages", said("mean return 97.62"), said("mean return 97.63")),
    ("messages", said("Ran 1 test in 0.1s"), said("Ran 2 tests in 0.1s")),
    ("messages", said("at 0x7fb98a3c5d10 it fails"), said("at 0x7f11c2a09d90 it fails")),
    ("messages", said("-rw-r--r-- 1 a a 9 Jan  2 03:04 x"), said("-rw-r--r-- 1 a a 8 Jan  2 03:04 x")),
    ("messages", said("TOKEN=74c8"), said("TOKEN=3a02")),
    ("messages", said("<task-id>b5782</task-id> failed"), said("<task-id>b5782</task-id> completed")),
    ("messages", said("/a/tasks/one.output"), said("/b/tasks/one.output")),
    ("messages", said("a") | {"system": [{"text": "x"}]}, said("a") | {"system": [{"text": "y"}]}),
]


@pytest.mark.parametrize(("api", "one", "other"), SAME)
def test_requests_that_differ_by_time_or_chance_are_the_same(api: str, one: Any, other: Any) -> None:
    assert canonical(api, json.dumps(one).encode()) == canonical(api, json.dumps(other).encode())


@pytest.mark.parametrize(("api", "one", "other"), DIFFERENT)
def test_requests_that_differ_otherwise_are_not(api: str, one: Any, other: Any) -> None:
    assert canonical(api, json.dumps(one).encode()) != canonical(api, json.dumps(other).encode())


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
    assert len(shown) == MAX_LINES + 1
