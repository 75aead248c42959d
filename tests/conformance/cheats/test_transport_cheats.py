"""Agents that turn to the cluster itself: with stolen credentials of their own gateway, since a jailed one has none."""

from __future__ import annotations

import asyncio
import json
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from attacks.cheated import TIMEOUT_S, Cheated
from coordinator_harness import (
    Coordinator,
    GatewayClient,
    bundle_of,
    gateway_of,
    operator_of,
    working,
)
from waiting import wait_until

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import gateway, worker
from evopolicy_common.messages.worker import Refused
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_common.wire import codec, keys

EAVESDROPPER = Path(__file__).with_name("programs") / "eavesdropping_agent.py"


class Eavesdropped:
    """A run whose agent listens to everything while another run is played on the same cluster."""

    def __init__(self, cheated: Cheated) -> None:
        workspace = cheated.runs / "e" / "toy_line" / "eavesdropper" / "workspace"
        played: list[tuple[int, str, Path]] = []

        def eavesdrop() -> None:
            words = f"command:{sys.executable} {EAVESDROPPER}"
            played.append(cheated.play(words, "eavesdropper", "--jail", "none"))

        thread = threading.Thread(target=eavesdrop)
        thread.start()
        try:
            wait_until(lambda: (workspace / "listening").exists() or played)
            assert not played, played
            self.code, self.output, self.honest = cheated.play("evolve", "overheard")
            (workspace / "enough").touch()
        finally:
            thread.join(TIMEOUT_S)
        ((code, output, self.folder),) = played
        assert code == 0, output
        self.report: dict[str, Any] = json.loads((workspace / "report.json").read_text())


@pytest.fixture(scope="module")
def eavesdropped(cheated: Cheated) -> Eavesdropped:
    return Eavesdropped(cheated)


def test_an_agent_with_a_session_hears_no_other_runs_or_workers(
    eavesdropped: Eavesdropped,
) -> None:
    """Attack: opens its own Zenoh session and listens to everything. Defence: access rules: no subscriber,
    queryable, or token of a gateway takes effect; the admin space does not answer."""
    assert eavesdropped.report["connected"]
    assert eavesdropped.report["heard"] == []


def test_its_session_is_answered_on_its_own_runs_keys_alone(eavesdropped: Eavesdropped) -> None:
    """Attack: sends requests as a worker or operator, replies as the coordinator. Defence: access rules of Zenoh."""
    answers = eavesdropped.report["answers"]
    # Without this one the others would prove nothing.
    assert answers.pop("own state") == "run_state"
    assert answers == {
        "status of the cluster": None,
        "work": None,
        "every key": None,
        "admin spaces": [],
        "liveliness": None,
        "another run": "refused",
    }


def test_the_honest_run_beside_it_is_played_as_if_nobody_listened(eavesdropped: Eavesdropped) -> None:
    assert eavesdropped.code == 0, eavesdropped.output
    record = decode_run_record((eavesdropped.honest / "run.json").read_bytes())
    assert (record.outcome.status, record.outcome.budget_used) == ("completed", 4)
    assert decode_run_record((eavesdropped.folder / "run.json").read_bytes()).outcome.budget_used == 1


@pytest.fixture(scope="module")
def coordinator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Coordinator]:
    coordinator = Coordinator(tmp_path_factory.mktemp("replayed") / "st")
    yield coordinator
    coordinator.kill()


@asynccontextmanager
async def two_runs(
    coordinator: Coordinator, name: str
) -> AsyncIterator[tuple[GatewayClient, GatewayClient, Any]]:
    """The gateways of two runs, and the operator."""
    async with operator_of(coordinator) as client:
        mine, other = await client.create(f"{name}-mine"), await client.create(f"{name}-other")
        async with gateway_of(coordinator, mine) as owner, gateway_of(coordinator, other) as victim:
            yield owner, victim, client


async def test_a_captured_submit_that_is_sent_again_is_charged_and_played_once(
    coordinator: Coordinator,
) -> None:
    """Attack: replays another run's captured submit, on either key. Defence: a message is accepted on its
    own run's key only, and once."""
    async with (
        two_runs(coordinator, "captured") as (owner, thief, client),
        working(coordinator, "w-1") as w,
    ):
        bundle = bundle_of("# captured")
        first = await owner.submit(bundle, (0, 1), "key")
        captured = codec.encode(
            gateway.Submit(
                run=owner.run, token=owner.token, key="key", env_instances=(0, 1), bundle=bundle.digest
            )
        )
        link = thief.ask._link
        cluster = link.credentials.cluster
        for _ in range(5):
            reply = await link.query(keys.gateway_key(cluster, owner.run, "submit"), captured, 10)
            assert codec.decode(codec.gateway_replies, reply) == first
        # On the thief's own key the same bytes are of another run.
        reply = await link.query(keys.gateway_key(cluster, thief.run, "submit"), captured, 10)
        refused = codec.decode(codec.gateway_replies, reply)
        assert isinstance(refused, Refused)
        assert refused.status == "wrong_key"
        await owner.results(0)
        assert ((await owner.state()).remaining_budget, (await thief.state()).remaining_budget) == (
            14,
            16,
        )
        await owner.close()
        # Sent again when the run is over it is the same submit still, or none.
        reply = await link.query(keys.gateway_key(cluster, owner.run, "submit"), captured, 10)
        assert isinstance(codec.decode(codec.gateway_replies, reply), Refused | gateway.SubmitAccepted)
        finished = await client.finished(owner.run)
        assert (finished.budget_used, len(finished.submits)) == (2, 1)
        train = [job for job in w.jobs if job.bundle == bundle.digest and job.record == "full"]
        assert len(train) == 2


