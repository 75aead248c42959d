"""The service around the core without a network: asked directly, and answered."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

from evopolicy_common.errors import StorageError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import PolicyFailure
from evopolicy_common.messages.run_settings import RunSettings
from evopolicy_common.messages.status import StatusRequest
from evopolicy_common.messages.worker import Message
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.wire import codec, keys
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.server.definitions import Definitions
from evopolicy_coordinator.server.reader import ServiceReader
from evopolicy_coordinator.server.request_parser import RequestParser
from evopolicy_coordinator.server.run_requests import RunRequests
from evopolicy_coordinator.server.service import Service
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.splits import SplitSource
from evopolicy_coordinator.storage.state_folder import ROLES, Identity
from evopolicy_coordinator.storage.store import Store

IDENTITY = Identity(
    cluster="c", passwords=dict.fromkeys(ROLES, "p"), worker_token="join", operator_token="operate"
)
SETTINGS = CoreSettings()
FAILURE = PolicyFailure(category="missing_policy", step_index=None, message="no policy.py")


class Requested:
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
    """A service on a store in a folder, asked directly. With `data` its cases come from files."""

    def __init__(
        self,
        root: Path,
        settings: CoreSettings,
        *,
        data: Path | None = None,
        allowed_imports: Sequence[str] = (),
        denied_imports: Sequence[str] = (),
    ) -> None:
        self.root = root
        self.store = Store(root / "db")
        self.blobs = BlobStore(root / "blobs")
        self.uploads = Uploads()
        self.reader = ServiceReader(root / "db", self.blobs, self.uploads, root)
        source = SplitSource(data=data, secret=b"s" * 32)
        imports = {"allowed_imports": tuple(allowed_imports), "denied_imports": tuple(denied_imports)}
        runs = RunRequests(self.reader, self.blobs, source, **imports)
        parser = RequestParser(IDENTITY, self.blobs, self.uploads, runs, Machines(root), Definitions())
        self.service = Service("c", self.store, self.reader, parser, settings)
        self.writes = 0
        self.full = False
        write = self.store.write

        def counted(rows: Any) -> None:
            if self.full:
                raise StorageError("database or disk is full")
            self.writes += 1
            write(rows)

        self.store.write = counted  # type: ignore[method-assign]

    def ask(self, *asked: Requested) -> None:
        """One tick."""
        self.service.on_queries(list(asked))  # type: ignore[arg-type]

    async def answer(self, *asked: Requested) -> Any:
        """One tick; gives the answer to the last query."""
        self.ask(*asked)
        return await asked[-1].message()

    async def status(self, **more: Any) -> Any:
        message = StatusRequest(token="operate", **more)
        return await self.answer(Requested(keys.operator_key("c", "status"), message))

    def creating(self, key: str = "run", *, proof: str = "", **settings: Any) -> Requested:
        """An operator asks for a run."""
        known = {"env": "toy/line", "entry": "e", "model": "m", "exp_id": "x", "budget": 100, **settings}
        wanted = RunSettings(**known)
        message = operator.CreateRun(token="operate", key=key, settings=wanted, replay_key=proof)
        return Requested(keys.operator_key("c", "create"), message)

    async def create(self, key: str = "run") -> operator.RunCreated:
        created = await self.answer(self.creating(key))
        assert isinstance(created, operator.RunCreated), created
        return created

    def cancelling(self, run: str) -> Requested:
        return Requested(keys.operator_key("c", "cancel"), operator.CancelRun(token="operate", run=run))

    def waiting(self, run: str, wait_s: float) -> Requested:
        """An operator waits for the run's end."""
        message = operator.WaitRun(token="operate", run=run, wait_s=wait_s)
        return Requested(keys.operator_key("c", "wait"), message)

    def submit(self, created: operator.RunCreated, key: str, **more: Any) -> Requested:
        """A submit of two episodes without a policy, unless told otherwise."""
        usual = {"env_instances": (0, 1), "bundle": None}
        usual |= {} if more.get("bundle") else {"bundle_error": FAILURE}
        message = gateway.Submit(run=created.run, token=created.capability, key=key, **usual | more)
        return Requested(keys.gateway_key("c", created.run, "submit"), message)

    def state(self, created: operator.RunCreated) -> Requested:
        message = gateway.StateRequest(run=created.run, token=created.capability)
        return Requested(keys.gateway_key("c", created.run, "state"), message)


def register(world: World) -> Requested:
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
    asked = Requested(keys.worker_key("c", "register"), message)
    world.ask(asked)
    return asked


@contextlib.asynccontextmanager
async def started(root: Path, settings: CoreSettings = SETTINGS) -> AsyncIterator[World]:
    """A world whose service runs, for 30 seconds at most."""
    world = World(root, settings)
    await world.service.start()
    try:
        async with asyncio.timeout(30):
            yield world
    finally:
        await world.service.stop()
        world.store.close()
