"""The service around the core, without a network: one fsync a tick, and a fresh core from disk after any failure."""

from __future__ import annotations

import asyncio
import contextlib
import re
import sqlite3
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import structlog
from rigs.service_world import Requested, World, register, started
from structlog.testing import capture_logs

from evopolicy_common.errors import DamagedStoreError, LeadLostError, PartFailedError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.status import StatusRequest
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.wire import keys
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.server import core_host, process, service
from evopolicy_coordinator.storage.store import Store
from evopolicy_coordinator.web.content.remarks import abandoned


def failing(error: Exception) -> Any:
    """What stands in the place of a function and fails."""

    def broken(*_: Any) -> Any:
        raise error

    return broken


async def test_all_events_of_a_tick_share_one_write(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        runs = [await world.create(f"run-{n}") for n in range(20)]
        before = world.writes
        asked = [world.submit(created, "key") for created in runs]
        world.ask(*asked)
        for one in asked:
            assert isinstance(await one.message(), gateway.SubmitAccepted)
        assert world.writes == before + 1


async def test_what_was_answered_is_there_after_a_restart(tmp_path: Path) -> None:
    kept: list[operator.RunCreated] = []

    async with started(tmp_path) as world:
        kept.append(await world.create())
        assert (await world.answer(world.submit(kept[0], "key"))).remaining_budget == 98
    async with started(tmp_path) as world:
        assert await world.create() == kept[0]
        assert (await world.answer(world.state(kept[0]))).remaining_budget == 98


async def test_an_unwritten_request_did_not_happen_and_may_be_repeated(tmp_path: Path) -> None:

    async with started(tmp_path) as world:
        created = await world.create()
        world.full = True
        assert await world.answer(world.submit(created, "key")) is None
        waiting, submitted = world.state(created), world.submit(created, "key")
        world.ask(waiting, submitted)
        assert await waiting.message() is None
        refused = await submitted.message()
        assert refused.status == "unavailable"
        assert "cannot write its store" in refused.message
        assert "disk is full" not in refused.message
        assert "disk is full" in (await world.answer(world.creating("other"))).message
        world.full = False
        while not isinstance(
            answer := await world.answer(world.submit(created, "key")), gateway.SubmitAccepted
        ):
            assert answer is None or isinstance(answer, worker.Refused)
            await asyncio.sleep(0.02)
        assert answer.submit_index == 0
        assert answer.remaining_budget == 98


async def test_a_leader_refuses_nothing_once_another_one_has_loaded(tmp_path: Path) -> None:
    """A gateway takes the refusal of a run as final, and another leader may have opened that run since."""

    def submit(world: World, run: str) -> Requested:
        message = gateway.Submit(run=run, token="t", key="k", env_instances=(0,), bundle=None)
        return Requested(keys.gateway_key("c", run, "submit"), message)

    async with started(tmp_path) as world:
        created, host = await world.create(), world.service.host
        host.leads_until = time.monotonic() + 60.0
        assert (await world.answer(submit(world, "unknown"))).status == "bad_token"
        with contextlib.closing(Store(tmp_path / "db")) as other:
            other.load()
        accepted = world.state(created)
        refused = submit(world, "of-the-other")
        world.ask(accepted, refused)
        assert await accepted.message() is not None
        assert await refused.message() is None
        with pytest.raises(LeadLostError, match="taken over"):
            host.failed.result()
        assert not host.leads


async def test_operators_are_answered_while_the_store_cannot_write(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        world.full = True
        assert await world.answer(world.submit(created, "key")) is None
        asked = Requested(keys.operator_key("c", "status"), StatusRequest(token="operate"))
        following = world.waiting(created.run, 0.0)
        stranger = Requested(keys.operator_key("c", "status"), StatusRequest(token="guessed"))
        world.ask(asked, following, stranger)
        status, progress = await asked.message(), await following.message()
        trouble = "cannot write its store and accepts no changes until it can: database or disk"
        assert all(trouble in answer.trouble for answer in (status, progress))
        assert [run.run for run in status.runs] == [created.run]
        assert (progress.phase, progress.total) == ("open", 100)
        assert isinstance(await stranger.message(), worker.Refused)
        world.full = False
        while status.trouble:
            status = await world.status()
            await asyncio.sleep(0.02)


async def test_an_open_run_without_a_gateway_for_an_hour_is_abandoned(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        created, other = await world.create(), await world.create("other")
        now = world.service.host.now
        world.service.host.now = lambda: now() + 3601.0  # type: ignore[method-assign]
        await world.answer(world.state(other))
        status = await world.status()
        assert {run.run: run.abandoned for run in status.runs} == {created.run: True, other.run: False}
        (line,) = abandoned(status.runs)
        assert line.endswith(f"end it with evopolicy runs cancel {created.run}")
        assert "1 h" in line or "60 min" in line


async def test_core_that_fails_is_loaded_anew_and_others_are_served_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handle = Core.handle

    def stumble(core: Core, event: Any, now: float) -> Any:
        if getattr(getattr(event, "message", None), "key", "") == "poison":
            raise ZeroDivisionError("planted")
        return handle(core, event, now)

    monkeypatch.setattr(Core, "handle", stumble)

    async with started(tmp_path) as world:
        created = await world.create()
        assert await world.answer(world.submit(created, "poison")) is None
        while True:
            asked = world.submit(created, "good")
            if isinstance(answer := await world.answer(asked), gateway.SubmitAccepted):
                break
            await asyncio.sleep(0.02)
        assert answer.remaining_budget == 98


async def test_stopping_answers_what_was_handled_and_ends_every_wait(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        waiting = world.waiting(created.run, 60)
        accepted = world.submit(created, "key")
        world.ask(waiting, accepted)
        await world.service.stop()
        assert isinstance(await accepted.message(), gateway.SubmitAccepted)
        assert await waiting.message() is None
        assert await world.answer(world.state(created)) is None


async def test_a_stuck_disk_is_named_in_status_and_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with started(tmp_path, CoreSettings(stall_s=0.1)) as world:
        goes_on = threading.Event()
        write = world.store.write

        def hanging(rows: Any) -> None:
            assert goes_on.wait(60)
            write(rows)

        world.store.write = hanging  # type: ignore[method-assign]
        created = world.creating()
        world.ask(created)
        stalls: tuple[str, ...] = ()
        while not stalls:
            stalls = (await world.status()).stalls
            await asyncio.sleep(0.01)
        assert re.fullmatch("1 requests wait for the disk: it has been writing for .* s", stalls[0])
        with capture_logs() as logs:
            monkeypatch.setattr(service, "log", structlog.get_logger())
            world.service._tell_stalls()
        assert [entry["first"] for entry in logs] == [stalls[:1]]
        assert not created.answer.done()
        goes_on.set()
        assert isinstance(await created.message(), operator.RunCreated)


async def test_any_number_of_watchers_costs_one_status(tmp_path: Path) -> None:
    async with started(tmp_path) as world:

        async def shown(max_age_s: float) -> tuple[float, int]:
            reply = await world.status(max_age_s=max_age_s)
            return reply.uptime_s, len(reply.runs)

        first = await shown(60.0)
        await world.create()
        assert await shown(60.0) == first, "the same reply once more"
        uptime_s, n_runs = await shown(0.0)
        assert (uptime_s > first[0], n_runs) == (True, 1), "after a change of one's own it is made anew"
        assert await shown(60.0) == (uptime_s, n_runs)


async def test_the_status_tells_of_the_disk(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        while True:
            if (disk := (await world.status()).disk) is not None:
                break
            await asyncio.sleep(0.01)
        assert 0 < disk.free < disk.total


async def test_long_poll_ends_by_itself(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        session = (await register(world).message()).session
        request = worker.LeaseRequest(worker="w", session=session, n=1, wait_s=0.05)
        polling = Requested(keys.worker_key("c", "lease"), request)
        assert await world.answer(polling) == worker.Leases(leases=())


async def test_a_clock_set_back_between_two_starts_ends_nothing_before_it_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began: list[float] = []

    true_time = time.time
    async with started(tmp_path) as world:
        await world.create()
        began.append(world.service.host.now())
    monkeypatch.setattr(time, "time", lambda: true_time() - 5 * 3600.0)
    async with started(tmp_path) as world:
        assert world.service.host.now() >= began[0] - 60.0


async def test_a_poll_given_up_during_a_blocked_loop_gets_no_lease(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        session = (await register(world).message()).session
        created = await world.create()
        request = worker.LeaseRequest(worker="w", session=session, n=1, wait_s=10.0)
        stale, fresh = (Requested(keys.worker_key("c", "lease"), request) for _ in range(2))
        stale.arrived -= 12.0
        bundle = world.blobs.put(b"a bundle")
        world.uploads.note(created.run, bundle)
        world.ask(world.submit(created, "k", env_instances=(0,), bundle=bundle), stale, fresh)
        assert await stale.message() == worker.Leases(leases=())
        assert len((await fresh.message()).leases) == 1


async def failed(world: World) -> str:
    """Why the service cannot go on."""
    with pytest.raises(PartFailedError) as error:
        await asyncio.wait_for(asyncio.shield(world.service.host.failed), 20)
    return str(error.value)


async def test_an_unloadable_state_ends_the_service_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        monkeypatch.setattr(Core, "load", failing(KeyError("a row that is not there")))
        world.full = True
        world.ask(world.submit(created, "key"))
        assert await failed(world) == "loading the state failed: KeyError: 'a row that is not there'"
        # Who asks meanwhile hears at once, and asks again.
        assert await world.answer(world.state(created)) is None


async def test_a_state_that_cannot_be_loaded_at_the_start_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Core, "load", failing(KeyError("a row that is not there")))
    with pytest.raises(PartFailedError, match="loading the state failed: KeyError"):
        async with started(tmp_path):
            pass


async def test_a_core_failing_after_each_load_ends_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads: list[float] = []
    load = Core.load

    def counted(*args: Any) -> Any:
        loads.append(time.monotonic())
        return load(*args)

    monkeypatch.setattr(core_host, "_LONGEST_PAUSE_S", 0.2)
    monkeypatch.setattr(Core, "load", counted)
    async with started(tmp_path) as world:
        created = await world.create()
        monkeypatch.setattr(Core, "handle", failing(ZeroDivisionError("planted")))
        ending = asyncio.create_task(failed(world))
        while not ending.done():
            world.ask(world.state(created))
            await asyncio.sleep(0.01)
        assert await ending == "the core, 6 times in a row, failed: ZeroDivisionError: planted"
        assert len(loads) == 1 + 5


async def test_a_core_that_fails_now_and_then_is_loaded_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(core_host, "_SOON_S", 0.0)
    monkeypatch.setattr(core_host, "_LONGEST_PAUSE_S", 0.01)
    async with started(tmp_path) as world:
        created = await world.create()
        handle = Core.handle

        def stumble(*_: Any) -> Any:
            monkeypatch.setattr(Core, "handle", handle)
            raise ZeroDivisionError("planted")

        for _ in range(8):
            monkeypatch.setattr(Core, "handle", stumble)
            answer = None
            while answer is None:
                answer = await world.answer(world.state(created))
                await asyncio.sleep(0.01)
            assert isinstance(answer, gateway.RunState)


async def test_a_row_that_the_store_refuses_ends_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(core_host, "_LONGEST_PAUSE_S", 0.2)
    async with started(tmp_path) as world:
        created = await world.create()
        refusal = DamagedStoreError("refuses a row that contradicts another")
        world.store.write = failing(refusal)  # type: ignore[method-assign]
        ending = asyncio.create_task(failed(world))
        while not ending.done():
            world.ask(world.submit(created, "key"))
            await asyncio.sleep(0.01)
        assert "refuses a row that contradicts another" in await ending


async def test_an_unreadable_row_ends_the_service_with_the_remedy(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        with contextlib.closing(sqlite3.connect(tmp_path / "db")) as db, db:
            db.execute("UPDATE runs SET data = x'00'")
        world.full = True
        world.ask(world.submit(created, "key"))
        why = await failed(world)
        for named in ("table runs", created.run, "Restore a backup"):
            assert named in why


async def test_a_request_for_unreadable_data_is_refused_and_others_served(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        claim = operator.Claim(token="operate", suite="s", name="n", holder="h", ttl_s=9.0)
        await world.service._writer.call(lambda store: store.write_claim("s", "n", b"\0"))
        asked = Requested(keys.operator_key("c", "claim"), claim)
        submitted = world.submit(created, "key")
        world.ask(asked, submitted)
        refused = await asked.message()
        assert refused.status == "damaged"
        assert isinstance(await submitted.message(), gateway.SubmitAccepted)
        with contextlib.closing(sqlite3.connect(tmp_path / "db")) as db, db:
            db.execute("UPDATE submits SET data = x'00'")
        known = {"run": created.run, "token": created.capability}
        message = gateway.ResultsRequest(**known, submit_index=0, cursor=0, wait_s=1.0)
        refused = await world.answer(Requested(keys.gateway_key("c", created.run, "results"), message))
        assert refused.status == "damaged"
        assert str(tmp_path) not in refused.message
        assert isinstance(await world.answer(world.state(created)), gateway.RunState)


async def test_the_process_ends_when_its_service_cannot_go_on(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        waiting = asyncio.create_task(process._until(asyncio.Event(), world.service))
        await asyncio.sleep(0)
        world.service.host.fail("a test", RuntimeError("why"))
        with pytest.raises(PartFailedError, match="a test failed: RuntimeError: why"):
            await asyncio.wait_for(waiting, 20)
    async with started(tmp_path) as world:
        stop = asyncio.Event()
        stop.set()
        await asyncio.wait_for(process._until(stop, world.service), 20)


async def test_a_bug_in_the_writers_thread_ends_the_service_with_the_reason(tmp_path: Path) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        world.store.write = failing(TypeError("no such row"))  # type: ignore[method-assign]
        asked = world.submit(created, "key")
        world.ask(asked)
        assert await failed(world) == "writing the store failed: TypeError: no such row"
        assert await asked.message() is None


async def test_a_timer_that_cannot_be_set_ends_the_service_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        monkeypatch.setattr(Core, "next_deadline", failing(ZeroDivisionError("no deadline")))
        world.ask(world.submit(created, "key"))
        assert await failed(world) == "the outbox failed: ZeroDivisionError: no deadline"


async def test_an_answer_that_cannot_be_made_holds_up_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with started(tmp_path) as world:
        created = await world.create()
        real = service.answer_bytes

        def broken(message: Any) -> bytes:
            if isinstance(message, gateway.RunState):
                raise ValueError("cannot be made")
            return real(message)

        monkeypatch.setattr(service, "answer_bytes", broken)
        asked = world.submit(created, "key")
        world.ask(world.state(created), asked)
        assert isinstance(await asked.message(), gateway.SubmitAccepted)


async def test_uploads_that_no_submit_named_are_deleted_once_their_run_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: uploads bundles that it never submits, until the coordinator's disk is full. Defence: 16
    uploads of 256 MiB together may be named by no submit of the run; they are deleted within a minute
    after it was closed (after a restart of the coordinator, by `evopolicy-coordinator gc`)."""
    monkeypatch.setattr(service, "_SWEEP_S", 0.05)

    async with started(tmp_path) as world:
        one, other = await world.create("one"), await world.create("other")

        async def put(created: operator.RunCreated, data: bytes, part: slice = slice(None)) -> None:
            size, sent = len(data), data[part]
            known = {"sender": created.run, "token": created.capability, "digest": digest_of(data)}
            message = worker.BlobPut(**known, size=size, offset=0, data=sent)
            asked = Requested(keys.gateway_key("c", created.run, "blob"), message)
            assert (await world.answer(asked)).have == len(sent)

        kept_before = b"stored before by someone else"
        world.blobs.put(kept_before)
        in_use = (b"named", b"in both runs", b"brought again", b"stored again", kept_before)
        for data in (b"left behind", *in_use):
            await put(one, data)
        await put(other, b"in both runs")
        await put(other, b"left behind in an open run")
        await put(one, b"unfinished", slice(0, 4))
        # As by an operator or a worker that refers to it from then on.
        world.blobs.append_chunk("ops/operator", digest_of(b"brought again"), 13, 0, b"brought again")
        world.blobs.put(b"stored again")
        submitted = world.submit(one, "k", bundle=digest_of(b"named"))
        assert isinstance(await world.answer(submitted), gateway.SubmitAccepted)
        await world.answer(world.cancelling(one.run))
        async with asyncio.timeout(20):
            while world.blobs.has(digest_of(b"left behind")) or list((tmp_path / "blobs/parts").iterdir()):
                await asyncio.sleep(0.02)
        for data in (*in_use, b"left behind in an open run"):
            assert world.blobs.read_blob(digest_of(data)) == data
        assert world.uploads.has_sent(other.run, digest_of(b"in both runs"))
        assert not world.uploads.has_sent(one.run, digest_of(b"named"))
