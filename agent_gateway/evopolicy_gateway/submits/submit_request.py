"""Strict parsing of the body of `POST /submit`; pure. Unknown fields are ignored, as published.

Two statuses, both without charge:

- `budget_invalid`: the request's form (JSON, keys, type of `env_instances`, size of the body) or its number of episodes
  (none, too few, too many for one submit, more than remain);
- `invalid_env_instance`: a single id or range (not an integer, outside the train cases, backwards, unreadable).

Order and repeats are kept. Ranges are checked against the train ids and counted before they are expanded, so no text
produces more ids than a submit may hold.
"""

from __future__ import annotations

import re
from typing import NoReturn

import msgspec
import orjson

from evopolicy_common.errors import RequestError

MAX_BODY_BYTES = 1 << 20
"""A longer body is refused unread."""

_FIELD = "env_instances"
_PART = re.compile(r"\s*([0-9]{1,18})\s*(?:-\s*([0-9]{1,18})\s*)?", re.ASCII)
_FORM = '{"env_instances": [0, 1, 1, 7]} or {"env_instances": "0-3,7"}'


class Bounds(msgspec.Struct, frozen=True, kw_only=True):
    n_env_instances: int
    """Train ids are 0 … n − 1."""
    min_episodes: int
    max_episodes: int
    remaining_budget: int

    @property
    def least(self) -> int:
        """Number of episodes that the next submit must have."""
        return max(1, self.min_episodes)

    @property
    def most(self) -> int:
        """Greatest number that it may have."""
        return min(self.max_episodes, self.remaining_budget)


def parse(body: bytes, bounds: Bounds) -> tuple[int, ...]:
    """Returns the requested train ids in order. Raises RequestError with one of the two statuses and the remedy."""
    if len(body) > MAX_BODY_BYTES:
        refuse_size(len(body))
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        _budget(f"the body is not JSON ({error}); send {_FORM}")
    if not isinstance(document, dict):
        _budget(f"the body is {_kind(document)}; send an object: {_FORM}")
    if _FIELD not in document:
        _budget(f"the body has no {_FIELD!r}; send {_FORM}")
    wanted = document[_FIELD]
    if isinstance(wanted, list):
        if len(wanted) > bounds.max_episodes:
            _refuse_count(len(wanted), bounds)
        for index, item in enumerate(wanted):
            where = f"{_FIELD}[{index}]"
            if type(item) is not int:
                last = bounds.n_env_instances - 1
                _instance(f"{where} is {_kind(item)}; every id is an integer from 0 to {last}")
            _check_id(item, where, bounds)
        ids = tuple(wanted)
    elif isinstance(wanted, str):
        ids = ids_in(wanted, bounds)
    else:
        _budget(f"{_FIELD} is {_kind(wanted)}; send a list of train ids or a text of ranges: {_FORM}")
    if bounds.remaining_budget < bounds.min_episodes:
        _budget(
            f"{bounds.remaining_budget} episodes remain and a submit needs at least {bounds.min_episodes}:"
            " the budget is spent, no more submits are taken"
        )
    if not bounds.least <= len(ids) <= bounds.most:
        _refuse_count(len(ids), bounds)
    return ids


def refuse_size(n_bytes: int | None) -> NoReturn:
    """Raises RequestError for a body that is too long; `n_bytes` None when its length is unknown."""
    size = f"{n_bytes:,} bytes" if n_bytes is not None else "longer"
    _budget(f"the request's body is {size}; at most {MAX_BODY_BYTES:,} bytes are read. Send {_FORM}")


def ids_in(text: str, bounds: Bounds) -> tuple[int, ...]:
    """Expands a text of ids and ranges, at most `bounds.max_episodes` ids, none if it is empty. Raises RequestError."""
    if not text.strip():
        return ()
    ranges: list[range] = []
    for part in text.split(","):
        match = _PART.fullmatch(part)
        if match is None:
            _instance(
                f"{part[:40]!r} in {_FIELD} is neither an id nor a range; write ids and ranges as '0-3,7'"
            )
        first, last = int(match[1]), int(match[2] or match[1])
        where = f"{part.strip()[:40]!r} in {_FIELD}"
        for number in (first, last):
            _check_id(number, where, bounds)
        if last < first:
            _instance(f"{where} runs backwards; write it '{last}-{first}', or list the ids in order")
        ranges.append(range(first, last + 1))
    if (total := sum(map(len, ranges))) > bounds.max_episodes:
        _refuse_count(total, bounds)
    return tuple(number for numbers in ranges for number in numbers)


def _check_id(number: int, where: str, bounds: Bounds) -> None:
    if not 0 <= number < bounds.n_env_instances:
        value = "" if str(number) in where else f" is {number}, which"
        _instance(f"{where}{value} is outside the train ids 0 to {bounds.n_env_instances - 1}")


def _refuse_count(n: int, bounds: Bounds) -> NoReturn:
    _budget(
        f"{n} episodes asked for; this submit may have {bounds.least} to {bounds.most}"
        f" ({bounds.max_episodes} at once, {bounds.remaining_budget} of the budget remain)"
    )


def _kind(value: object) -> str:
    return _KINDS.get(type(value), "something else")


_KINDS: dict[type, str] = {
    dict: "an object",
    list: "a list",
    str: "a text",
    bool: "true or false",
    int: "a number",
    float: "a number with a fraction or out of range",
    type(None): "null",
}


def _budget(message: str) -> NoReturn:
    raise RequestError("budget_invalid", message)


def _instance(message: str) -> NoReturn:
    raise RequestError("invalid_env_instance", message)
