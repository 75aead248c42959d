"""The canonical form of a request, by which a replay recognises it. No I/O.

`LEFT_OUT` names fields that differ between equal requests, by API; `TEXTS` replaces times and random names in all
texts. docs/how-to/replay.md lists both.
"""

from __future__ import annotations

import difflib
import itertools
import json
import re

import orjson

LEFT_OUT: dict[str, tuple[str, ...]] = {
    "chat/completions": ("user", "metadata", "prompt_cache_key", "safety_identifier"),
    "responses": (
        *("user", "metadata", "client_metadata", "prompt_cache_key", "safety_identifier"),
        *("input.*.id", "input.*.internal_chat_message_metadata_passthrough"),
    ),
    "messages": (
        *("metadata", "system.*.cache_control", "tools.*.cache_control"),
        *("messages.*.content.*.cache_control", "messages.*.cache_control"),
    ),
}
"""Dotted paths of fields that are left out; `*` stands for each element of a list."""
_CLOCK = rb"\d\d:\d\d(?::\d\d(?:\.\d+)?)?"
_ID = rb"-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}"
# Each begins with few bytes, by which `re` finds its places fast: it searches every request of a run.
TEXTS: tuple[tuple[str, re.Pattern[bytes], bytes], ...] = (
    (
        "dates and times of ISO 8601",
        re.compile(rb"20\d\d-[01]\d-[0-3]\d(?:[T ]" + _CLOCK + rb"(?: ?(?:Z|[+-]\d\d:?\d\d))?)?"),
        b"[time]",
    ),
    (
        "dates and times of `ls` and `date`",
        re.compile(
            rb"[JFMASOND](?:an|eb|ar|pr|ay|un|ul|ug|ep|ct|ov|ec) {1,2}\d{1,2} {1,2}(?:"
            + _CLOCK
            + rb"(?: [A-Z]{3,4})?(?: 20\d\d)?|20\d\d)\b"
        ),
        b"[time]",
    ),
    ("days before these", re.compile(rb"[MTWFS](?:on|ue|ed|hu|ri|at|un) \[time\]"), b"[time]"),
    (
        "sizes of files with durations of a submit, in `ls -l`",
        re.compile(rb"(-r--r--r-- 1 \S+ +\S+ )[ \d]+(?= \[time\] \S*summary\.json)"),
        rb"\1[size]",
    ),
    (
        "what is left of an agent's time and tokens",
        re.compile(rb"(Left: )[\d hmin]+ of time, [\d,]+"),
        rb"\1[left]",
    ),
    ("what is left of an agent's time and tokens", re.compile(rb'(left\\*":\s*)\{[^{}]*\}'), rb"\1[left]"),
    ("durations of a submit", re.compile(rb'(wall_time_seconds\\*":\s*)[0-9.eE+-]+'), rb"\1[seconds]"),
    ("what Codex tells of a command", re.compile(rb"(Wall time: )[0-9a-f.]+"), rb"\1[once]"),
    ("what Codex tells of a command", re.compile(rb"(Chunk ID: )[0-9a-f.]+"), rb"\1[once]"),
    ("what Codex tells of a command", re.compile(rb"(Original token count: )\d+"), rb"\1[once]"),
    ("names of Codex's open commands", re.compile(rb"(session ID )\d+"), rb"\1[once]"),
    (
        "names of Claude Code's background commands",
        re.compile(rb"(running in background with ID: )\w+"),
        rb"\1[once]",
    ),
    ("their names in the notice of their end", re.compile(rb"(<task-id>)\w+(?=<)"), rb"\1[once]"),
    ("files of their output", re.compile(rb"(/tasks/)\w+(?=\.output)"), rb"\1[once]"),
    ("files of long output", re.compile(rb"(/tool-results/)\w+(?=\.txt)"), rb"\1[once]"),
    (
        "Claude Code's random variable, as `env` prints it",
        re.compile(rb"(CLAUDE_CODE_MESSAGING_TOKEN=)[0-9a-f]+"),
        rb"\1[once]",
    ),
    ("durations of `time`", re.compile(rb"((?:real|user|sys)\\+t)\d+m[0-9.]+s"), rb"\1[seconds]"),
    ("durations of `unittest`", re.compile(rb"(Ran \d+ tests? in )[0-9.]+s"), rb"\1[seconds]"),
    ("addresses of Python's objects", re.compile(rb"( at 0x)[0-9a-f]{6,16}(?=>)"), rb"\1[address]"),
    ("inodes of `stat`", re.compile(rb"(Inode: )\d+ *"), rb"\1[inode] "),
    ("what Codex tells of a command", re.compile(rb'(duration_seconds\\*":\s*)[0-9a-f.]+'), rb"\1[once]"),
)
"""Patterns in the request's JSON, with what takes their place, after random ids (UUIDs)."""
_HAS_ID, _IDS = re.compile(_ID), re.compile(rb"[0-9a-f]{8}" + _ID)
MAX_LINES = 60
_CONTEXT = 2
"""Equal lines beside a difference."""


def canonical(api: str, body: bytes) -> bytes:
    """The bytes whose digest a replay compares: JSON with sorted keys; a body that is none as it is."""
    try:
        document = orjson.loads(body)
        for path in LEFT_OUT.get(api, ()):
            _remove(document, path.split("."))
        body = orjson.dumps(document, option=orjson.OPT_SORT_KEYS)
    except (orjson.JSONDecodeError, TypeError):
        pass  # no JSON, or nested more deeply than can be written
    if _HAS_ID.search(body):
        body = _IDS.sub(b"[id]", body)
    for _, pattern, by in TEXTS:
        body = pattern.sub(by, body)
    return body


def _remove(value: object, path: list[str]) -> None:
    head, *rest = path
    if head == "*":
        for each in value if isinstance(value, list) else ():
            _remove(each, rest)
    elif isinstance(value, dict):
        if rest:
            _remove(value.get(head), rest)
        else:
            value.pop(head, None)


def difference(recorded: object, now: object) -> str:
    """How two canonical requests differ from the first difference on, in at most `MAX_LINES` lines of a unified diff.

    Compares no more lines than are shown: a diff takes quadratic time, and an agent writes the texts.
    """
    ours, theirs = (
        json.dumps(each, indent=1, ensure_ascii=False, sort_keys=True).replace("\\n", "\n").split("\n")
        for each in (recorded, now)
    )
    pairs = enumerate(itertools.zip_longest(ours, theirs))
    first = max(0, next((n for n, (one, other) in pairs if one != other), 0) - _CONTEXT)
    # Half of them from each side, so that both are seen where every line differs.
    shown = [side[first : first + MAX_LINES // 2] for side in (ours, theirs)]
    names = [f"{side}, from line {first + 1:,}" for side in ("recorded", "now")]
    diff = difflib.unified_diff(shown[0], shown[1], names[0], names[1], n=_CONTEXT, lineterm="")
    lines = [line[:400] for line in diff]
    left = max(len(ours), len(theirs)) - first - MAX_LINES // 2
    return "\n".join(lines[:MAX_LINES] + [f"… {left:,} more lines"] * (left > 0))
