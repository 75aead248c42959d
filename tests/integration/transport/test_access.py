"""Real Zenoh sessions against the access rules that the coordinator listens with."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import zenoh
from attacks.eavesdropper import eavesdropping
from machines.answering import KEYS, Asked, answered
from machines.own_certs import CLUSTER
from waiting import eventually

from evopolicy_common.errors import TransportError
from evopolicy_common.wire import keys, transport
from evopolicy_common.wire.credentials import Credentials, Role

PASSWORDS: dict[Role, str] = {"worker": "w-secret", "gateway": "g-secret", "operator": "o-secret"}


def credentials(folder: Path, role: Role, password: str | None = None) -> Credentials:
    place, word = (f"unixsock-stream/{folder}/sock",), password or PASSWORDS[role]
    return Credentials(cluster=CLUSTER, role=role, endpoints=place, user=role, password=word, token="")


def config_of(folder: Path) -> zenoh.Config:
    (folder / "passwords").write_text("".join(f"{user}:{word}\n" for user, word in PASSWORDS.items()))
    users = [(role, role) for role in PASSWORDS]
    return transport.server_config(CLUSTER, [f"unixsock-stream/{folder}/sock"], folder / "passwords", users)


@contextlib.asynccontextmanager
async def coordinator(folder: Path) -> AsyncIterator[list[str]]:
    """A listening session that answers every key of the cluster with its own name; yields the keys it was asked."""
    asked = Asked()
    async with transport.serve(config_of(folder), asked) as server:
        server.declare(keys.requests(CLUSTER).values())
        yield asked


@pytest.mark.parametrize("role", ["worker", "gateway", "operator"])
async def test_a_role_is_answered_on_its_own_keys_only(tmp_path: Path, role: Role) -> None:
    async with coordinator(tmp_path) as asked, transport.connect(credentials(tmp_path, role)) as link:
        for owner, key in KEYS.items():
            assert await answered(link, key) == (owner == role), key
        assert asked == [KEYS[role]]


@pytest.mark.parametrize(("role", "password"), [("worker", "wrong"), ("gateway", PASSWORDS["worker"])])
async def test_a_wrong_password_is_not_let_in(tmp_path: Path, role: Role, password: str) -> None:
    async with coordinator(tmp_path) as asked:
        with pytest.raises(TransportError, match="credentials"):
            async with transport.connect(credentials(tmp_path, role, password), timeout_s=1.0):
                pass
        assert asked == []


async def test_a_session_without_password_is_not_let_in(tmp_path: Path) -> None:
    async with coordinator(tmp_path) as asked:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["unixsock-stream/{tmp_path}/sock"]')
        config.insert_json5("connect/timeout_ms", "1000")
        config.insert_json5("scouting/multicast/enabled", "false")
        with pytest.raises(zenoh.ZError):
            await asyncio.to_thread(zenoh.open, config)
        assert asked == []


async def test_one_gateway_cannot_answer_or_overhear_another(tmp_path: Path) -> None:
    own = credentials(tmp_path, "gateway")
    async with (
        coordinator(tmp_path),
        transport.connect(own) as honest,
        eavesdropping(own, keys.requests(CLUSTER)["gateway"]) as overheard,
    ):
        await asyncio.sleep(0.3)
        for _ in range(20):
            assert await answered(honest, KEYS["gateway"])
        assert overheard == []


async def test_only_a_worker_can_claim_to_be_alive(tmp_path: Path) -> None:
    seen: list[tuple[str, bool]] = []
    key = keys.liveliness_key(CLUSTER, "w1")
    async with transport.serve(config_of(tmp_path), lambda queries: None) as server:
        all_workers = keys.liveliness_key(CLUSTER, "*")
        server.watch_liveliness(all_workers, lambda name, alive: seen.append((name, alive)))
        async with transport.connect(credentials(tmp_path, "gateway")) as link:
            link.declare_alive(key)
            await asyncio.sleep(0.2)
            assert seen == []
        async with transport.connect(credentials(tmp_path, "worker")) as link:
            link.declare_alive(key)
            await eventually(lambda: seen == [(key, True)])
        await eventually(lambda: seen == [(key, True), (key, False)])


async def test_a_client_finds_its_way_back_to_a_restarted_coordinator(tmp_path: Path) -> None:
    async with contextlib.AsyncExitStack() as stack:
        async with coordinator(tmp_path):
            link = await stack.enter_async_context(transport.connect(credentials(tmp_path, "worker")))
            assert await answered(link, KEYS["worker"])
        assert not await answered(link, KEYS["worker"])
        async with coordinator(tmp_path):
            await eventually(lambda: link.connected)
            for _ in range(100):
                if await answered(link, KEYS["worker"]):
                    return
                await asyncio.sleep(0.05)
            raise AssertionError("not answered after the restart")
