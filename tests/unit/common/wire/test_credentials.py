"""Credentials on disk: private, found by endpoint, and told plainly when they are not there."""

from __future__ import annotations

import contextlib
import fcntl
from pathlib import Path

import msgspec
import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import Credentials, TlsFiles, stays_on_machine


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("EVOPOLICY_STATE", raising=False)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A worker's credentials, as a file."""
    credentials.write(worker(), tmp_path / "own" / "worker.json")
    return tmp_path / "own" / "worker.json"


def worker(endpoint: str = "tcp/127.0.0.1:7447") -> Credentials:
    return Credentials(
        cluster="c", role="worker", endpoints=(endpoint,), user="worker", password="p", token="join"
    )


def test_credentials_are_for_their_owner_only(file: Path) -> None:
    assert file.stat().st_mode & 0o777 == 0o600
    assert credentials.read_credentials(file) == worker()
    file.chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        credentials.read_credentials(file)


def test_a_command_finds_the_cluster_that_it_is_pointed_at(file: Path) -> None:
    credentials.publish(("tcp/127.0.0.1:7447",), file.parent)
    assert credentials.find("worker", ("tcp/127.0.0.1:7447",)) == worker()
    credentials.withdraw(("tcp/127.0.0.1:7447",))
    with pytest.raises(ConfigError, match=r"no worker credentials for tcp/127\.0\.0\.1:7447"):
        credentials.find("worker", ("tcp/127.0.0.1:7447",))


def test_a_registry_that_cannot_be_made_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match=r"cannot make .*/file/evopolicy/clusters.*set XDG_STATE_HOME"):
        credentials.publish(("tcp/127.0.0.1:7447",), tmp_path)


def test_without_an_endpoint_the_default_state_folder_is_looked_at() -> None:
    path = credentials.default_state_dir() / "credentials" / "worker.json"
    credentials.write(worker(), path)
    assert credentials.find("worker") == worker()


def test_an_operator_finds_the_local_cluster_that_runs(tmp_path: Path) -> None:
    def published(name: str) -> Path:
        folder = tmp_path / name / "credentials"
        endpoint = f"unixsock-stream/{tmp_path / name}/coordinator.sock"
        own = msgspec.structs.replace(worker(endpoint), role="operator", cluster=name)
        credentials.write(own, folder / "operator.json")
        credentials.publish((endpoint,), folder)
        return folder

    def held(state: Path) -> contextlib.ExitStack:
        stack = contextlib.ExitStack()
        fcntl.flock(stack.enter_context((state / "lock").open("w")), fcntl.LOCK_EX)
        return stack

    first, second = published("first"), published("second")  # two that were killed
    with pytest.raises(ConfigError, match="no operator credentials"):
        credentials.find_running()
    with held(first.parent):
        assert credentials.find_running().cluster == "first"
        assert credentials.find_running(file=second).cluster == "second"
        with held(second.parent):
            with pytest.raises(ConfigError, match="2 clusters run on this machine") as refused:
                credentials.find_running()
            assert f"--credentials {first} or --credentials {second}" in str(refused.value)
            own = msgspec.structs.replace(worker(), role="operator", cluster="usual")
            usual = credentials.default_state_dir()
            credentials.write(own, usual / "credentials/operator.json")
            with held(usual):
                assert credentials.find_running().cluster == "usual"


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        ("tcp/127.0.0.1:1", ""),
        ("tcp/127.9.9.9:1", ""),
        ("tcp/localhost:1", ""),
        ("tcp/[::1]:1?prio=1#iface=lo", ""),
        ("unixsock-stream/s", ""),
        ("tcp/10.0.0.5:1", "tls/HOST:PORT"),
        ("tcp/127.0.0.1.lab:1", "tls/HOST:PORT"),
        ("tcp/[2001:db8::1]:1", "tls/HOST:PORT"),
        ("tcp/lab:1", "tls/HOST:PORT"),
        ("udp/127.0.0.1:1", "tls/HOST:PORT"),
        ("quic/lab:1", "tls/HOST:PORT"),
        ("tls/10.0.0.5:1", "certs issue worker NAME"),
    ],
)
def test_tokens_leave_the_machine_inside_tls_only(file: Path, endpoint: str, why: str) -> None:
    assert stays_on_machine(endpoint) == (why == "")
    if why:
        with pytest.raises(ConfigError, match=why):
            credentials.find("worker", (endpoint,), file)
    else:
        assert credentials.find("worker", (endpoint,), file).endpoints == (endpoint,)


def test_plain_tcp_goes_where_the_coordinator_was_told_to_speak_it(file: Path) -> None:
    credentials.write(msgspec.structs.replace(worker(), insecure_tcp=True), file)
    assert credentials.find("worker", ("tcp/10.0.0.5:1",), file).endpoints == ("tcp/10.0.0.5:1",)


def machines_folder(folder: Path) -> Path:
    files = TlsFiles(root_ca="ca.pem", certificate="cert.pem", private_key="key.pem")
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("PEM")
        (folder / name).chmod(0o600)
    made = msgspec.structs.replace(worker("tls/10.0.0.5:7447"), tls=files)
    credentials.write(made, folder / "worker.json")
    return folder


def test_a_folder_may_be_copied_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = machines_folder(tmp_path / "made").rename(tmp_path / "copied")
    monkeypatch.chdir(tmp_path)
    for named in (folder, folder / "worker.json", Path("copied")):
        found = credentials.find("worker", (), named)
        assert found.tls == TlsFiles(
            root_ca=f"{folder}/ca.pem", certificate=f"{folder}/cert.pem", private_key=f"{folder}/key.pem"
        )


def test_what_is_wrong_with_a_machines_folder_is_named(tmp_path: Path, file: Path) -> None:
    folder = machines_folder(tmp_path / "made")
    with pytest.raises(ConfigError, match=r"has no operator credentials \(roles there: worker\)"):
        credentials.find("operator", (), folder)
    with pytest.raises(ConfigError, match="role 'worker'"):
        credentials.find("operator", (), file)
    (folder / "key.pem").chmod(0o644)
    with pytest.raises(ConfigError, match=r"key\.pem may be read by others"):
        credentials.find("worker", (), folder)
    (folder / "ca.pem").unlink()
    with pytest.raises(ConfigError, match="copy the whole folder"):
        credentials.find("worker", (), folder)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"cluster": 1}'])
def test_a_malformed_file_is_named(file: Path, text: str) -> None:
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"worker\.json"):
        credentials.read_credentials(file)
