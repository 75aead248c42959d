"""Removes unpublishable data from records, and searches for it in all other files. Pure.

A record keeps the fields that this module lists; all other fields are removed and named. If the search finds a term of
this machine in a file that may be omitted (a policy, recorded actions), the whole file is omitted; otherwise nothing is
published. A secret in any file stops the publication (`collect`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping

import msgspec

from evopolicy_common.records import secrets
from evopolicy_common.records.run_record import PUBLISHED_SETTINGS, Artifacts, RunRecord
from evopolicy_common.records.secrets import Passed
from evopolicy_results.publish.contents import Removed

_MIN_NEEDLE = 4
_SYSTEM_PATH = re.compile("/(?:usr|bin|sbin|lib|opt|etc|dev|proc|sys|var|run|snap)")
_PLAIN_VARIABLES = re.compile(
    r"(LANG|LANGUAGE|LC_.*|TERM|COLORTERM|SHELL|TZ|PYTHON.*|PYTEST_.*|XDG_.*_TYPE|SHLVL|PAGER|EDITOR|LESS.*|LS_COLORS|DEBIAN_FRONTEND|OMP_.*|MKL_.*|CUDA_.*)"
)
_NOBODY = frozenset(
    {"root", "user", "admin", "ubuntu", "debian", "runner", "nobody", "localhost", "evopolicy"}
)
"""Names that identify nobody."""
_HOME = re.compile(rb"/(?:home|Users)/[A-Za-z0-9._-]+")


class Needle(msgspec.Struct, frozen=True):
    """A text that must not be found."""

    text: bytes
    what: str
    """The kind of the match, without its text."""


def record(full: RunRecord) -> tuple[RunRecord, list[Removed]]:
    """The part of a `run.json` that is published, and what was left out."""
    settings = {name: each for name, each in full.agent.settings.items() if name in PUBLISHED_SETTINGS}
    removed = {
        f"agent.settings.{name}": "may name paths and commands of a machine"
        for name in sorted(full.agent.settings.keys() - settings.keys())
    }
    outcome, versions, replace = full.outcome, full.versions, msgspec.structs.replace
    for name, is_there, why in (
        ("versions.fingerprint_overrides", versions.fingerprint_overrides, "an operator's own words"),
        ("outcome.error", outcome.error is not None, "may name paths and hosts"),
        ("rejected_submits.message", full.rejected_submits, "free text"),
        ("artifacts", full.artifacts != Artifacts(), "names folders"),
        ("replays", full.replays, "videos are not published"),
    ):
        if is_there:
            removed[name] = why
    kept = replace(
        full,
        agent=replace(full.agent, settings=settings),
        outcome=replace(
            outcome,
            error=None if outcome.error is None else "left out",
        ),
        rejected_submits=tuple(replace(each, message="") for each in full.rejected_submits),
        artifacts=Artifacts(),
        replays=(),
        versions=replace(
            versions, fingerprint_overrides=tuple("left out" for _ in versions.fingerprint_overrides)
        ),
    )
    return kept, [Removed(what=what, why=why) for what, why in removed.items()]


def needles(
    variables: Mapping[str, str], names: Mapping[str, str], paths: Iterable[str], secrets: Iterable[str]
) -> tuple[Needle, ...]:
    """The search terms: values of environment variables, names of users and hosts (each with its kind), folders,
    secrets."""
    kinds: dict[bytes, str] = {}

    def add(text: str, what: str, least: int) -> None:
        if len(text) >= least and text.casefold() not in _NOBODY:
            kinds.setdefault(text.encode("utf-8", "surrogateescape"), what)
            # As JSON spells it, in a log of JSON lines.
            kinds.setdefault(json.dumps(text)[1:-1].encode("ascii"), what)

    for secret in secrets:
        add(secret, "a token or password of the cluster", _MIN_NEEDLE)
    for path in paths:
        if path.count("/") > 1 and not _SYSTEM_PATH.match(path):
            add(path, "a folder of the publishing machine", 6)
    for name, what in names.items():
        add(name, what, 3)
    for name, value in variables.items():
        if _PLAIN_VARIABLES.fullmatch(name):
            continue
        for part in value.split(":") if "/" in value else (value,):
            if part.startswith("/") and (part.count("/") < 2 or _SYSTEM_PATH.match(part)):
                continue
            add(part, f"the value of the environment variable {name}", 8)
    return tuple(Needle(text, what) for text, what in sorted(kinds.items()))


def search(data: bytes, needles: Iterable[Needle]) -> list[str]:
    """The kinds of terms of this machine in `data`, without their texts; a name counts only if no letter or digit
    adjoins it."""
    kinds = ["a home folder"] if _HOME.search(data) else []
    return kinds + [each.what for each in needles if next(_places(data, each.text), None) is not None]


def secret_lines(data: bytes, passed: Passed | None) -> dict[int, str]:
    """The lines with a secret, counted from 1, each with the kind of its first one."""
    lines: dict[int, str] = {}
    line, counted = 1, 0
    for at, what in sorted(secrets.positions(data, passed)):
        line, counted = line + data.count(b"\n", counted, at), at
        lines.setdefault(line, what)
    return lines


REDACTED = b"[removed]"


def redact(
    data: bytes, needles: Iterable[Needle], passed: Passed | None = None
) -> tuple[bytes, dict[str, int]]:
    """`data` with every match of the searches replaced, and the number of replacements by kind."""
    counts: dict[str, int] = {}
    if passed is not None:
        data, counts[secrets.PASSED_VALUE] = secrets.replaced(data, passed.places(data), REDACTED)
    for pattern, what in ((_HOME, "a home folder"), *secrets.patterns(data)):
        data, counts[what] = pattern.subn(REDACTED, data)
    # The longest first: a folder's path may begin with another's.
    for needle in sorted(needles, key=lambda needle: -len(needle.text)):
        places = [(at, at + len(needle.text)) for at in _places(data, needle.text)]
        data, n = secrets.replaced(data, places, REDACTED)
        counts[needle.what] = counts.get(needle.what, 0) + n
    return data, {what: n for what, n in counts.items() if n}


_ESCAPES = (rb"\n", rb"\t", rb"\r", rb"\b", rb"\f")


def _places(data: bytes, text: bytes) -> Iterator[int]:
    """Positions of `text` in `data` without an adjoining letter or digit; they do not overlap."""
    at = data.find(text)
    while at >= 0:
        end = at + len(text)
        # A folder's path may follow any letter. In JSON, `\\n` before a name is a line's end, no letter.
        before = data[max(0, at - 1) : at] if text[:1].isalnum() else b""
        is_escape = data[max(0, at - 2) : at] in _ESCAPES
        is_whole = (is_escape or not before.isalnum()) and not data[end : end + 1].isalnum()
        if is_whole:
            yield at
        at = data.find(text, end if is_whole else at + 1)
