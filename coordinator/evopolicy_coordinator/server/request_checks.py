"""Checks of a request by itself, without the store or the core. They raise RefusedError when a check fails."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from typing import get_args

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import gateway, worker
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import LARGEST_LIMIT, LARGEST_LIMITS, BlobRef, ResourceLimits, Tier
from evopolicy_common.processes.packages import POLICY
from evopolicy_common.records.blobs import BlobStore, digest_of, is_digest
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


def require(holds: bool, status: Refusal, text: str) -> None:
    """Raises RefusedError unless the condition holds."""
    if not holds:
        raise RefusedError(status, text)


def check_limits(limits: ResourceLimits) -> None:
    """Checks that every limit is a finite number above zero and at most its storable maximum."""
    for name in limits.__struct_fields__:
        value = getattr(limits, name)
        most = LARGEST_LIMITS.get(name, LARGEST_LIMIT)
        text = f"limit {name} is {value}; it must be above 0 and at most {most:,}"
        require(value is None or 0 < value <= most, Refusal.INVALID_SETTINGS, text)


def check_job(cases: Sequence[Case], n: int) -> None:
    """Checks that `n` episodes on these cases fit into one lease, as policy scope `submit` requires."""
    size = n * (max((len(msgspec.msgpack.encode(case)) for case in cases), default=0) + 200)
    require(
        size <= MAX_JOB_BYTES,
        Refusal.INVALID_SETTINGS,
        f"with policy scope submit {n} episodes go to a worker at once, here {size:,} bytes; {MAX_JOB_BYTES:,} are"
        " the limit: allow fewer episodes a submit, or shorten the cases' options",
    )


def bounded_close(message: gateway.CloseRun) -> gateway.CloseRun:
    """The message with a reason and an agent's description that fit into the finished run's message.

    Never refuses: a run must close in any case.
    """
    agent = message.agent
    size = len(msgspec.msgpack.encode(agent))
    if size > MAX_AGENT_BYTES:
        agent = {"left_out": f"{size:,} bytes; {MAX_AGENT_BYTES:,} are the limit"}
    return msgspec.structs.replace(message, reason=message.reason[:MAX_REASON], agent=agent)


def check_stored(blobs: BlobStore, ref: BlobRef) -> None:
    """Checks that the blob is stored, with the announced size."""
    text = f"blob {ref.digest[:64]!r} is not stored here; upload it first"
    size = blobs.hold(ref.digest) if is_digest(ref.digest) else None
    if size is None:
        raise RefusedError(Refusal.MISSING_BLOB, text)
    text = f"blob {ref.digest} has {size:,} bytes, and not {ref.size:,} as announced"
    require(size == ref.size, Refusal.BAD_BLOB, text)


def check_bundle(blobs: BlobStore, digest: str | None, *, sent: bool = True) -> None:
    """Checks that the bundle is stored, and that the sender uploaded it (`sent`)."""
    if digest is not None:
        text = f"bundle {digest[:64]!r} is not stored here; upload it first"
        stored = sent and is_digest(digest) and blobs.hold(digest) is not None
        require(stored, Refusal.MISSING_BUNDLE, text)


def check_token(expected: str, given: str) -> None:
    """Compares the token with the expected one, in constant time."""
    text = "invalid token, or unknown run, worker or evaluation; see the credentials file"
    require(hmac.compare_digest(expected.encode(), given.encode()), Refusal.BAD_TOKEN, text)


def check_idempotency_key(key: str) -> None:
    """Checks the key's length, and that PostgreSQL can store it."""
    text = f"an idempotency key has 1 to {_MAX_NAME} characters, not {len(key)}, and none is NUL"
    require(1 <= len(key) <= _MAX_NAME and "\0" not in key, Refusal.BAD_MESSAGE, text)


