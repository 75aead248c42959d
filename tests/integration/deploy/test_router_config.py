"""A site's router, opened from the file that `evopolicy-coordinator router-config` writes, between real sessions over
TLS."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
import zenoh
from attacks.eavesdropper import eavesdropping
from machines.answering import KEYS, Asked, answered
from machines.own_certs import CLUSTER, OwnCerts, free_port
from typer.testing import CliRunner
from waiting import eventually

from evopolicy_common.errors import ConfigError, TransportError
from evopolicy_common.wire import credentials, keys, transport
from evopolicy_common.wire.credentials import Role
from evopolicy_common.wire.transport import Link
from evopolicy_coordinator.cli.main import app
from evopolicy_coordinator.cli.router_config import router_config
from evopolicy_coordinator.pki.machines import Machines


class Site:
    """A coordinator's certificates, and a router of a site where a worker and an operator belong, and one worker does
    not."""

    def __init__(self, root: Path) -> None:
        self.certs = OwnCerts(root)
        self.folder = self.certs.issue("router", "site")
        self.endpoint = f"tls/127.0.0.1:{free_port()}"
        self.folders = {
            "worker": self.certs.issue("worker", "here"),
            "gateway": self.certs.issue("operator", "desk"),
            "operator": self.certs.root / "operator-desk",
        }
        self.elsewhere = self.certs.issue("worker", "elsewhere")
        self.configure("worker/here", "gateway/desk", "operator/desk")

    def configure(self, *admit: str) -> None:
        state, places = self.certs.state, {"listen": [self.endpoint], "connect": [self.certs.endpoint]}
        router_config("site", self.folder, state, **places, admit=list(admit))

    @contextlib.asynccontextmanager
    async def up(self, alive: list[tuple[str, bool]] | None = None) -> AsyncIterator[list[str]]:
        """Coordinator and router; yields the keys that the coordinator is asked."""
        asked = Asked()
        machines = Machines(self.certs.state)
        machines.write_passwords()
        assert machines.tls is not None
        listed = [(machine.role, machine.identity) for machine in machines.admitted()]
        config = transport.server_config(
            CLUSTER, [self.certs.endpoint], machines.passwords, listed, machines.tls
        )
        async with transport.serve(config, asked) as server, open_router(self.folder):
            server.declare(keys.requests(CLUSTER).values())
            if alive is not None:
                server.watch_liveliness(
                    keys.liveliness_key(CLUSTER, "*"), lambda key, up: alive.append((key, up))
                )
            yield asked

    def link(self, role: Role, folder: Path | None = None) -> contextlib.AbstractAsyncContextManager[Link]:
        """A session of a machine of the site, which knows the site's router only."""
        found = credentials.find(role, (self.endpoint,), folder or self.folders[role])
        return transport.connect(found, timeout_s=30.0)


@contextlib.asynccontextmanager
async def open_router(folder: Path) -> AsyncIterator[None]:
    """What zenohd is: a session in router mode of the folder's file."""
    session = await asyncio.to_thread(zenoh.open, zenoh.Config.from_file(str(folder / "zenohd.json")))
    try:
        yield
    finally:
        await asyncio.to_thread(session.close)


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


@pytest.mark.parametrize("role", ["worker", "gateway", "operator"])
async def test_a_sites_router_answers_a_role_on_its_keys_only(site: Site, role: Role) -> None:
    async with site.up() as asked, site.link(role) as link:
        assert await answered(link, KEYS[role], attempts=300)
        for owner, key in KEYS.items():
            assert await answered(link, key) == (owner == role), key
        assert set(asked) == {KEYS[role]}


async def test_a_machine_of_another_site_is_not_let_in(site: Site) -> None:
    async with site.up() as asked:
        found = credentials.find("worker", (site.endpoint,), site.elsewhere)
        with pytest.raises(TransportError, match="credentials"):
            async with transport.connect(found, timeout_s=1.0):
                pass
        assert asked == []


