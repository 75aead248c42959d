"""Who gets in over TLS, and how far: real sessions with wrong certificates beside an honest worker that is served.

Attacks, each with its defence:
- uses another worker's password, or that of the coordinator's local workers: a user has rights with its own
  certificate only; local passwords are unknown at the TLS listener.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import json
import shutil
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import msgspec
import pytest
import zenoh
from machines.answering import KEYS, Asked, answered
from machines.own_certs import CLUSTER, DAYS, OwnCerts, now, of
from waiting import eventually

from evopolicy_common.errors import ConfigError, TransportError
from evopolicy_common.wire import keys, transport
from evopolicy_common.wire.credentials import Credentials, Role
from evopolicy_common.wire.transport import IncomingQuery, Link
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.server.remote_listener import remote_listener


@contextlib.asynccontextmanager
async def coordinator(certs: OwnCerts) -> AsyncIterator[list[str]]:
    """The coordinator's listener for other machines, which answers every key; yields the keys it was asked."""
    asked = Asked()
    machines = Machines(certs.state)
    async with remote_listener(CLUSTER, (certs.endpoint,), machines, asked, lambda key, alive: None):
        yield asked


async def gets_in(credentials: Credentials, timeout_s: float = 0.5) -> bool:
    try:
        async with transport.connect(credentials, timeout_s=timeout_s):
            return True
    except TransportError:
        return False


async def stops_being_answered(link: Link) -> bool:
    return not await answered(link, KEYS["worker"])


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> OwnCerts:
    """Machines of one cluster: a worker, another, a gateway, an operator, one whose certificate is over."""
    made = OwnCerts(tmp_path_factory.mktemp("certs"))
    for name in ("honest", "other"):
        made.issue("worker", name)
    made.issue("operator", "boss")
    made.issue("gateway", "g")
    made.issue("worker", "late", now() - dt.timedelta(days=31))
    return made


def folder(certs: OwnCerts, name: str) -> Path:
    return certs.root / name


def with_certificate_of(credentials: Credentials, other: Credentials) -> Credentials:
    return msgspec.structs.replace(credentials, tls=other.tls)


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("worker-honest", "worker"),
        ("gateway-g", "gateway"),
        ("operator-boss", "operator"),
        ("operator-boss", "gateway"),
    ],
)
async def test_a_machine_is_answered_on_the_keys_of_its_role_only(
    certs: OwnCerts, name: str, role: Role
) -> None:
    """Attack: combines a gateway's certificate with a worker's user. Defence: a user has rights with its
    own certificate only."""
    async with (
        coordinator(certs) as asked,
        transport.connect(of(folder(certs, name), role), timeout_s=30) as link,
    ):
        for owner, key in KEYS.items():
            assert await answered(link, key) == (owner == role), key
        assert asked == [KEYS[role]]


def refused_clients(certs: OwnCerts, tmp_path: Path) -> dict[str, Credentials]:
    """Cheats that do not get a session."""
    honest = of(folder(certs, "worker-honest"))
    foreign = OwnCerts(tmp_path / "foreign")
    assert honest.tls is not None
    stranger = of(foreign.issue("worker", "honest"))
    assert stranger.tls is not None
    trusting = msgspec.structs.replace(stranger.tls, root_ca=honest.tls.root_ca)
    others = of(folder(certs, "worker-other")).password
    return {
        "a certificate of another authority": with_certificate_of(honest, stranger),
        "that, and trust in ours": msgspec.structs.replace(honest, tls=trusting),
        "an expired certificate": of(folder(certs, "worker-late")),
        "a wrong password": msgspec.structs.replace(honest, password="wrong"),
        "another worker's password": msgspec.structs.replace(honest, password=others),
        "the user of this machine's own workers": msgspec.structs.replace(honest, user="worker"),
    }