def check_registration(message: worker.Register) -> None:
    """Checks that the worker speaks this protocol, under a name that is valid in a key expression."""
    require(
        message.protocol == codec.WIRE_VERSION,
        Refusal.WRONG_PROTOCOL,
        f"worker speaks wire version {message.protocol}, the coordinator {codec.WIRE_VERSION}: install the same"
        " version of evopolicy on both",
    )
    text = f"worker name {message.worker[:80]!r}: letters, digits, '.', '_', '-', at most 63"
    require(keys.valid_name(message.worker), Refusal.BAD_NAME, text)
    text = f"{message.slots} slots: a worker has 1 to 4096"
    require(1 <= message.slots <= 4096, Refusal.BAD_MESSAGE, text)
    size = len(msgspec.msgpack.encode(message.fingerprint))
    text = f"the worker's fingerprint takes {size:,} bytes; {MAX_FINGERPRINT_BYTES:,} are the limit"
    require(size <= MAX_FINGERPRINT_BYTES, Refusal.BAD_MESSAGE, text)
    failed = message.failed_environments
    n = len(message.environments) + len(message.undescribed) + len(failed)
    valid = n <= MAX_ENVIRONMENTS and all(map(catalogue.valid_id, (*message.undescribed, *failed)))
    text = f"{n:,} environments; {MAX_ENVIRONMENTS:,} with valid ids are the limit"
    require(valid, Refusal.BAD_MESSAGE, text)
    size = sum(map(len, failed.values()))
    most = worker.REASON_CHARACTERS
    text = (
        f"the reasons of failed environments have {size:,} characters; {most['environments']:,} are the limit"
    )
    require(size <= most["environments"], Refusal.BAD_MESSAGE, text)
    tiers = message.missing_tiers
    require(
        tiers.keys() <= set(get_args(Tier)) and all(len(why) <= most["tier"] for why in tiers.values()),
        Refusal.BAD_MESSAGE,
        f"missing tiers {str(list(tiers))[:64]}: tiers are {', '.join(get_args(Tier))}, a reason has at most"
        f" {most['tier']} characters",
    )
    check_place(message.boot_id, message.host, message.installation)


def check_packages(message: worker.Register, allowed: tuple[str, ...]) -> None:
    """Checks that the worker's policies may import what the coordinator tells agents, no less and no more."""
    wanted = ",".join(sorted(set(allowed) - {"numpy"}))
    offered = message.fingerprint.packages.get(POLICY, "")
    options = " ".join(f"--policy-package {name}" for name in wanted.split(",") if name)
    require(
        offered == wanted,
        Refusal.BAD_SETTINGS,
        f"on this worker policies may import {offered or 'no package'} besides numpy, in this cluster"
        f" {wanted or 'none'}: start the worker "
        + (f"with {options}" if options else "without --policy-package"),
    )


def check_place(boot_id: str, host: str, installation: str = "") -> None:
    """Checks the lengths of a boot id, a host name and an installation's name."""
    for name, value in {"boot id": boot_id, "host name": host, "installation": installation}.items():
        text = f"{name} {value[:64]!r}: at most {_MAX_NAME} printable characters"
        require(len(value) <= _MAX_NAME and value.isprintable(), Refusal.BAD_MESSAGE, text)


def check_begun(blobs: BlobStore, ref: BlobRef) -> None:
    """Checks that the actions that a job resumes from are bounded, fit into a lease, and are there."""
    check_inline(ref)
    most, inline = codec.MAX_PACKED_BYTES, codec.INLINE_BEGUN_BYTES
    require(
        0 < ref.size <= most and len(ref.inline or b"") <= inline,
        Refusal.BAD_BLOB,
        f"the recorded actions that a job resumes from take {ref.size:,} bytes; {most:,} are the limit, and"
        f" inside a message {inline:,}",
    )
    if ref.inline is None:
        check_stored(blobs, ref)


def check_inline(ref: BlobRef | None) -> None:
    """Checks that inline bytes match the blob reference's digest and size."""
    if ref is not None and ref.inline is not None:
        matches = len(ref.inline) == ref.size and digest_of(ref.inline) == ref.digest
        text = f"inline bytes are not blob {ref.digest[:64]!r} of {ref.size} bytes"
        require(matches, Refusal.BAD_BLOB, text)
