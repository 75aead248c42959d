"""Which machines are admitted: what is issued and revoked, and what a running coordinator makes of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography import x509
from machines.own_certs import CLUSTER, DAYS, OwnCerts, now, of

from evopolicy_common.errors import ConfigError
from evopolicy_coordinator.pki import machines
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.storage import backup
from evopolicy_coordinator.storage.store import Store


@pytest.fixture
def own(tmp_path: Path) -> OwnCerts:
    return OwnCerts(tmp_path)


def subject_of(certificate: Path) -> str:
    return x509.load_pem_x509_certificate(certificate.read_bytes()).subject.rfc4514_string()


def test_a_machines_folder_is_complete_and_private(own: OwnCerts) -> None:
    folder = own.issue("worker", "w")
    assert {path.name for path in folder.iterdir()} == {"ca.pem", "cert.pem", "key.pem", "worker.json"}
    assert folder.stat().st_mode & 0o777 == 0o700
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in folder.iterdir())
    found = of(folder)
    assert (found.cluster, found.role, found.user, found.endpoints) == (
        CLUSTER,
        "worker",
        "worker/w",
        (own.endpoint,),
    )
    assert subject_of(folder / "cert.pem") == "CN=worker/w"


def test_everything_in_the_states_folder_is_private(own: OwnCerts) -> None:
    own.issue("worker", "w")
    folder = Machines(own.state)
    folder.write_passwords()
    assert folder.folder.stat().st_mode & 0o777 == 0o700
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in folder.folder.iterdir())


def test_the_authoritys_key_is_in_no_machines_folder(own: OwnCerts) -> None:
    key = (own.state / "certs" / "ca-key.pem").read_bytes()
    for role in ("worker", "gateway", "operator", "router"):
        folder = own.issue(role, f"m-{role}")  # type: ignore[arg-type]
        assert all(key not in path.read_bytes() for path in folder.iterdir())


def test_an_operators_folder_has_a_gateways_rights_apart(own: OwnCerts) -> None:
    folder = own.issue("operator", "boss")
    operator, gateway = of(folder, "operator"), of(folder, "gateway")
    assert gateway.token == ""
    assert operator.token
    assert operator.password != gateway.password
    assert operator.tls != gateway.tls
    assert gateway.tls is not None
    assert subject_of(Path(gateway.tls.certificate)) == "CN=gateway/boss"


def test_two_machines_share_no_secret(own: OwnCerts) -> None:
    one, other = of(own.issue("worker", "a")), of(own.issue("worker", "b"))
    assert one.password != other.password
    assert one.token != other.token


def test_a_revoked_machine_is_in_no_list_and_its_sessions_are_over(own: OwnCerts) -> None:
    token, kept = of(own.issue("worker", "w")).token, of(own.issue("worker", "kept")).token
    seen = Machines(own.state)
    session, other = seen.session_for(token), seen.session_for(kept)
    assert seen.holder("worker", token) is not None
    assert not seen.is_shut_out(session)
    stamp = seen.stamp()
    own.revoke("w")
    assert seen.stamp() != stamp
    assert seen.holder("worker", token) is None
    assert seen.is_shut_out(session)
    assert not seen.is_shut_out(other)
    assert [machine.identity for machine in seen.admitted()] == ["worker/kept"]
    assert [machine.identity for machine in seen.all()] == ["worker/kept", "worker/w"]
    seen.write_passwords()
    assert [line.partition(":")[0] for line in seen.passwords.read_text().splitlines()] == [
        "worker/kept",
        "nobody",
    ]


def test_a_token_serves_its_own_role_only(own: OwnCerts) -> None:
    token = of(own.issue("worker", "w")).token
    assert Machines(own.state).holder("operator", token) is None
    own.issue("gateway", "g")
    assert Machines(own.state).holder("gateway", "") is None


def test_a_session_of_this_machine_is_nobodys_to_revoke(own: OwnCerts) -> None:
    session = Machines(own.state).session_for("the state folder's own token")
    assert ":" not in session
    assert not Machines(own.state).is_shut_out(session)
    assert Machines(own.state).is_shut_out("1234:made up")


def test_reissuing_a_name_is_explicit_and_voids_the_old_folder(own: OwnCerts) -> None:
    before = of(own.issue("worker", "w"))
    session = Machines(own.state).session_for(before.token)
    with pytest.raises(ConfigError, match="--renew"):
        own.issue("worker", "w")
    after = of(own.issue("worker", "w", again=True))
    seen = Machines(own.state)
    assert seen.holder("worker", before.token) is None
    assert seen.is_shut_out(session)
    assert seen.holder("worker", after.token) is not None


def test_a_revoked_name_may_be_issued_again(own: OwnCerts) -> None:
    own.issue("worker", "w")
    own.revoke("w")
    with pytest.raises(ConfigError, match="and revoked"):
        own.issue("worker", "w")
    own.issue("worker", "w", again=True)
    assert [machine.identity for machine in Machines(own.state).admitted()] == ["worker/w"]


def test_a_name_is_revoked_in_all_its_roles_and_a_role_alone(own: OwnCerts) -> None:
    own.issue("worker", "m")
    own.issue("operator", "m")
    own.revoke("worker/m")
    assert {machine.role for machine in Machines(own.state).admitted()} == {"operator", "gateway"}
    own.revoke("m")
    assert Machines(own.state).admitted() == ()
    with pytest.raises(
        ConfigError, match=r"no machine 'x' was issued; there are: gateway/m, operator/m, worker/m"
    ):
        own.revoke("x")


def test_a_folder_with_files_is_not_written_into(own: OwnCerts) -> None:
    folder = own.root / "worker-w"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(ConfigError, match="already contains files"):
        own.issue("worker", "w")
    assert Machines(own.state).all() == ()


@pytest.mark.parametrize("name", ["", "a/b", "a b", "../x", "x" * 64, "a:b"])
def test_a_wrong_name_is_reported(own: OwnCerts, name: str) -> None:
    with pytest.raises(ConfigError, match="NAME"):
        own.issue("worker", name)


def test_without_an_authority_nothing_is_issued(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="certs init"):
        machines.issue(tmp_path, CLUSTER, "worker", "w", ("tls/x:1",), tmp_path / "w", now(), DAYS)


def test_renewing_the_coordinators_certificate_keeps_every_machine(own: OwnCerts) -> None:
    folder = own.issue("worker", "w")
    authority = (own.state / "certs" / "ca.pem").read_bytes()
    stamp = Machines(own.state).stamp()
    machines.init(own.state, CLUSTER, ("elsewhere",), now(), DAYS, anew=False)
    assert (own.state / "certs" / "ca.pem").read_bytes() == authority == (folder / "ca.pem").read_bytes()
    certificate = machines.coordinators_certificate(own.state)
    assert certificate is not None
    assert certificate.hosts == ("elsewhere",)
    assert Machines(own.state).stamp() != stamp


def test_a_new_authority_forgets_every_machine(own: OwnCerts) -> None:
    own.issue("worker", "w")
    authority = (own.state / "certs" / "ca.pem").read_bytes()
    machines.init(own.state, CLUSTER, ("lab",), now(), DAYS, anew=True)
    assert (own.state / "certs" / "ca.pem").read_bytes() != authority
    assert Machines(own.state).all() == ()


def test_a_damaged_list_ends_a_start_but_not_a_coordinator_that_runs(own: OwnCerts) -> None:
    own.issue("worker", "w")
    running = Machines(own.state)
    assert len(running.admitted()) == 1
    (own.state / "certs" / "machines.json").write_text("{")
    assert len(running.admitted()) == 1
    with pytest.raises(ConfigError, match="restore it from a backup"):
        Machines(own.state).admitted()


def test_a_backup_holds_the_authority_and_the_machines(own: OwnCerts, tmp_path: Path) -> None:
    own.issue("worker", "w")
    Store(own.state / "coordinator.sqlite").close()
    backup.back_up(own.state, tmp_path / "copy")
    assert Machines(tmp_path / "copy").all() == Machines(own.state).all()
    assert Machines(tmp_path / "copy").tls is not None
    machines.issue(tmp_path / "copy", CLUSTER, "worker", "next", ("tls/x:1",), tmp_path / "next", now(), DAYS)
