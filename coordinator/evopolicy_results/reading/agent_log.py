"""Reads from an agent's own log what preceded each submit: its messages, the feedback it read, the images it made.

A submit's position in the stream is the first tool output with its answer (`submit_id`, or its summary), or the first
plain line that begins with its name. If the log never shows answers but has timestamps, these decide. If it has
neither, nothing is attributed: messages are listed separately rather than guessed into place.

An agent may write anything into its log. So each rule here takes time linear in its length, and the amount of data
that is kept is bounded.
"""

from __future__ import annotations

import bisect
import itertools
import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import msgspec

from evopolicy_common.records.agent_log import parts
from evopolicy_common.records.json_text import objects
from evopolicy_common.regular_files import open_regular
from evopolicy_results.reading.records import PastSubmit

MAX_LOG_BYTES = 64 << 20
"""Later bytes of a log are not read."""
MAX_MESSAGE_CHARS = 6000
MAX_EVENTS = 200_000
"""Later events of a log are not read."""
MAX_PATHS = 1000
"""Maximum number of feedback paths, and of images, per submit."""
_MAX_PATH_CHARS = 4096

_FEEDBACK = re.compile(r"feedback/[\w./*?\[\]{},-]*")
_PATH = re.compile(r"[\w./-]+")
_IMAGE_SUFFIX = re.compile(r"(?<=.)\.(?:png|jpe?g|gif|webp)\b", re.IGNORECASE)
_ANSWER = re.compile(r"submit_(?:id|index)[\\\"'\s:=]+(?:submit_)?0*(\d+)")
_NAMED = re.compile(r"submit_0*(\d{1,9})\b")
_TIMES = ("timestamp", "at", "time", "ts")
_MAX_STAMP_CHARS = 64


class LogEvent(msgspec.Struct, frozen=True, kw_only=True):
    message: str = ""
    """Text that the agent wrote, not a tool's."""
    read: tuple[str, ...] = ()
    """Paths under `feedback/` that a tool call names."""
    images: tuple[str, ...] = ()
    """Image files that a tool call names."""
    answered: tuple[int, ...] = ()
    """Indices of the submits that a tool's output answers."""
    at: float | None = None
    """Unix time, seconds; None when the line has no timestamp."""


class Evidence(msgspec.Struct, frozen=True, kw_only=True):
    """The log's events between the previous submit and this one."""

    read: tuple[str, ...] = ()
    """Feedback paths that the agent's tool calls name, in order, without repeats."""
    messages: tuple[str, ...] = ()
    """The agent's own messages; the last is the closest to the submit, and may say why the result came."""
    images: tuple[str, ...] = ()

    @property
    def attribution(self) -> str:
        return self.messages[-1] if self.messages else ""


class LogReading(msgspec.Struct, frozen=True, kw_only=True):
    by_submit: dict[int, Evidence] = {}
    unplaced: tuple[str, ...] = ()
    """Messages from a log that shows no submits, or after the last submit."""


def read_agent_log(path: Path, submits: Sequence[PastSubmit]) -> LogReading:
    """Reads a run's log; empty when it is missing. Never raises for damaged content."""
    try:
        every = (event for value in objects(_lines(path)) for event in _events_of(value))
        events = list(itertools.islice(every, MAX_EVENTS))
    except OSError:
        return LogReading()
    groups = _by_results(events, submits)
    if groups.keys() == {None}:
        groups = _by_times(events, submits)
    unplaced = tuple(event.message for event in groups.pop(None, ()) if event.message)
    by_submit = {index: _evidence(own) for index, own in groups.items() if index is not None}
    return LogReading(by_submit=by_submit, unplaced=unplaced)


_Groups = dict[int | None, list[LogEvent]]
"""Events by the submit that they precede; None: by no known one."""