async def test_who_has_no_good_certificate_and_password_gets_no_session(
    certs: OwnCerts, tmp_path: Path
) -> None:
    """Attack: shows a certificate of another authority, or one that has expired. Defence: the TLS handshake; an
    open link ends when its certificate does."""
    async with (
        coordinator(certs) as asked,
        transport.connect(of(folder(certs, "worker-honest"))) as honest,
    ):
        for cheat, credentials in refused_clients(certs, tmp_path).items():
            assert not await gets_in(credentials), cheat
        assert asked == []
        assert await answered(honest, KEYS["worker"])


@pytest.mark.parametrize("plain", [True, False], ids=["tcp", "tls"])
async def test_who_shows_no_certificate_gets_no_session(certs: OwnCerts, plain: bool) -> None:
    """Attack: connects without a certificate or without TLS. Defence: the TLS handshake."""
    honest = of(folder(certs, "worker-honest"))
    assert honest.tls is not None
    config = zenoh.Config()
    endpoint = certs.endpoint.replace("tls/", "tcp/") if plain else certs.endpoint
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 500,
        "scouting/multicast/enabled": False,
        "transport/auth/usrpwd/user": honest.user,
        "transport/auth/usrpwd/password": honest.password,
        "transport/link/tls/root_ca_certificate": honest.tls.root_ca,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    async with coordinator(certs) as asked, transport.connect(honest) as link:
        with pytest.raises(zenoh.ZError):
            await asyncio.to_thread(zenoh.open, config)
        assert asked == []
        assert await answered(link, KEYS["worker"])


@pytest.mark.parametrize("cheat", ["gateway-g", "worker-other", "operator-boss"])
async def test_a_user_with_another_machines_certificate_is_answered_nothing(
    certs: OwnCerts, cheat: str
) -> None:
    """A gateway's certificate that pretends to be a worker: with the worker's password, and with its own."""

    honest = of(folder(certs, "worker-honest"))
    role: Role = "gateway" if cheat == "gateway-g" else "worker" if cheat == "worker-other" else "operator"
    own = of(folder(certs, cheat), role)
    async with coordinator(certs) as asked, transport.connect(honest) as link:
        async with transport.connect(with_certificate_of(honest, own)) as stolen_password:
            for key in KEYS.values():
                assert not await answered(stolen_password, key)
            stolen_password.declare_alive(keys.liveliness_key(CLUSTER, "honest"))
        async with transport.connect(with_certificate_of(own, honest)) as stolen_certificate:
            for key in KEYS.values():
                assert not await answered(stolen_certificate, key)
        assert asked == []
        assert await answered(link, KEYS["worker"])


async def test_a_machines_certificate_cannot_stand_in_for_the_coordinators(certs: OwnCerts) -> None:
    """Attack: impersonates the coordinator with a worker's certificate, or one for another host. Defence:
    machine certificates are not valid for servers; the dialled name must be in the certificate."""
    honest, other = of(folder(certs, "worker-honest")), of(folder(certs, "worker-other"))
    assert other.tls is not None
    passwords, admitted = Machines(certs.state).passwords, [("worker", "worker/honest")]
    config = transport.server_config(CLUSTER, [certs.endpoint], passwords, admitted, other.tls)
    Machines(certs.state).write_passwords()
    heard: list[IncomingQuery] = []
    async with transport.serve(config, heard.extend) as server:
        server.declare([keys.requests(CLUSTER)["worker"]])
        assert not await gets_in(honest)
        assert heard == []
    async with coordinator(certs):
        assert await gets_in(honest, 30.0)


async def test_a_coordinator_that_is_not_named_in_its_certificate_is_not_trusted(tmp_path: Path) -> None:
    """Attack: impersonates the coordinator with a worker's certificate, or one for another host. Defence:
    machine certificates are not valid for servers; the dialled name must be in the certificate."""
    elsewhere = OwnCerts(tmp_path / "c", hosts=("coordinator.lab", "10.1.2.3"))
    honest = of(elsewhere.issue("worker", "honest"))
    async with coordinator(elsewhere) as asked:
        assert not await gets_in(honest)
        assert asked == []


