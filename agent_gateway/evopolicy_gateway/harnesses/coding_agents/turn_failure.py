"""Kinds of failed turns, and their consequences: rules without I/O.

- `passing`: a crash, a timeout, or an error of the provider that a retry may resolve.
- `quota`: the account's limit is reached; only time helps, so the run pauses until the stated time.
- `lost`: the CLI no longer knows the session; a new one is started.
- `final`: a retry would fail in the same way (a wrong key, an unknown model, an account without money): the run ends.
- `faulty`: the model called its tools wrongly or repeated itself, again and again; after two such turns in a row the
  run ends.
- `cap`: the run has used up its limit of tokens or money.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from datetime import datetime
from typing import Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import msgspec

Kind = Literal["passing", "quota", "lost", "final", "faulty", "cap"]

MAX_BACKOFF_S = 300.0
_MAX_MESSAGE = 500
_MAX_SEARCHED = 20_000
"""Characters of a message that are searched for a waiting time."""

_FAULTY = re.compile(r"\d+ (faulty answers|times) in a row")
_LOST = re.compile(r"no conversation found|no rollout found|session not found", re.IGNORECASE)
_QUOTA = re.compile(
    r"usage[ _]limit|insufficient_quota|exceeded your current quota|credit balance|billing|(hit|reached) your [\w"
    r" ]*limit"
    r"|weekly limit|quota exceeded|out of credits",
    re.IGNORECASE,
)
_EMPTY = re.compile(
    r"insufficient[_ ](quota|balance)|exceeded your current quota|credit balance|billing|out of credits",
    re.IGNORECASE,
)
"""Of an account without money, which no time brings."""
_FINAL = re.compile(
    r"invalid (api|x-api) ?-?key|failed to authenticate|not logged in|please run /login|invalid bearer"
    r"|model_not_found|model [^\n]{0,80}(does not exist|not supported|not exist)|issue with the selected model"
    r"|unexpected argument|unknown option|error loading config",
    re.IGNORECASE,
)
_STATUS = re.compile(r"(?:status:?|API Error:?|HTTP)\D{0,3}(\d{3})\b|\((\d{3})\)", re.IGNORECASE)
_PROVIDER = re.compile(
    r"overloaded|rate.?limit|time[d ]*.?out|stream (disconnected|error)|connect|ECONN|ENOTFOUND|reset by"
    r" peer|unavailable"
    r"|high demand|server error|too many requests|at capacity|network|dns",
    re.IGNORECASE,
)
_IN = re.compile(
    r"(?:try again|resets?|retry)[^\d\n]{0,20}in ((?:\d+(?:\.\d+)?\s*[a-z]+[ ,and]*)+)", re.IGNORECASE
)
_PART = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z]+)", re.IGNORECASE)
_RESETS_IN = re.compile(r"resets_in_seconds\W{1,4}(\d+)")
_EPOCH = re.compile(r"(?:\||resets_at\W{1,4})(\d{10})\b")
_ISO = re.compile(r"\b20\d\d-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:\.\d{1,6})?)?(?: ?(?:Z|[+-]\d\d:?\d\d))?")
_CLOCK = re.compile(
    r"(?:resets?|again|until|available)[^\d\n]{0,20}\b(\d{1,2})(?::(\d\d))?(?::\d\d)? ?([ap]m)?\b"
    r"(?: ?\(?([A-Z][\w/+-]*))?",
    re.IGNORECASE,
)
"""A time of the day, with its zone; the machine's own without."""
_UNITS = {"ms": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


class TurnFailure(msgspec.Struct, frozen=True, kw_only=True):
    kind: Kind
    message: str
    provider: bool = False
    """Whether the provider caused it; False for a crash of the CLI."""
    wait_s: float | None = None
    """Seconds until the next attempt, if the provider stated them."""


def turn_failure_of(message: str, status: int | None = None, now: float | None = None) -> TurnFailure:
    """Classifies an error by its text, and by its HTTP status if known separately. `now`: Unix time, seconds."""
    text = " ".join(message.split())[:_MAX_MESSAGE] or "no message"
    match = _STATUS.search(text)
    code = status if status is not None else int(match.group(1) or match.group(2)) if match else None
    if _FAULTY.match(text):
        return TurnFailure(kind="faulty", message=text)
    if _LOST.search(text):
        return TurnFailure(kind="lost", message=text)
    if code in (401, 403) or _FINAL.search(text):
        return TurnFailure(kind="final", message=text, provider=True)
    wait_s = _wait_in(message[:_MAX_SEARCHED], time.time() if now is None else now)
    if code == 402 or _QUOTA.search(text):
        kind: Kind = "final" if wait_s is None and (code == 402 or _EMPTY.search(text)) else "quota"
        return TurnFailure(kind=kind, message=text, provider=True, wait_s=wait_s)
    if code is not None and 400 <= code < 500 and code not in (408, 409, 425, 429):
        return TurnFailure(kind="final", message=text, provider=True)
    provider = code is not None or _PROVIDER.search(text) is not None
    return TurnFailure(kind="passing", message=text, provider=provider, wait_s=wait_s)


def with_last_errors(message: str, errors: Sequence[str]) -> TurnFailure:
    """The failure of a program that broke off its turn: of the kind that its last lines on stderr tell, if any."""
    last = " | ".join(line for line in errors[-3:] if line)
    if not last:
        return TurnFailure(kind="passing", message=message)
    return msgspec.structs.replace(turn_failure_of(last), message=f"{message}: {last}"[:1000])


def backoff_s(attempt: int, base_s: float, chance: float) -> float:
    """Seconds before retry `attempt` (from 1): base · 2^(attempt − 1), times 0.75 to 1.25 by `chance` in [0, 1).

    At most `MAX_BACKOFF_S`."""
    whole = base_s * 2.0 ** min(attempt - 1, 16)
    return min(MAX_BACKOFF_S, float(whole) * (0.75 + 0.5 * chance))


def _wait_in(text: str, now: float) -> float | None:
    """The waiting time stated in the text, seconds, finite; None if there is none."""
    if (seconds := _RESETS_IN.search(text)) is not None:
        wait_s = float(seconds.group(1))
    elif (epoch := _EPOCH.search(text)) is not None:
        wait_s = max(0.0, float(epoch.group(1)) - now)
    elif (match := _IN.search(text)) is not None:
        parts = _PART.findall(match.group(1).lower())
        units = ("ms" if unit.startswith("ms") else unit[0] for _, unit in parts)
        wait_s = sum(float(part) * _UNITS.get(one, 0.0) for (part, _), one in zip(parts, units, strict=True))
        wait_s = wait_s or math.inf  # no known unit
    else:
        return _until_in(text, now)
    return wait_s if math.isfinite(wait_s) else None


def _until_in(text: str, now: float) -> float | None:
    """Seconds to the date or the time of the day in the text."""
    try:
        if (iso := _ISO.search(text)) is not None:
            return max(0.0, datetime.fromisoformat(iso[0].replace(" Z", "Z")).timestamp() - now)
        clock = _CLOCK.search(text)
        if clock is None or not (clock[2] or clock[3]):
            return None
        half = 12 * (clock[3].lower() == "pm") if clock[3] else 0
        hour = int(clock[1]) % 12 + half if clock[3] else int(clock[1])
        here = datetime.fromtimestamp(now, ZoneInfo(clock[4]) if clock[4] else None)
        at = here.replace(hour=hour, minute=int(clock[2] or 0), second=0, microsecond=0)
        return (at - here).total_seconds() % 86400.0
    except (ValueError, OverflowError, ZoneInfoNotFoundError):
        return None
