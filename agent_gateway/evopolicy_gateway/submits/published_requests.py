"""The published service's reading of `POST /submit` (v0.1.0) where it differs from ours, and its answers as a table.
They apply in the published profiles.

A request that counts takes the next submit index and raises `n_submits`, without a charge. Its folder, if it has one,
holds `summary.json` and `errors.txt`. Where the published handler drops the connection, a 400 says why.
"""

from __future__ import annotations

import re
from typing import Any, Literal, NamedTuple, NoReturn

import orjson

from evopolicy_common.errors import RequestError
from evopolicy_common.messages.gateway import RejectedStatus
from evopolicy_gateway.submits.submit_request import Bounds

_PART = re.compile(r"\s*([0-9]{1,18})(?:-([0-9]{1,18}))?\s*", re.ASCII)
_MAX_SHOWN = 10_000
"""A rejected request for more ids is shown without them in its summary."""


class Answer(NamedTuple):
    """The answer to a kind of request that plays nothing."""

    status: Literal["bad_request"] | RejectedStatus
    counts: bool
    folder: bool


UNREADABLE = Answer("bad_request", counts=False, folder=False)
MALFORMED = Answer("budget_invalid", counts=True, folder=False)
NO_CASE = Answer("invalid_env_instance", counts=True, folder=True)
WRONG_NUMBER = Answer("budget_invalid", counts=True, folder=True)


class OddRequestError(RequestError):
    """A request that plays nothing; `answer` describes the answer, `ids` the train ids that it asked for."""

    def __init__(self, answer: Answer, message: str, ids: tuple[int, ...] = ()) -> None:
        super().__init__(answer.status, message)
        self.answer = answer
        self.ids = ids


class Asked(NamedTuple):
    """The ids of a well-formed request, in order, repeats kept."""

    ids: tuple[int, ...]
    """`true` and `false` in a list stay what they are; empty for ranges of more than `_MAX_SHOWN` ids."""
    n: int
    largest: int


def read(body: bytes) -> Asked:
    """The ids in a request's body. Raises OddRequestError for one that is not well-formed."""
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        _refuse(UNREADABLE, f"the body is not JSON: {error}")
    if not isinstance(document, dict) or "env_instances" not in document:
        _refuse(UNREADABLE, 'send an object with the field "env_instances"')
    value = document["env_instances"]
    if not isinstance(value, list | str):
        _refuse(UNREADABLE, "env_instances must be a list of train ids, or a text of ranges")
    return _listed(value) if isinstance(value, list) else _ranges(value)


def _listed(value: list[Any]) -> Asked:
    for item in value:
        if not isinstance(item, int) or item < 0:
            _refuse(MALFORMED, f"{str(item)[:40]!r} in env_instances is not a train id")
    return Asked(tuple(value), len(value), max(map(int, value), default=-1))


def _ranges(value: str) -> Asked:
    ranges = []
    for part in value.split(","):
        match = _PART.fullmatch(part)
        if match is None or (match[2] is not None and int(match[2]) < int(match[1])):
            _refuse(MALFORMED, f"{part[:40]!r} in env_instances is neither a train id nor a range")
        ranges.append(range(int(match[1]), int(match[2] or match[1]) + 1))
    n = sum(map(len, ranges))
    ids = tuple(number for each in ranges for number in each) if n <= _MAX_SHOWN else ()
    return Asked(ids, n, max(each[-1] for each in ranges))


def check(asked: Asked, bounds: Bounds) -> tuple[int, ...]:
    """The ids of a request within the bounds. Raises OddRequestError for any other; ids are checked first."""
    if asked.largest >= bounds.n_env_instances:
        text = f"train id {asked.largest} is outside 0 to {bounds.n_env_instances - 1}"
        raise OddRequestError(NO_CASE, text, asked.ids)
    if not bounds.least <= asked.n <= bounds.most:
        text = f"{asked.n} episodes asked for; this submit may have {bounds.least} to {bounds.most}"
        raise OddRequestError(WRONG_NUMBER, text, asked.ids)
    return asked.ids


def _refuse(answer: Answer, message: str) -> NoReturn:
    raise OddRequestError(answer, message)
