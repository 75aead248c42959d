"""The pages of one run: code at each submit, episodes, the agent's messages, the run's events.

An agent or a policy wrote all of it, or is quoted in it: it is text, bounded in length, and never markup. The code of
an open run is in its gateway's folder, found by the gateway's journal; that of a finished run is in its checkpoints.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from string import Formatter

import msgspec
import numpy as np

from evopolicy_common.errors import DECODE_ERRORS, BundleError
from evopolicy_common.messages.bounds import LARGEST
from evopolicy_common.messages.gateway import SubmitAccepted
from evopolicy_common.records import open_run
from evopolicy_common.records.agent_log import LogPart, parts
from evopolicy_common.records.blobs import is_digest
from evopolicy_common.records.episodes.npz import read_arrays
from evopolicy_common.records.json_text import objects
from evopolicy_common.records.open_run import SubmitRequested
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.checkpoints import METADATA
from evopolicy_common.records.words import in_words
from evopolicy_common.regular_files import Confined, NotThereError
from evopolicy_common.terminal import event_text
from evopolicy_results.figures.line_chart import ChartLine

MAX_TEXT = 256 << 10
"""Characters of one file, or of one text, that are shown."""
_MAX_FILES = 200
_MAX_BUNDLE = 64 << 20
_MAX_JOURNAL = 64 << 20
_TAIL = 512 << 10
"""Bytes of a log from its end that are read at once."""
_MAX_LINE = 20_000
MAX_WORDS = 150
"""Entries of the agent's log, and of the run's events, on a page."""
MAX_STEPS = 20_000
"""Steps of an episode that are read for its plots."""
_MAX_TRAJECTORY = 64 << 20
_MAX_UNPACKED = 512 << 20
_MAX_SERIES = 8
"""Components of an observation or action that are drawn."""
IMAGES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".gif": "image/gif",
    ".webp": "image/webp",
}
"""Pictures that are shown in place; SVG is none of them, as it is a document with scripts."""


class CodeFile(msgspec.Struct, frozen=True, kw_only=True):
    """One file of `system/` at a submit."""

    path: str
    size: int
    text: str | None
    """None for one that is no text, or too large."""


class LogMessage(msgspec.Struct, frozen=True, kw_only=True):
    """One entry of the agent's log."""

    at: int
    """Its place in the log, bytes."""
    kind: str
    """`prompt`, `message`, `tool`, `result`, `output`, `stderr`, `ended`."""
    title: str
    text: str


class Happened(msgspec.Struct, frozen=True, kw_only=True):
    at: str
    level: str
    text: str


