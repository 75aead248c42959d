"""Credentials on disk: private, found by endpoint, and told plainly when they are not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from evopolicy_common import credentials
from evopolicy_common.credentials import Credentials
from evopolicy_common.errors import ConfigError


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("EVOPOLICY_STATE", raising=False)


def worker(endpoint: str = "tcp/127.0.0.1:7447") -> Credentials:
    return Credentials(
        cluster="c", role="worker", endpoints=(endpoint,), user="worker", password="p", token="join"
    )


def test_credentials_are_written_for_their_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "credentials" / "worker.json"
    credentials.write(worker(), path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert credentials.read(path) == worker()


def test_credentials_that_others_may_read_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "worker.json"
    credentials.write(worker(), path)
    path.chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        credentials.read(path)


def test_a_command_finds_the_cluster_that_it_is_pointed_at(tmp_path: Path) -> None:
    folder = tmp_path / "state" / "credentials"
    credentials.write(worker(), folder / "worker.json")
    credentials.publish(("tcp/127.0.0.1:7447",), folder)
    assert credentials.find("worker", ("tcp/127.0.0.1:7447",)) == worker()
    credentials.withdraw(("tcp/127.0.0.1:7447",))
    with pytest.raises(ConfigError, match=r"no worker credentials for tcp/127\.0\.0\.1:7447"):
        credentials.find("worker", ("tcp/127.0.0.1:7447",))


def test_without_an_endpoint_the_default_state_folder_is_looked_at() -> None:
    path = credentials.default_state_dir() / "credentials" / "worker.json"
    credentials.write(worker(), path)
    assert credentials.find("worker") == worker()


def test_a_named_endpoint_replaces_the_files_own(tmp_path: Path) -> None:
    path = tmp_path / "worker.json"
    credentials.write(worker(), path)
    assert credentials.find("worker", ("tcp/10.0.0.5:1",), path).endpoints == ("tcp/10.0.0.5:1",)


def test_another_roles_credentials_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "worker.json"
    credentials.write(worker(), path)
    with pytest.raises(ConfigError, match="role 'worker'"):
        credentials.find("operator", (), path)


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"cluster": 1}'])
def test_a_malformed_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "worker.json"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match=r"worker\.json"):
        credentials.read(path)
