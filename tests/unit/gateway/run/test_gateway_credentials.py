"""With which credentials a gateway speaks for its run: the run's own, or those of the machine that took it over."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from rigs.finished_run import mark_opened

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials, TlsFiles
from evopolicy_gateway.run import gateway
from evopolicy_gateway.run.operations import find_credentials
from evopolicy_gateway.run_folder.layout import RunFolder

RUNS_OWN = Credentials(
    cluster="c",
    role="gateway",
    endpoints=("unixsock-stream/sock",),
    user="gateway",
    password="p",
    token="capability",
)


def machines_folder(folder: Path) -> Path:
    """As `certs issue operator` makes it: two roles side by side."""
    folder.mkdir()
    for name in ("ca.pem", "cert.pem", "key.pem", "gateway-cert.pem", "gateway-key.pem"):
        write_atomically(folder / name, b"PEM", mode=0o600)
    roles: tuple[tuple[credentials.Role, str], ...] = (("operator", ""), ("gateway", "gateway-"))
    for role, prefix in roles:
        files = TlsFiles(root_ca="ca.pem", certificate=f"{prefix}cert.pem", private_key=f"{prefix}key.pem")
        own = msgspec.structs.replace(
            RUNS_OWN, role=role, user=f"{role}/m", token="", endpoints=("tls/lab:7447",), tls=files
        )
        credentials.write(own, folder / f"{role}.json")
    return folder


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "run")
    folder.state.mkdir(parents=True)
    mark_opened(folder)
    credentials.write(RUNS_OWN, folder.credentials)
    return folder


def test_a_gateway_speaks_with_its_runs_credentials(run: RunFolder) -> None:
    assert gateway._load(run) == (RUNS_OWN, "r-1")


def test_a_runs_secrets_do_not_cross_a_network_in_the_clear(run: RunFolder) -> None:
    there = msgspec.structs.replace(RUNS_OWN, endpoints=("tcp/10.0.0.5:7447",))
    credentials.write(there, run.credentials)
    with pytest.raises(ConfigError, match="unencrypted"):
        gateway._load(run)


@pytest.mark.parametrize("named", ["m", "m/operator.json"])
def test_an_operators_folder_starts_gateways_with_rights_of_their_own(tmp_path: Path, named: str) -> None:
    machines_folder(tmp_path / "m")
    operator, gateways = find_credentials((), tmp_path / named)
    assert (operator.user, gateways.user) == ("operator/m", "gateway/m")
    assert operator.tls is not None
    assert gateways.tls is not None
    assert operator.tls.private_key != gateways.tls.private_key