async def test_a_reused_key_with_another_bundle_is_refused(
    coordinator: Coordinator,
) -> None:
    """Attack: sends a submit twice to be charged once and played twice. Defence: one submit per key and
    bundle digest, in gateway and coordinator."""
    async with two_runs(coordinator, "switched") as (owner, _, client), working(coordinator, "w-2") as w:
        weak, strong = bundle_of("# weak"), bundle_of("# strong")
        first = await owner.submit(weak, (0,), "key")
        for ids in ((0,), (0, 1)):
            with pytest.raises(RefusedError) as refused:
                await owner.submit(strong, ids, "key")
            assert refused.value.status == "key_conflict"
        assert await owner.submit(weak, (0,), "key") == first
        await owner.results(0)
        with pytest.raises(RefusedError):
            await owner.submit(strong, (0,), "key")
        await owner.close()
        finished = await client.finished(owner.run)
        assert [submit.bundle for submit in finished.submits] == [weak.digest]
        assert finished.budget_used == 1
        assert strong.digest not in {job.bundle for job in w.jobs}


async def test_another_runs_bundle_cannot_be_played_or_found_by_digest(
    coordinator: Coordinator,
) -> None:
    """Attack: submits a rival's policy by a digest printed in a report; probes whether a bundle or hidden
    recording is stored. Defence: a run submits only bundles that it uploaded itself; answers do not
    depend on stored blobs."""
    async with (
        two_runs(coordinator, "stolen") as (owner, thief, client),
        working(coordinator, "w-5") as w,
    ):
        rival, unknown = bundle_of("# a rival's policy"), bundle_of("# nobody's")
        await owner.submit(rival, (0,), "key")
        ((episode,), _) = await owner.results(0)
        refusals = []
        for digest in (rival.digest, episode.trajectory.digest, unknown.digest):
            with pytest.raises(RefusedError) as refused:
                await thief.submit_digest(digest, (0,), digest[:8])
            refusals.append((refused.value.status, refused.value.message.replace(digest, "")))
            guess = worker.BlobPut(
                sender=thief.run, token=thief.token, digest=digest, size=99, offset=0, data=b""
            )
            assert (await thief.ask.once("blob", guess, worker.BlobAck)).have == 0
        assert len(set(refusals)) == 1
        assert refusals[0][0] == "missing_bundle"
        assert (await thief.state()).remaining_budget == 16
        # Who has the policy itself may play it, as anybody may.
        await thief.submit(rival, (0,), "its own")
        await thief.results(0)
        await thief.close()
        assert (await client.finished(thief.run)).budget_used == 1
        assert {job.bundle for job in w.jobs} <= {rival.digest, None}


async def test_the_same_key_sent_ten_times_at_once_is_one_submit(coordinator: Coordinator) -> None:
    """Attack: sends a submit twice to be charged once and played twice. Defence: one submit per key and
    bundle digest, in gateway and coordinator."""
    async with two_runs(coordinator, "at once") as (owner, _, client), working(coordinator, "w-3"):
        bundle = bundle_of("# at once")
        await owner.ask.upload(owner.run, owner.token, bundle.digest, bundle.packed)
        answers = await asyncio.gather(
            *(owner.submit_digest(bundle.digest, (0, 1, 2), "key") for _ in range(10))
        )
        assert len(set(answers)) == 1
        await owner.results(0)
        await owner.close()
        assert (await client.finished(owner.run)).budget_used == 3


async def test_a_submit_while_the_run_is_scored_is_refused_and_changes_nothing(
    coordinator: Coordinator,
) -> None:
    """Attack: submits while the run is scored. Defence: a closed run accepts none; the answer says only
    that it is closed."""
    async with two_runs(coordinator, "late") as (owner, _, client):
        honest, late = bundle_of("# honest"), bundle_of("# late")
        async with working(coordinator, "w-4") as w:
            await owner.ask.upload(owner.run, owner.token, late.digest, late.packed)
            await owner.submit(honest, (0,), "honest")
            await owner.results(0)
            w.hold.clear()
            await owner.close()
            assert (await client.progress(owner.run, 0.0)).finished is None
            with pytest.raises(RefusedError) as refused:
                await owner.submit_digest(late.digest, (0,), "late")
            assert refused.value.status in ("run_closed", "run_finished")
            with pytest.raises(RefusedError) as refused:
                await owner.submit(bundle_of("# later still"), (0,), "later")
            # Reading what it has had already is no harm; it is not told how the scoring goes.
            assert (await owner.state()).is_finalized
            w.hold.set()
            finished = await client.finished(owner.run)
        assert [submit.bundle for submit in finished.submits] == [honest.digest]
        assert finished.budget_used == 1
        assert late.digest not in {job.bundle for job in w.jobs}
