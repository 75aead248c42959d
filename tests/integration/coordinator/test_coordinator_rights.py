"""The coordinator or its router refuses every wrong token, wrong key and foreign run."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator

import msgspec
import pytest
from coordinator_harness import (
    Coordinator,
    GatewayClient,
    InstantWorker,
    bundle_of,
    gateway_of,
    operator_of,
    play,
)

from evopolicy_common.errors import RefusedError
from evopolicy_common.messages import worker
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, EpisodeSpec, Job
from evopolicy_common.wire.transport import connect


@pytest.fixture(scope="module")
def coordinator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Coordinator]:
    coordinator = Coordinator(tmp_path_factory.mktemp("rights") / "state")
    yield coordinator
    coordinator.kill()


async def status_of(request: Awaitable[object]) -> str:
    """The status with which a request is refused."""
    with pytest.raises(RefusedError) as refused:
        await request
    return refused.value.status


async def test_unknown_session_is_refused_for_every_request_of_a_worker(coordinator: Coordinator) -> None:
    async with connect(coordinator.credentials("worker")) as link:
        instant = InstantWorker(link, "w-known")
        await instant.register()
        session = "guess"
        for verb, message in (
            ("lease", worker.LeaseRequest(worker="w-known", session=session, n=1, wait_s=0)),
            ("beat", worker.Heartbeat(worker="w-known", session=session, held=())),
            ("done", worker.ReportResults(worker="w-known", session=session, results=())),
            ("blob", worker.BlobGet(sender="w-known", token=session, digest="0" * 64, offset=0)),
            (
                "blob",
                worker.BlobPut(sender="w-known", token=session, digest="0" * 64, size=1, offset=0, data=b"x"),
            ),
        ):
            assert await status_of(instant.ask.once(verb, message, worker.Leases)) == "unknown_worker"


async def test_wrong_operator_token_is_refused(coordinator: Coordinator) -> None:
    async with operator_of(coordinator) as client:
        client.token = "guess"
        assert await status_of(client.status()) == "bad_token"


async def test_gateway_of_one_run_can_do_nothing_with_another(coordinator: Coordinator) -> None:
    """Attack: uses another run's capability, guesses one, names another run. Defence: a capability is
    valid for one run; a wrong capability and an unknown run get the same answer."""
    async with operator_of(coordinator) as client:
        mine, other = await client.create("mine"), await client.create("other")
        async with gateway_of(coordinator, mine) as intruder:
            thief = GatewayClient(intruder.ask._link, other.run, mine.capability)
            blob = {"sender": other.run, "token": mine.capability, "digest": "0" * 64, "offset": 0}
            asks: list[Callable[[], Awaitable[object]]] = [
                thief.open,
                thief.state,
                thief.close,
                lambda: thief.submit_digest("0" * 64, (0,), "key"),
                lambda: thief.results(0),
                lambda: thief.ask.once("blob", worker.BlobGet(**blob), worker.BlobChunk),
                lambda: thief.ask.once("blob", worker.BlobPut(**blob, size=1, data=b"x"), worker.BlobAck),
            ]
            for ask in asks:
                assert await status_of(ask()) == "bad_token"
        async with gateway_of(coordinator, other) as owner:
            assert not (await owner.state()).is_finalized


async def test_unknown_run_is_answered_like_a_wrong_capability(coordinator: Coordinator) -> None:
    """Attack: uses another run's capability, guesses one, names another run. Defence: a capability is
    valid for one run; a wrong capability and an unknown run get the same answer."""
    async with connect(coordinator.credentials("gateway")) as link:
        with pytest.raises(RefusedError) as unknown:
            await GatewayClient(link, "r-nowhere", "guess").open()
    async with operator_of(coordinator) as client:
        created = await client.create("known")
    async with connect(coordinator.credentials("gateway")) as link:
        with pytest.raises(RefusedError) as wrong:
            await GatewayClient(link, created.run, "guess").open()
    assert (unknown.value.status, unknown.value.message) == (wrong.value.status, wrong.value.message)


async def test_gateway_fetches_blobs_that_its_own_train_feedback_names_and_no_others(
    coordinator: Coordinator,
) -> None:
    """Attack: fetches blobs that are not of its train feedback. Defence: refused like unknown ones."""
    stored: dict[str, bytes] = {}

    def play_with_blob(job: Job, spec: EpisodeSpec) -> EpisodeOutcome:
        outcome = play(job, spec)
        assert outcome.trajectory is not None
        data = outcome.trajectory.inline
        assert data is not None
        stored[outcome.trajectory.digest] = data
        named = BlobRef(digest=outcome.trajectory.digest, size=len(data))
        return msgspec.structs.replace(outcome, trajectory=named)

    async with operator_of(coordinator) as client, connect(coordinator.credentials("worker")) as link:
        instant = InstantWorker(link, "w-blobs", play=play_with_blob)
        await instant.register()
        mine, other = await client.create("blobs"), await client.create("blobs-other")
        async with gateway_of(coordinator, mine) as owner, gateway_of(coordinator, other) as stranger:
            bundle = bundle_of("# blobs")
            await owner.submit(bundle, (0,), "key")
            (lease,) = [lease for lease in await instant.lease(4, 10) if lease.job.record == "full"]
            assert await instant.ask.download(instant.name, instant.session, bundle.digest) == bundle.packed
            assert (
                await status_of(instant.ask.download(instant.name, instant.session, "1" * 64))
                == "unknown_blob"
            )
            result = instant.result(lease)
            assert await status_of(instant.report_results((result,))) == "missing_blob"
            ((digest, data),) = stored.items()
            await instant.ask.upload(instant.name, instant.session, digest, data)
            await instant.report_results((result,))
            ((episode,), _) = await owner.results(0)
            assert episode.trajectory.digest == digest
            assert await owner.ask.download(owner.run, owner.token, digest) == data
            for client_, wanted in ((stranger, digest), (owner, bundle.digest), (stranger, bundle.digest)):
                assert (
                    await status_of(client_.ask.download(client_.run, client_.token, wanted))
                    == "unknown_blob"
                )