async def test_no_machine_answers_or_overhears_another_behind_the_same_router(site: Site) -> None:
    found = credentials.find("gateway", (site.endpoint,), site.folders["gateway"])
    async with (
        site.up(),
        site.link("gateway") as honest,
        eavesdropping(found, keys.requests(CLUSTER)["gateway"]) as overheard,
    ):
        assert await answered(honest, KEYS["gateway"], attempts=300)
        for _ in range(20):
            assert await answered(honest, KEYS["gateway"])
        assert overheard == []


async def test_a_workers_liveliness_is_seen_through_the_router_and_no_one_elses(site: Site) -> None:
    alive: list[tuple[str, bool]] = []
    true, false = (keys.liveliness_key(CLUSTER, name) for name in ("here", "desk"))
    async with site.up(alive):
        async with site.link("gateway") as pretender, site.link("worker") as worker:
            assert await answered(pretender, KEYS["gateway"], attempts=300)
            pretender.declare_alive(false)
            worker.declare_alive(true)
            await eventually(lambda: alive == [(true, True)])
        await eventually(lambda: alive == [(true, True), (true, False)])


async def test_a_restarted_router_carries_on(site: Site) -> None:
    async with contextlib.AsyncExitStack() as stack:
        async with site.up():
            link = await stack.enter_async_context(site.link("worker"))
            assert await answered(link, KEYS["worker"], attempts=300)
        assert not await answered(link, KEYS["worker"])
        async with site.up():
            assert await answered(link, KEYS["worker"], attempts=300)


def test_the_file_holds_the_coordinators_own_rules(site: Site) -> None:
    document = json.loads((site.folder / "zenohd.json").read_text())
    admitted = [
        (machine.role, machine.identity)
        for machine in Machines(site.certs.state).admitted()
        if machine.name in ("here", "desk")
    ]
    own = transport.access_control(CLUSTER, admitted)
    rights = document["access_control"]
    for part in ("rules", "subjects", "policies"):
        assert rights[part][: len(own[part])] == own[part]
    assert rights["default_permission"] == "deny"
    assert document["adminspace"] == {"enabled": False}
    assert document["scouting"] == {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    # What is added: towards the coordinator the same, the other way round, and no one else has it.
    added = rights["rules"][len(own["rules"]) :]
    for rule, above in zip(own["rules"], added, strict=True):
        assert {**above, "id": rule["id"], "flows": rule["flows"]} == rule
        assert {*rule["flows"], *above["flows"]} == {"ingress", "egress"}
    assert rights["subjects"][len(own["subjects"]) :] == [
        {"id": "uplink", "cert_common_names": ["coordinator"], "link_protocols": ["tls"]}
    ]


def test_the_router_is_given_the_passwords_of_its_own_site_only(site: Site) -> None:
    users = {line.partition(":")[0] for line in (site.folder / "passwords").read_text().splitlines()}
    assert users == {"worker/here", "gateway/desk", "operator/desk", "nobody"}
    for name in ("passwords", "zenohd.json"):
        assert (site.folder / name).stat().st_mode & 0o077 == 0


def test_the_command_writes_paths_of_the_routers_host(site: Site) -> None:
    arguments = ["router-config", "site", "--folder", str(site.folder), "--state", str(site.certs.state)]
    done = CliRunner().invoke(app, [*arguments, "--installed-at", "/etc/evopolicy/router"])
    assert done.exit_code == 0, done.output
    assert "zenohd --config /etc/evopolicy/router/zenohd.json" in done.output
    assert "worker/elsewhere" in done.output
    document = json.loads((site.folder / "zenohd.json").read_text())
    assert document["transport"]["auth"]["usrpwd"]["dictionary_file"] == "/etc/evopolicy/router/passwords"
    assert document["transport"]["link"]["tls"]["listen_private_key"] == "/etc/evopolicy/router/key.pem"
    assert document["listen"] == {"endpoints": ["tls/0.0.0.0:7447"]}
    assert str(site.certs.state) not in msgspec.json.encode(document).decode()


def test_a_revoked_router_gets_no_file(site: Site) -> None:
    site.certs.revoke("router/site")
    with pytest.raises(ConfigError, match="not admitted"):
        router_config("site", site.folder, site.certs.state)
