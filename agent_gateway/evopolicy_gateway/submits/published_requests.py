"""The published service's reading of `POST /submit` (v0.1.0) where it differs from ours, for the published profiles.

A request that counts takes the next submit index and raises `n_submits`, without a charge. Its folder, if it has one,
holds `summary.json` and `errors.txt`. Where the published handler drops the connection, a 400 says why.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import orjson

from evopolicy_common.errors import RequestError
from evopolicy_common.messages.gateway import RejectedStatus
from evopolicy_common.records.open_run import Rejection
from evopolicy_gateway.submits.submit_request import Bounds

_PART = re.compile(r"\s*([0-9]{1,18})(?:-([0-9]{1,18}))?\s*", re.ASCII)
_MAX_SHOWN = 10_000
"""A rejected request for more ids is shown without them in its summary."""


class OddRequestError(RequestError):
    """A request that counts and plays nothing; it asked for `ids`."""

    def __init__(
        self, status: RejectedStatus, message: str, ids: tuple[int, ...] = (), *, folder: bool = False
    ) -> None:
        super().__init__(status, message)
        self.rejection = Rejection(status=status, message=message, folder=folder)
        self.ids = ids


class Asked(NamedTuple):
    """The ids of a well-formed request, in order, repeats kept."""

    ids: tuple[int, ...]
    """`true` and `false` in a list stay what they are; empty for ranges of more than `_MAX_SHOWN` ids."""
    n: int
    largest: int


def read(body: bytes) -> Asked:
    """The ids in a request's body. Raises RequestError for one that is not well-formed."""
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        raise RequestError("bad_request", f"the body is not JSON: {error}") from error
    if not isinstance(document, dict) or "env_instances" not in document:
        raise RequestError("bad_request", 'send an object with the field "env_instances"')
    value = document["env_instances"]
    if isinstance(value, list):
        for item in value:
            if not isinstance(item, int) or item < 0:
                text = f"{str(item)[:40]!r} in env_instances is not a train id"
                raise OddRequestError("budget_invalid", text)
        return Asked(tuple(value), len(value), max(map(int, value), default=-1))
    if not isinstance(value, str):
        text = "env_instances must be a list of train ids, or a text of ranges"
        raise RequestError("bad_request", text)
    ranges = []
    for part in value.split(","):
        match = _PART.fullmatch(part)
        if match is None or (match[2] is not None and int(match[2]) < int(match[1])):
            text = f"{part[:40]!r} in env_instances is neither a train id nor a range"
            raise OddRequestError("budget_invalid", text)
        ranges.append(range(int(match[1]), int(match[2] or match[1]) + 1))
    n = sum(map(len, ranges))
    ids = tuple(number for each in ranges for number in each) if n <= _MAX_SHOWN else ()
    return Asked(ids, n, max(each[-1] for each in ranges))


def check(asked: Asked, bounds: Bounds) -> tuple[int, ...]:
    """The ids of a request within the bounds. Raises OddRequestError for any other; ids are checked first."""
    if asked.largest >= bounds.n_env_instances:
        text = f"train id {asked.largest} is outside 0 to {bounds.n_env_instances - 1}"
        raise OddRequestError("invalid_env_instance", text, asked.ids, folder=True)
    if not bounds.least <= asked.n <= bounds.most:
        text = f"{asked.n} episodes asked for; this submit may have {bounds.least} to {bounds.most}"
        raise OddRequestError("budget_invalid", text, asked.ids, folder=True)
    return asked.ids
