"""`evopolicy-coordinator certs`, as an operator meets it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest
from machines.own_certs import of

from evopolicy_common.errors import ConfigError
from evopolicy_coordinator.cli import certs as certs_cli
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.storage.state_folder import StateFolder


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an authority, made as the README says."""
    monkeypatch.chdir(tmp_path)
    certs_cli.init(state=tmp_path / "state", host=["lab.example", "10.0.0.5"])
    return tmp_path / "state"


def contents(state: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (state / "certs").iterdir()}


def test_init_overwrites_nothing_and_says_what_is_there(state: Path) -> None:
    before = contents(state)
    with pytest.raises(ConfigError, match=r"lab\.example.*until.*--renew.*--force"):
        certs_cli.init(state=state)
    assert contents(state) == before


def test_renewed_without_hosts_it_keeps_those_that_it_had(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    authority = (state / "certs" / "ca.pem").read_bytes()
    certs_cli.init(state=state, renew=True)
    assert "lab.example, 10.0.0.5, localhost" in capsys.readouterr().out
    assert (state / "certs" / "ca.pem").read_bytes() == authority
    certs_cli.init(state=state, force=True)
    assert "issue every machine again" in capsys.readouterr().out
    assert (state / "certs" / "ca.pem").read_bytes() != authority


def test_without_hosts_it_names_this_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    certs_cli.init(state=tmp_path / "state")
    assert "127.0.0.1" in capsys.readouterr().out


def test_issue_writes_a_folder_that_leads_to_the_coordinator(state: Path, tmp_path: Path) -> None:
    certs_cli.issue("worker", "gpu-7", state=state)
    found = of(tmp_path / "worker-gpu-7")
    assert found.endpoints == ("tls/lab.example:7447",)
    with contextlib.closing(StateFolder.open(state)) as opened:  # the certificates in it are no hindrance
        assert found.cluster == opened.identity.cluster
    certs_cli.issue("gateway", "g", state=state, out=tmp_path / "mine", connect=["tls/site:7448"])
    assert of(tmp_path / "mine", "gateway").endpoints == ("tls/site:7448",)


def test_list_tells_names_roles_expiry_and_revocation_and_no_secret(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    certs_cli.issue("worker", "gpu-7", state=state)
    certs_cli.issue("operator", "boss", state=state)
    certs_cli.revoke("gpu-7", state=state)
    capsys.readouterr()
    certs_cli.list_(state=state)
    text = capsys.readouterr().out
    rows = [line.split() for line in text.splitlines()]
    assert [row[:2] for row in rows if {"gateway", "operator", "worker"} & {*row}] == [
        ["boss", "gateway"],
        ["boss", "operator"],
        ["gpu-7", "worker"],
    ]
    assert [row[0] for row in rows if "revoked" in row] == ["gpu-7"]
    assert text.count("days left") == 3
    assert "lab.example" in text
    for machine in Machines(state).all():
        assert machine.password not in text
        assert not machine.token or machine.token not in text


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda state: certs_cli.issue("router", "r", state=state), "needs a --host"),
        (lambda state: certs_cli.issue("worker", "a b", state=state), "NAME 'a b'"),
        (lambda state: certs_cli.issue("worker", "w", state=state / "new"), "certs init"),
        (lambda state: certs_cli.revoke("nobody", state=state), "no machine 'nobody'"),
        (lambda state: certs_cli.list_(state=state / "new"), "certs init"),
        (lambda state: certs_cli.init(state=state, renew=True, host=["a b"]), "--host 'a b'"),
    ],
)
def test_what_is_wrong_is_reported_and_changes_nothing(
    state: Path, call: Callable[[Path], None], message: str
) -> None:
    before = contents(state)
    with pytest.raises(ConfigError, match=message):
        call(state)
    assert contents(state) == before
