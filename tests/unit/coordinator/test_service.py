"""The service around the core, without a network: one fsync a tick, and a fresh core from disk after any failure."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
import structlog
from structlog.testing import capture_logs

from evopolicy_common import codec, keys
from evopolicy_common.blobs import BlobStore
from evopolicy_common.errors import StorageError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import PolicyFailure
from evopolicy_common.messages.operator import RunSettings
from evopolicy_common.messages.worker import Message
from evopolicy_coordinator import service
from evopolicy_coordinator.answers import Answers
from evopolicy_coordinator.core.machine import Core
from evopolicy_coordinator.core.settings import CoreSettings
from evopolicy_coordinator.intake import Intake
from evopolicy_coordinator.service import Service
from evopolicy_coordinator.splits import SplitSource
from evopolicy_coordinator.state import ROLES, Identity
from evopolicy_coordinator.store import Store
from evopolicy_coordinator.uploads import Uploads

IDENTITY = Identity(
    cluster="c", passwords=dict.fromkeys(ROLES, "p"), worker_token="join", operator_token="operate"
)
SETTINGS = CoreSettings()
FAILURE = PolicyFailure(category="missing_policy", step_index=None, message="no policy.py")


class Asked:
    """A query as the transport hands it over, with its answer to be awaited."""

    def __init__(self, key: str, message: Message) -> None:
        self.key = key
        self.payload = codec.encode(message)
        self.arrived = time.monotonic()
        self._loop = asyncio.get_running_loop()
        self.answer: asyncio.Future[bytes | None] = self._loop.create_future()

    def reply(self, payload: bytes, lane: int = 0) -> None:
        self._loop.call_soon_threadsafe(self._settle, payload)

    def drop(self) -> None:
        self._loop.call_soon_threadsafe(self._settle, None)

    def _settle(self, payload: bytes | None) -> None:
        if not self.answer.done():
            self.answer.set_result(payload)

    async def message(self) -> Any:
        """The answer; None when the query was ended without one."""
        payload = await asyncio.wait_for(self.answer, 20)
        if payload is None:
            return None
        decoder: Any = {"gw": codec.gateway_replies, "ops": codec.operator_replies}.get(
            self.key.split("/")[3], codec.worker_replies
        )
        return codec.decode(decoder, payload)


class World:
    """A service on a store in a folder, asked directly."""

    def __init__(self, root: Path, settings: CoreSettings) -> None:
        self.root = root
        self.store = Store(root / "db")
        self.blobs = BlobStore(root / "blobs")
        self.uploads = Uploads()
        self.answers = Answers(root / "db", self.blobs, self.uploads)
        source = SplitSource(data=None, secret=b"s" * 32)
        intake = Intake(IDENTITY, self.blobs, source, self.uploads, allowed_imports=(), denied_imports=())
        self.service = Service("c", self.store, self.answers, intake, settings)
        self.writes = 0
        self.full = False
        write = self.store.write

        def counted(rows: Any) -> None:
            if self.full:
                raise StorageError("database or disk is full")
            self.writes += 1
            write(rows)

        self.store.write = counted  # type: ignore[method-assign]

    def ask(self, *asked: Asked) -> None:
        """One tick."""
        self.service.on_queries(list(asked))  # type: ignore[arg-type]

    async def create(self, key: str = "run") -> operator.RunCreated:
        settings = RunSettings(env="toy/line", entry="e", model="m", exp_id="x", budget=100)
        asked = Asked(
            keys.operator_key("c", "create"), operator.CreateRun(token="operate", key=key, settings=settings)
        )
        self.ask(asked)
        created = await asked.message()
        assert isinstance(created, operator.RunCreated), created
        return created

    def submit(self, created: operator.RunCreated, key: str) -> Asked:
        message = gateway.Submit(
            run=created.run,
            token=created.capability,
            key=key,
            env_instances=(0, 1),
            bundle=None,
            bundle_error=FAILURE,
        )
        return Asked(keys.gateway_key("c", created.run, "submit"), message)

    def state(self, created: operator.RunCreated) -> Asked:
        message = gateway.StateRequest(run=created.run, token=created.capability)
        return Asked(keys.gateway_key("c", created.run, "state"), message)


def register(world: World) -> Asked:
    """A worker of one slot registers."""
    description = EnvironmentDescription(
        env="toy/line", env_version="1", obs_space={}, action_space={}, max_episode_steps=1, task_text=""
    )
    message = worker.Register(
        worker="w",
        token="join",
        protocol=codec.WIRE_VERSION,
        slots=1,
        tiers=("bwrap",),
        environments=(description,),
        fingerprint=worker.Fingerprint(code_version="", python="", packages={}, cpu=""),
    )
    asked = Asked(keys.worker_key("c", "register"), message)
    world.ask(asked)
    return asked


def play(
    root: Path, scenario: Callable[[World], Awaitable[None]], settings: CoreSettings = SETTINGS
) -> World:
    async def run() -> World:
        world = World(root, settings)
        await world.service.start()
        try:
            await asyncio.wait_for(scenario(world), 30)
        finally:
            await world.service.stop()
            world.store.close()
        return world

    return asyncio.run(run())


def test_all_events_of_a_tick_share_one_write(tmp_path: Path) -> None:
    async def scenario(world: World) -> None:
        runs = [await world.create(f"run-{n}") for n in range(20)]
        before = world.writes
        asked = [world.submit(created, "key") for created in runs]
        world.ask(*asked)
        for one in asked:
            assert isinstance(await one.message(), gateway.SubmitAccepted)
        assert world.writes == before + 1

    play(tmp_path, scenario)


def test_what_was_answered_is_there_after_a_restart(tmp_path: Path) -> None:
    kept: list[operator.RunCreated] = []

    async def first(world: World) -> None:
        kept.append(await world.create())
        asked = world.submit(kept[0], "key")
        world.ask(asked)
        assert (await asked.message()).remaining_budget == 98

    async def second(world: World) -> None:
        assert await world.create() == kept[0]
        asked = world.state(kept[0])
        world.ask(asked)
        assert (await asked.message()).state.remaining_budget == 98

    play(tmp_path, first)
    play(tmp_path, second)


def test_request_that_could_not_be_written_did_not_happen_and_can_be_asked_again(tmp_path: Path) -> None:
    async def scenario(world: World) -> None:
        created = await world.create()
        world.full = True
        lost = world.submit(created, "key")
        world.ask(lost)
        assert await lost.message() is None
        waiting, told = world.state(created), world.submit(created, "key")
        world.ask(waiting, told)
        assert await waiting.message() is None
        refused = await told.message()
        assert refused.status == "unavailable"
        assert "cannot write its store" in refused.message
        assert "disk is full" not in refused.message
        settings = RunSettings(env="toy/line", entry="e", model="m", exp_id="x")
        creating = Asked(
            keys.operator_key("c", "create"),
            operator.CreateRun(token="operate", key="other", settings=settings),
        )
        world.ask(creating)
        assert "disk is full" in (await creating.message()).message
        world.full = False
        while (answer := await asked_again(world, created)) is None or isinstance(answer, worker.Refused):
            await asyncio.sleep(0.02)
        assert isinstance(answer, gateway.SubmitAccepted)
        assert answer.submit_index == 0
        assert answer.remaining_budget == 98

    async def asked_again(world: World, created: operator.RunCreated) -> Any:
        asked = world.submit(created, "key")
        world.ask(asked)
        return await asked.message()

    play(tmp_path, scenario)


def test_core_that_fails_is_loaded_anew_and_others_are_served_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handle = Core.handle

    def stumble(core: Core, event: Any, now: float) -> Any:
        if getattr(event, "key", "") == "poison":
            raise ZeroDivisionError("planted")
        return handle(core, event, now)

    monkeypatch.setattr(Core, "handle", stumble)

    async def scenario(world: World) -> None:
        created = await world.create()
        poison = world.submit(created, "poison")
        world.ask(poison)
        assert await poison.message() is None
        while True:
            asked = world.submit(created, "good")
            world.ask(asked)
            if isinstance(answer := await asked.message(), gateway.SubmitAccepted):
                break
            await asyncio.sleep(0.02)
        assert answer.remaining_budget == 98

    play(tmp_path, scenario)


def test_stopping_answers_what_was_handled_and_ends_every_wait(tmp_path: Path) -> None:
    async def scenario(world: World) -> None:
        created = await world.create()
        wait = operator.WaitRun(token="operate", run=created.run, wait_s=60)
        waiting = Asked(keys.operator_key("c", "wait"), wait)
        accepted = world.submit(created, "key")
        world.ask(waiting, accepted)
        await world.service.stop()
        assert isinstance(await accepted.message(), gateway.SubmitAccepted)
        assert await waiting.message() is None
        late = world.state(created)
        world.ask(late)
        assert await late.message() is None

    play(tmp_path, scenario)


def test_a_disk_that_does_not_come_to_an_end_is_named_in_status_and_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario(world: World) -> None:
        goes_on = threading.Event()
        write = world.store.write

        def hanging(rows: Any) -> None:
            assert goes_on.wait(60)
            write(rows)

        world.store.write = hanging  # type: ignore[method-assign]
        settings = RunSettings(env="toy/line", entry="e", model="m", exp_id="x")
        create = operator.CreateRun(token="operate", key="k", settings=settings)
        created = Asked(keys.operator_key("c", "create"), create)
        world.ask(created)
        stalls: tuple[str, ...] = ()
        while not stalls:
            status = Asked(keys.operator_key("c", "status"), operator.StatusRequest(token="operate"))
            world.ask(status)
            stalls = (await status.message()).stalls
            await asyncio.sleep(0.01)
        assert re.fullmatch("1 requests wait for the disk: it has been writing for .* s", stalls[0])
        with capture_logs() as logs:
            monkeypatch.setattr(service, "log", structlog.get_logger())
            world.service._tell_stalls()
        assert [entry["first"] for entry in logs] == [stalls[:1]]
        assert not created.answer.done()
        goes_on.set()
        assert isinstance(await created.message(), operator.RunCreated)

    play(tmp_path, scenario, CoreSettings(stall_s=0.1))


def test_long_poll_ends_by_itself(tmp_path: Path) -> None:
    async def scenario(world: World) -> None:
        registering = register(world)
        session = (await registering.message()).session
        polling = Asked(
            keys.worker_key("c", "lease"),
            worker.LeaseRequest(worker="w", session=session, n=1, wait_s=0.05),
        )
        world.ask(polling)
        assert await polling.message() == worker.Leases(leases=())

    play(tmp_path, scenario)


def test_a_clock_set_back_between_two_starts_ends_nothing_before_it_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began: list[float] = []

    async def first(world: World) -> None:
        await world.create()
        began.append(world.service.now())

    async def second(world: World) -> None:
        assert world.service.now() >= began[0] - 60.0

    true_time = time.time
    play(tmp_path, first)
    monkeypatch.setattr(time, "time", lambda: true_time() - 5 * 3600.0)
    play(tmp_path, second)


def test_a_poll_that_its_worker_gave_up_while_the_loop_stood_still_gets_no_lease(tmp_path: Path) -> None:
    async def scenario(world: World) -> None:
        session = (await register(world).message()).session
        created = await world.create()
        request = worker.LeaseRequest(worker="w", session=session, n=1, wait_s=10.0)
        stale, fresh = (Asked(keys.worker_key("c", "lease"), request) for _ in range(2))
        stale.arrived -= 12.0
        bundle = world.blobs.put(b"a bundle")
        world.uploads.note(created.run, bundle)
        submit = gateway.Submit(
            run=created.run,
            token=created.capability,
            key="k",
            env_instances=(0,),
            bundle=bundle,
            bundle_error=None,
        )
        world.ask(Asked(keys.gateway_key("c", created.run, "submit"), submit), stale, fresh)
        assert await stale.message() == worker.Leases(leases=())
        assert len((await fresh.message()).leases) == 1

    play(tmp_path, scenario)
