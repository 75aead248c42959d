"""Checks of a request by itself, without the store or the core. They raise RefusedError when a check fails."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from typing import Any, get_args

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import worker
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, BlobRef, ResourceLimits, Tier
from evopolicy_common.processes.packages import POLICY
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.refusals import Refusal
from evopolicy_common.wire import codec, keys

MAX_COUNT = 2**31 - 1
MAX_JOB_BYTES = 8 << 20
MAX_AGENT_BYTES = 256 << 10
MAX_REASON = 200
"""Characters of a run's close reason."""
MAX_FINGERPRINT_BYTES = 64 << 10
"""Every finished run's message has one."""
MAX_ENVIRONMENTS = 10_000
"""Of one worker. The status for operators lists them."""
_MAX_WAIT_S = 60.0
_MAX_NAME = 200


def finite_wait(seconds: float) -> float:
    """Bounds a long poll's wait to 0–60 s; NaN, which decodes, becomes 0."""
    return min(seconds, _MAX_WAIT_S) if seconds > 0 else 0.0


def finite_cursor(cursor: int) -> int:
    """Bounds a cursor to the range that can be stored."""
    return min(max(0, cursor), MAX_COUNT)


def check_limits(limits: ResourceLimits) -> None:
    """Checks that every limit is a finite number above zero and at most its storable maximum."""
    for name in limits.__struct_fields__:
        value = getattr(limits, name)
        most = LARGEST_LIMITS.get(name, LARGEST_LIMIT)
        if value is not None and not 0 < value <= most:
            raise RefusedError(
                Refusal.INVALID_SETTINGS, f"limit {name} is {value}; it must be above 0 and at most {most:,}"
            )


def check_job(cases: Sequence[Case], n: int) -> None:
    """Checks that `n` episodes on these cases fit into one lease, as policy scope `submit` requires."""
    longest = max((len(msgspec.msgpack.encode(case)) for case in cases), default=0)
    if n * (longest + 200) > MAX_JOB_BYTES:
        raise RefusedError(
            Refusal.INVALID_SETTINGS,
            f"with policy scope submit {n} episodes go to a worker at once, here {n * (longest + 200):,} bytes;"
            f" {MAX_JOB_BYTES:,} are the limit: allow fewer episodes a submit, or shorten the cases' options",
        )


def bounded_agent(agent: dict[str, Any]) -> dict[str, Any]:
    """The gateway's description of its agent, replaced by a note when too large for a finished run's message.

    Never refuses: a run must close in any case.
    """
    size = len(msgspec.msgpack.encode(agent))
    if size <= MAX_AGENT_BYTES:
        return agent
    return {"left_out": f"{size:,} bytes; {MAX_AGENT_BYTES:,} are the limit"}


def check_token(expected: str, given: str) -> None:
    """Compares the token with the expected one, in constant time."""
    if not hmac.compare_digest(expected.encode(), given.encode()):
        raise RefusedError(
            Refusal.BAD_TOKEN, "invalid token, or unknown run, worker or evaluation; see the credentials file"
        )


def check_key(tail: str, expected: str) -> None:
    """Checks that the message came on the key of its kind."""
    if tail != expected:
        raise RefusedError(Refusal.WRONG_KEY, f"this message belongs on {expected!r}, not on {tail!r}")


def check_idempotency_key(key: str) -> None:
    """Checks the key's length."""
    if not 1 <= len(key) <= _MAX_NAME:
        raise RefusedError(
            Refusal.BAD_MESSAGE, f"an idempotency key has 1 to {_MAX_NAME} characters, not {len(key)}"
        )