async def test_a_machine_is_admitted_and_revoked_while_the_coordinator_listens(tmp_path: Path) -> None:
    """Attack: presents a revoked certificate, on a new or open link. Defence: its user and name are
    removed; all links are closed, and only admitted machines can reconnect."""
    certs = OwnCerts(tmp_path / "c")
    honest = of(certs.issue("worker", "honest"))
    async with coordinator(certs) as asked, transport.connect(honest) as link:
        late = of(certs.issue("worker", "late"))
        async with transport.connect(late, timeout_s=30) as cheat:
            await eventually(lambda: answered(cheat, KEYS["worker"]))
            await eventually(lambda: answered(link, KEYS["worker"]))
            certs.revoke("late")
            await eventually(lambda: stops_being_answered(cheat))
            await eventually(lambda: answered(link, KEYS["worker"]))
            asked.clear()
            for _ in range(5):
                assert not await answered(cheat, KEYS["worker"])
            assert not cheat.connected
            assert asked == []
        assert not await gets_in(late)
        # Not even with a password that is still good.
        async with transport.connect(with_certificate_of(honest, late)) as stolen:
            assert not await answered(stolen, KEYS["worker"])
        assert await answered(link, KEYS["worker"])


async def test_the_last_revoked_machine_is_refused_without_a_user_too(tmp_path: Path) -> None:
    """Zenoh asks for no password where it knows none: the list must never be empty."""

    certs = OwnCerts(tmp_path / "c")
    only = of(certs.issue("worker", "only"))
    certs.revoke("only")
    async with coordinator(certs):
        assert not await gets_in(only)
        config = transport.client_config(only)
        for name in ("user", "password"):
            config.insert_json5(f"transport/auth/usrpwd/{name}", "null")
        with pytest.raises(zenoh.ZError):
            await asyncio.to_thread(zenoh.open, config)


async def test_a_folder_that_was_issued_again_voids_the_one_before(tmp_path: Path) -> None:
    """Attack: uses a folder that has since been replaced (`--renew`). Defence: password, token and session
    are invalid."""
    certs = OwnCerts(tmp_path / "c")
    before = of(certs.issue("worker", "w"))
    kept = tmp_path / "kept"
    assert before.tls is not None
    shutil.copytree(Path(before.tls.certificate).parent, kept)
    files = {"certificate": str(kept / "cert.pem"), "private_key": str(kept / "key.pem")}
    old_tls = msgspec.structs.replace(before.tls, **files)
    after = of(certs.issue("worker", "w", again=True))
    async with coordinator(certs):
        assert not await gets_in(msgspec.structs.replace(before, tls=old_tls))
        async with transport.connect(after) as link:
            assert await answered(link, KEYS["worker"])


async def test_an_open_link_ends_with_its_certificate(tmp_path: Path) -> None:
    """Attack: shows a certificate of another authority, or one that has expired. Defence: the TLS handshake; an
    open link ends when its certificate does."""
    certs = OwnCerts(tmp_path / "c")
    honest = of(certs.issue("worker", "honest"))
    async with coordinator(certs), transport.connect(honest, timeout_s=30) as link:
        for life_s in (4, 16, 64):  # a slow machine may not come in before the shorter ones are over
            made = now() - dt.timedelta(days=DAYS) + dt.timedelta(seconds=life_s)
            brief = of(certs.issue("worker", f"brief-{life_s}", made))
            with contextlib.suppress(TransportError):
                async with transport.connect(brief, timeout_s=life_s) as ending:
                    while now() < made + dt.timedelta(days=DAYS):
                        if await answered(ending, KEYS["worker"]):
                            await eventually(partial(stops_being_answered, ending), timeout_s=200.0)
                            assert now() >= made + dt.timedelta(days=DAYS)
                            assert await answered(link, KEYS["worker"])
                            return
                        await asyncio.sleep(0.05)
    raise AssertionError("no certificate lived long enough to come in")


async def test_listening_for_other_machines_needs_certificates(tmp_path: Path) -> None:
    given = (CLUSTER, ("tls/127.0.0.1:1",), Machines(tmp_path), lambda queries: None, lambda key, alive: None)
    with pytest.raises(ConfigError, match="certs init"):
        async with remote_listener(*given):
            pass