def _by_results(events: Sequence[LogEvent], submits: Sequence[PastSubmit]) -> _Groups:
    groups: _Groups = {}
    pending: list[LogEvent] = []
    places = {submit.index: place for place, submit in enumerate(submits)}
    first_waiting = 0
    for event in events:
        answered = next((index for index in event.answered if places.get(index, -1) >= first_waiting), None)
        if answered is not None:
            groups[answered], pending = pending, []
            first_waiting = places[answered] + 1
        pending.append(event)
    return {**groups, None: pending}


def _by_times(events: Sequence[LogEvent], submits: Sequence[PastSubmit]) -> _Groups:
    starts = [(at, submit.index) for submit in submits if (at := _instant(submit.started_at)) is not None]
    # An event goes to the first submit that starts late enough, so a submit listed after a later start gets none.
    latest = list(itertools.accumulate((at for at, _ in starts), max))
    groups: _Groups = {}
    for event in events:
        place = len(starts) if event.at is None else bisect.bisect_left(latest, event.at)
        groups.setdefault(starts[place][1] if place < len(starts) else None, []).append(event)
    return groups


def _evidence(events: Sequence[LogEvent]) -> Evidence:
    read = dict.fromkeys(path for event in events for path in event.read)
    images = dict.fromkeys(path for event in events for path in event.images)
    return Evidence(
        read=tuple(itertools.islice(read, MAX_PATHS)),
        messages=tuple(event.message for event in events if event.message),
        images=tuple(itertools.islice(images, MAX_PATHS)),
    )


def _lines(path: Path) -> Iterator[bytes]:
    remaining = MAX_LOG_BYTES
    with open_regular(path) as stream:
        while line := stream.readline(remaining):
            remaining -= len(line)
            yield line


def _events_of(value: dict[str, object]) -> Iterator[LogEvent]:
    at = next((at for key in _TIMES if (at := _instant(value.get(key))) is not None), None)
    for part in parts(value):
        if part.kind == "call":
            yield _call(part.value, at)
        elif part.kind == "result":
            numbers = (match[1] for text in _strings(part.value) for match in _ANSWER.finditer(text))
            answered = dict.fromkeys(int(number) for number in numbers if len(number) <= 9)
            yield LogEvent(answered=tuple(answered), at=at)
        elif part.kind in ("text", "stdout") and part.by_agent and isinstance(part.value, str):
            named = _NAMED.match(part.value) if part.kind == "stdout" else None
            yield LogEvent(message=_clip(part.value), answered=(int(named[1]),) if named else (), at=at)


def _call(arguments: object, at: float | None) -> LogEvent:
    """A tool call, with the paths that its arguments name."""
    texts = _strings(arguments)
    read = (path.rstrip("./,") for text in texts for path in _FEEDBACK.findall(text) if _is_short(path))
    images = (path for text in texts for path in _images(text) if _is_short(path))
    return LogEvent(read=tuple(dict.fromkeys(read)), images=tuple(dict.fromkeys(images)), at=at)


def _images(text: str) -> Iterator[str]:
    """Every run of path characters that holds an image suffix, cut after its last one."""
    for run in _PATH.findall(text):
        ends = [match.end() for match in _IMAGE_SUFFIX.finditer(run)]
        if ends:
            yield run[: ends[-1]]


def _is_short(path: str) -> bool:
    return len(path) <= _MAX_PATH_CHARS


def _strings(value: object, depth: int = 0) -> list[str]:
    """Every string inside a JSON value, in order."""
    if isinstance(value, str):
        return [value]
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [text for item in items for text in _strings(item, depth + 1)] if depth <= 6 else []


def _instant(value: object) -> float | None:
    try:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value) / (1000.0 if value > 1e11 else 1.0)
        if isinstance(value, str) and 0 < len(value) <= _MAX_STAMP_CHARS:
            return datetime.fromisoformat(value).timestamp()
    except (ValueError, OverflowError, OSError):
        pass
    return None


def _clip(text: str) -> str:
    text = text.strip()
    return text if len(text) <= MAX_MESSAGE_CHARS else text[:MAX_MESSAGE_CHARS] + " …"
