"""Workers that were refused, as status tells them."""

from __future__ import annotations

from evopolicy_common.messages.worker import Fingerprint, LeaseRequest, Refused, Register, Registered
from evopolicy_common.wire import codec
from evopolicy_coordinator.server.refused_workers import KEPT, KEPT_S, RefusedWorkers

KEY = "evopolicy/v1/c/work/register"
REFUSED = Refused(status="wrong_protocol", message="another version")


def register(name: str) -> bytes:
    return codec.encode(
        Register(
            worker=name,
            token="t",
            protocol=0,
            slots=1,
            tiers=(),
            environments=(),
            fingerprint=Fingerprint(code_version="1", python="3", packages={}, cpu=""),
            host="lab",
        )
    )


def test_a_refused_worker_is_reported_with_the_reason_until_it_is_taken() -> None:
    workers = RefusedWorkers()
    workers.answered(KEY, register("old"), REFUSED, 100.0)
    (entry,) = workers.recent(103.0)
    assert (entry.worker, entry.host, entry.why, entry.ago_s) == ("old", "lab", "another version", 3.0)
    workers.answered(KEY, register("old"), Registered(session="s", lease_ttl_s=1.0, heartbeat_s=1.0), 104.0)
    assert workers.recent(104.0) == ()


def test_only_so_many_are_kept_and_only_for_a_while() -> None:
    workers = RefusedWorkers()
    for index in range(2 * KEPT):
        workers.answered(KEY, register(f"w{index}"), REFUSED, float(index))
    assert [entry.worker for entry in workers.recent(100.0)] == [
        f"w{index}" for index in range(KEPT, 2 * KEPT)
    ]
    assert workers.recent(100.0 + KEPT_S) == ()


def test_other_requests_and_nonsense_are_none_of_its_business() -> None:
    workers = RefusedWorkers()
    lease = codec.encode(LeaseRequest(worker="w", session="s", n=1, wait_s=0.0))
    workers.answered("evopolicy/v1/c/work/lease", lease, REFUSED, 0.0)
    workers.answered(KEY, lease, REFUSED, 0.0)
    workers.answered(KEY, b"nonsense", REFUSED, 0.0)
    assert workers.recent(1.0) == ()