class Detail:
    """Reads one run's folder. Cheap to create; the caller keeps costly results."""

    def __init__(self, folder: Path) -> None:
        self.files = Confined(folder)

    # ---- code ----

    def code(self, index: int, *, checkpoints: bool) -> tuple[CodeFile, ...]:
        """`system/` as it was at a submit; empty where it is not told. `checkpoints`: the run's own may be read."""
        digest = self._bundle_of(index)
        files = None if digest is None else _unpacked(self.files, digest)
        if files is not None or not checkpoints:
            return files or ()
        folder = self._numbered("checkpoints/submit_", index)
        return _ordered(
            CodeFile(
                path=path, size=size, text=_as_text(self.files.read_file(f"{folder}/{path}", MAX_TEXT + 1))
            )
            for path, size in self._below(folder)
            if path not in METADATA
        )

    def _bundle_of(self, index: int) -> str | None:
        """The digest of a submit's snapshot, by the gateway's journal."""
        digest: str | None = None
        for line in self.files.read_file(open_run.JOURNAL, _MAX_JOURNAL).splitlines():
            try:
                entry = open_run.line_decoder.decode(line)
            except DECODE_ERRORS:
                continue
            if isinstance(entry, SubmitRequested):
                digest = entry.submit.bundle or entry.kept
            elif isinstance(entry, SubmitAccepted) and entry.submit_index == index:
                return digest if digest is not None and is_digest(digest) else None
        return None

    def _numbered(self, prefix: str, number: int) -> str:
        """The folder with that prefix and number, which has 3 digits or more; empty where there is none."""
        names = (f"{prefix}{number:0{width}d}" for width in range(3, 8))
        return next(filter(self.files.names, names), "")

    def _below(self, folder: str) -> Iterator[tuple[str, int]]:
        waiting, n = [""], 0
        while waiting and n < _MAX_FILES:
            inner = waiting.pop()
            for name in self.files.names(f"{folder}/{inner}".rstrip("/")):
                path = f"{inner}{name.name}"
                if name.is_folder:
                    waiting.append(f"{path}/")
                elif n < _MAX_FILES:
                    n += 1
                    yield path, name.size

    # ---- feedback ----

    def folder_of(self, index: int) -> str:
        """The feedback folder of a submit; empty where there is none."""
        return self._numbered("workspace/feedback/submit_", index)

    def summary(self, index: int) -> Mapping[str, object]:
        """A submit's summary, as its agent has it; empty where there is none."""
        data = self.files.read_file(f"{self.folder_of(index)}/summary.json", _MAX_TRAJECTORY)
        return next(objects([data]), {})

    def episodes(self, index: int) -> list[int]:
        """The numbers of a submit's episodes that have a folder, counted through the run."""
        names = self.files.names(f"{self.folder_of(index)}/episodes")
        numbers = [name.name.removeprefix("ep_") for name in names if name.is_folder]
        return sorted(int(number) for number in numbers if number.isdecimal() and len(number) < 10)

    def episode_files(self, index: int, episode: int) -> tuple[str, list[str]]:
        """The folder of an episode, and the names of its files. NotThereError for none."""
        inner = self._numbered(f"{self.folder_of(index)}/episodes/ep_", episode)
        if not inner:
            raise NotThereError(f"submit {index}, episode {episode}")
        return inner, [name.name for name in self.files.names(inner) if not name.is_folder]

    def text(self, path: str) -> str:
        """The beginning of a file as text; empty where there is none."""
        return self.files.read_file(path, MAX_TEXT).decode("utf-8", "replace")

    def played(self, folder: str) -> tuple[int, dict[str, list[ChartLine]], str]:
        """Number of steps of an episode, its columns by title of a plot, and a note on others."""
        lines = self.files.read_file(f"{folder}/trajectory.jsonl", _MAX_TRAJECTORY).splitlines()
        rows = list(itertools.islice(objects(lines), MAX_STEPS))
        inline = [row.get("obs") for row in rows]
        observed: object = inline if any(each is not None for each in inline) else self._arrays(folder)
        observations, note = _series(observed, len(rows), "obs")
        actions, _ = _series([row.get("action") for row in rows], len(rows), "action")
        if all(type(row.get("action")) is int for row in rows):  # a discrete action holds until the next one
            actions = [line._replace(steps=True) for line in actions]
        rewards = [ChartLine("reward", list(enumerate(map(_reward, rows))))]
        return len(rows), {"Reward": rewards, "Observation": observations, "Action": actions}, note

    def _arrays(self, folder: str) -> object:
        for name in ("observations.npy", "observations.npz"):
            with contextlib.suppress(OSError, ValueError):
                arrays = read_arrays(self.files.read_file(f"{folder}/{name}", _MAX_TRAJECTORY), _MAX_UNPACKED)
                return arrays.get("", arrays)
        return None

    def replays(self) -> list[str]:
        """Names of the recorded hidden episodes. They are hidden results: only for whom those may be shown."""
        names = [name.name for name in self.files.names("replays") if name.is_folder]
        return [name for name in names if self.files.read_file(f"replays/{name}/video.mp4", 1)]

    # ---- words and events ----

    def messages(self, before: int | None = None) -> list[LogMessage]:
        """The last entries of the agent's log, or the last that begin before a place in it; oldest first."""
        lines = self._last_lines("logs/agent.jsonl", before)
        return [each for at, line in lines for each in _messages(at, line)][-MAX_WORDS:]

    def happened(self) -> list[Happened]:
        """The last events of the run; newest first."""
        lines = [line for _, line in self._last_lines("logs/harness.log", None)]
        return list(map(_event, objects(lines)))[-MAX_WORDS:][::-1]

    def _last_lines(self, path: str, before: int | None) -> list[tuple[int, bytes]]:
        """Whole lines near the end of a file, or before a place in it, with their places."""
        try:
            fd = self.files.open(path)
        except NotThereError:
            return []
        with os.fdopen(fd, "rb") as file:
            end = os.fstat(fd).st_size if before is None else max(0, before)
            start = max(0, end - _TAIL)
            file.seek(start)
            data = file.read(end - start)
        lines = data[: data.rfind(b"\n") + 1].splitlines(keepends=True)
        places = itertools.accumulate(map(len, lines), initial=start)
        return list(zip(places, lines, strict=False))[1 if start else 0 :]


_unpacked_bundles: OrderedDict[str, tuple[CodeFile, ...]] = OrderedDict()


def _unpacked(files: Confined, digest: str) -> tuple[CodeFile, ...] | None:
    """The files of a stored bundle; bundles are immutable, so the last few are kept."""
    if digest in _unpacked_bundles:
        return _unpacked_bundles[digest]
    try:
        bundle = bundles.load(
            files.read_file(f"{open_run.BUNDLES}/{digest[:2]}/{digest}", _MAX_BUNDLE), digest
        )
    except (BundleError, *DECODE_ERRORS):
        return None
    unpacked = _unpacked_bundles[digest] = _ordered(
        CodeFile(path=file.path, size=len(file.data), text=_as_text(file.data))
        for file in bundle.files[:_MAX_FILES]
    )
    if len(_unpacked_bundles) > 16:
        _unpacked_bundles.popitem(last=False)
    return unpacked