def check_registration(message: worker.Register) -> None:
    """Checks that the worker speaks this protocol, under a name that is valid in a key expression."""
    if message.protocol != codec.WIRE_VERSION:
        raise RefusedError(
            Refusal.WRONG_PROTOCOL,
            f"worker speaks wire version {message.protocol}, the coordinator {codec.WIRE_VERSION}: install the same"
            " version of evopolicy on both",
        )
    if not keys.valid_name(message.worker):
        raise RefusedError(
            Refusal.BAD_NAME,
            f"worker name {message.worker[:80]!r}: letters, digits, '.', '_', '-', at most 63",
        )
    if not 1 <= message.slots <= 4096:
        raise RefusedError(Refusal.BAD_MESSAGE, f"{message.slots} slots: a worker has 1 to 4096")
    size = len(msgspec.msgpack.encode(message.fingerprint))
    if size > MAX_FINGERPRINT_BYTES:
        raise RefusedError(
            Refusal.BAD_MESSAGE,
            f"the worker's fingerprint takes {size:,} bytes; {MAX_FINGERPRINT_BYTES:,} are the limit",
        )
    failed = message.failed_environments
    n = len(message.environments) + len(message.undescribed) + len(failed)
    if n > MAX_ENVIRONMENTS or not all(map(catalogue.valid_id, (*message.undescribed, *failed))):
        raise RefusedError(
            Refusal.BAD_MESSAGE, f"{n:,} environments; {MAX_ENVIRONMENTS:,} with valid ids are the limit"
        )
    size = sum(map(len, failed.values()))
    most = worker.REASON_CHARACTERS
    if size > most["environments"]:
        raise RefusedError(
            Refusal.BAD_MESSAGE,
            f"the reasons of failed environments have {size:,} characters; {most['environments']:,} are the limit",
        )
    tiers = message.missing_tiers
    if not tiers.keys() <= set(get_args(Tier)) or any(len(why) > most["tier"] for why in tiers.values()):
        raise RefusedError(
            Refusal.BAD_MESSAGE,
            f"missing tiers {str(list(tiers))[:64]}: tiers are {', '.join(get_args(Tier))}, a reason has at most"
            f" {most['tier']} characters",
        )
    check_place(message.boot_id, message.host, message.installation)


def check_packages(message: worker.Register, allowed: tuple[str, ...]) -> None:
    """Checks that the worker's policies may import what the coordinator tells agents, no less and no more."""
    wanted = ",".join(sorted(set(allowed) - {"numpy"}))
    offered = message.fingerprint.packages.get(POLICY, "")
    if offered != wanted:
        options = " ".join(f"--policy-package {name}" for name in wanted.split(",") if name)
        raise RefusedError(
            Refusal.BAD_SETTINGS,
            f"on this worker policies may import {offered or 'no package'} besides numpy, in this cluster"
            f" {wanted or 'none'}: start the worker "
            + (f"with {options}" if options else "without --policy-package"),
        )


def check_place(boot_id: str, host: str, installation: str = "") -> None:
    """Checks the lengths of a boot id, a host name and an installation's name."""
    places = {
        "boot id": boot_id,
        "host name": host,
        "installation": installation,
    }
    for name, value in places.items():
        if len(value) > _MAX_NAME or not value.isprintable():
            raise RefusedError(
                Refusal.BAD_MESSAGE, f"{name} {value[:64]!r}: at most {_MAX_NAME} printable characters"
            )


def check_begun(ref: BlobRef | None) -> None:
    """Checks that a job's stored start state is bounded and fits into a lease."""
    check_inline(ref)
    if ref is None:
        return
    if not 0 < ref.size <= codec.MAX_PACKED_BYTES or len(ref.inline or b"") > codec.INLINE_BEGUN_BYTES:
        raise RefusedError(
            Refusal.BAD_BLOB,
            f"the recorded actions that a job resumes from take {ref.size:,} bytes; {codec.MAX_PACKED_BYTES:,} are the"
            f" limit, and inside a message {codec.INLINE_BEGUN_BYTES:,}",
        )


def check_inline(ref: BlobRef | None) -> None:
    """Checks that inline bytes match the blob reference's digest and size."""
    if ref is None or ref.inline is None:
        return
    if len(ref.inline) != ref.size or digest_of(ref.inline) != ref.digest:
        raise RefusedError(
            Refusal.BAD_BLOB, f"inline bytes are not blob {ref.digest[:64]!r} of {ref.size} bytes"
        )
