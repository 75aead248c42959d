"""The output of all episodes of one job together: it has to fit into a message to the coordinator."""

from __future__ import annotations

import msgspec
import pytest
from slots import QUICK, Slots, make_job, misbehaving

from evopolicy_common.errors import BrokenEnvironmentError
from evopolicy_common.messages.episode import EpisodeOutcome, PolicyFailure
from evopolicy_common.wire import codec
from evopolicy_worker.episodes import loop as episodes
from evopolicy_worker.outbox import inline_bytes

LOUD = "[os.write(k, b'x' * 65536) for k in (1, 2) for _ in range(2)]"


def test_a_submit_of_loud_episodes_keeps_each_ones_output(slots: Slots) -> None:
    policy = misbehaving(reset=f"{LOUD}; self.n = 0")
    outcomes = slots.play_all(
        policy, first=0, n=128, policy_scope="submit", limits=msgspec.structs.replace(QUICK, cpu_s=60.0)
    )
    assert [outcome.index for outcome in outcomes] == list(range(128))
    assert {(len(outcome.stdout), len(outcome.stderr)) for outcome in outcomes} == {(65536, 65536)}


@pytest.mark.parametrize("n", [1, 128, 327, 4096, 10_000])
def test_the_largest_outcomes_of_a_job_can_be_handed_in(n: int) -> None:
    job = make_job(n=n, limits=msgspec.structs.replace(QUICK, output_bytes=1 << 40))
    most = episodes._within_share(job).output_bytes
    if n <= 327:
        assert most == 65536
    failure = PolicyFailure(
        category="act_error", step_index=3, message="\U0001f600" * 2000, traceback="\U0001f600" * 16_000
    )
    outcome = episodes._brief(
        EpisodeOutcome(
            index=0,
            episode_return=0.0,
            length=1,
            terminated=True,
            truncated=False,
            failure=failure,
            stdout=bytes(most),
            stderr=bytes(most),
        ),
        episodes._share(job),
    )
    assert n * len(msgspec.msgpack.encode(outcome)) <= codec.MAX_PACKED_BYTES - n * 1024
    if n <= 327:
        assert outcome.failure == failure
    if n > 1:
        # Small trajectories travel in the outcome, and there is room for them in a job of any size that is usual.
        assert 327 * (inline_bytes(n) + len(msgspec.msgpack.encode(outcome))) <= codec.MAX_PACKED_BYTES


def test_a_recording_that_no_coordinator_takes_is_the_environments_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(codec, "MAX_BLOB_BYTES", 10)
    assert episodes._blob(b"x" * 10).size == 10
    with pytest.raises(BrokenEnvironmentError, match="its recording has 11 bytes, and 10 are the limit"):
        episodes._blob(b"x" * 11)
