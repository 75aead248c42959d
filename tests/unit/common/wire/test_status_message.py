"""The status of a large cluster fits into a message."""

from __future__ import annotations

import msgspec
from invented import web_site

from evopolicy_common.messages.status import StatusReply, WorkerStatus, folded, unfolded
from evopolicy_common.wire import codec

ENVS = tuple(f"family/environment-{index}" for index in range(16))
REFUSED = {f"run-{index}": "the run is pinned to another fingerprint class" for index in range(2000)}


def worker(index: int) -> WorkerStatus:
    """One of three installations, in turns; one worker has nothing in common with the others."""
    kind = f"class-{index % 3}"
    own: dict[str, str] = {} if index != 5 else {"run-of-its-own": "it lacks the sandbox tier"}
    return WorkerStatus(
        worker=f"worker-{index}",
        host=f"host-{index}",
        slots=64,
        state="active",
        tiers=("bwrap",),
        environments=ENVS,
        fingerprint=kind,
        versions={"python": "3.11.2", "cpu": kind},
        classes=dict.fromkeys(ENVS, kind),
        refused=REFUSED if index % 3 else own,
        held=64,
        running=64,
        last_seen_s=1.0,
        boot_id="4b0d7a6e-0c39-4a57-9a0e-2f6a5b0f8a11",
    )


def test_the_status_of_ten_thousand_workers_arrives_whole() -> None:
    status = web_site.status(workers=tuple(map(worker, range(10_000))))
    assert len(msgspec.msgpack.encode(status)) > codec.MAX_MESSAGE_BYTES
    sent = codec.encode(folded(status))
    arrived = codec.decode(codec.operator_replies, sent)
    assert isinstance(arrived, StatusReply)
    assert arrived != status
    assert unfolded(arrived) == status