def _ordered(files: Iterable[CodeFile]) -> tuple[CodeFile, ...]:
    return tuple(sorted(files, key=lambda file: (file.path != "policy.py", file.path)))


def _as_text(data: bytes) -> str | None:
    if len(data) > MAX_TEXT or b"\0" in data:
        return None
    with contextlib.suppress(UnicodeDecodeError):
        return data.decode()
    return None


def _reward(row: dict[str, object]) -> float:
    # Others wrote it: an integer may be too large for a float.
    reward = row.get("reward")
    return float(reward) if isinstance(reward, int | float) and abs(reward) <= LARGEST else float("nan")


def _series(columns: object, n: int, name: str) -> tuple[list[ChartLine], str]:
    """Lines of those values that are numeric with one length; and a note if some are left out."""
    if columns is None:
        return [], ""
    if isinstance(columns, list) and columns and isinstance(columns[0], dict):
        rows = [row if isinstance(row, dict) else {} for row in columns]
        columns = {key: [row.get(key) for row in rows] for key in columns[0]}
    if isinstance(columns, dict):
        parts = [_series(value, n, key) for key, value in sorted(columns.items())]
        lines = [each for one, _ in parts for each in one]
        return lines[:_MAX_SERIES], next((note for _, note in parts if note), "")
    try:
        array = np.asarray(columns, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return [], f"{name} is not made of numbers of one shape, so it is not drawn."
    if array.ndim == 0 or not len(array):
        return [], ""
    array = array[:n].reshape(len(array[:n]), -1)
    width = array.shape[1]
    if width > 64:
        return [], f"{name} has {width:,} numbers a step, so it is not drawn."
    lines = [
        ChartLine(name if width == 1 else f"{name}[{i}]", list(enumerate(values)))
        for i, values in enumerate(array[:, :_MAX_SERIES].T.tolist())
    ]
    return lines, f"The first {_MAX_SERIES} of {width} components are drawn." if width > _MAX_SERIES else ""


# ---- the agent's log ----


_SHOWN: Mapping[str, tuple[str, str]] = {
    "prompt": ("prompt", "Prompt"),
    "text": ("message", ""),
    "thinking": ("message", "Thinking"),
    "result": ("result", "Result"),
    "stdout": ("output", ""),
    "stderr": ("stderr", ""),
}
"""Kind and title of an entry, by the kind of its part."""
_ENDS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "result": ("Turn ended", ("subtype",)),
    "log_full": ("log_full", ("text", "message")),
    "error": ("error", ("text", "message")),
}
"""Title of an entry, and the fields of which the first that is not empty is its text, by the type of a note."""


def _messages(at: int, line: bytes) -> Iterator[LogMessage]:
    told = (entry for value in objects([line]) for part in parts(value) for entry in _told(part))
    for number, (kind, title, text) in enumerate(told):
        if text.strip() or title:
            yield LogMessage(at=at + number, kind=kind, title=title[:200], text=_cut(text.strip()))


def _told(part: LogPart) -> Iterator[tuple[str, str, str]]:
    if part.kind == "call":
        yield "tool", part.name or "tool", _plain(part.value)
    elif part.kind != "note":
        yield *_SHOWN[part.kind], _plain(part.value)
    elif part.name in _ENDS:
        title, fields = _ENDS[part.name]
        yield "ended", title, _plain(next((part.value[name] for name in fields if part.value.get(name)), ""))


def _plain(value: object) -> str:
    """A tool's input or output as text: strings as they are, one name a line."""
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        if value.get("type") == "text":
            return str(value.get("text", ""))
        return "\n".join(f"{name}: {_plain(inner)}" for name, inner in value.items())
    if isinstance(value, list):
        return "\n".join(_plain(inner) for inner in value)
    return "" if value is None else str(value)


def _cut(text: str) -> str:
    more = len(text) - _MAX_LINE
    return text if more <= 0 else f"{text[:_MAX_LINE]} … ({more:,} more characters)"


_NOT_SHOWN = frozenset({"event", "level", "timestamp", "exception", "exc_info", "run", "stimulus"})


_EVENTS = {
    "submit accepted": "{submit} accepted: {n_episodes} episodes",
    "submit committed": "{submit} ended: {status}",
    "agent ended": "The agent ended: {reason}",
    "run closed": "The run was closed: {reason}",
}
"""Frequent events in words, by their names in the log."""


def _event(entry: dict[str, object]) -> Happened:
    name = str(entry.get("event", ""))[:1000]
    values = {
        each: _cut(_plain(value))[:500]
        for each, value in entry.items()
        if each not in _NOT_SHOWN and value not in ("", None)
    }
    text, form = name, _EVENTS.get(name, "")
    used = {field for _, field, _, _ in Formatter().parse(form) if field}
    if form and used <= values.keys():
        text = form.format(**{each: in_words(values.pop(each)) for each in used})
    at = str(entry.get("timestamp", ""))[:19].replace("T", " ")
    return Happened(at=at, level=str(entry.get("level", ""))[:20], text=event_text(text, values))
