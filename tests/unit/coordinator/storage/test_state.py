"""The state folder: private, one coordinator at a time, the same identity after a restart."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.wire import credentials
from evopolicy_coordinator.storage.state_folder import StateFolder, reachable, resolve_listen


@pytest.fixture
def short_home(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where this user's state goes by default, with a short name."""
    with scratch_folder("home") as folder:
        monkeypatch.setenv("XDG_STATE_HOME", str(folder))
        yield folder


def test_identity_survives_a_restart_and_nobody_else_reads_it(tmp_path: Path) -> None:
    root = tmp_path / "state"
    first = StateFolder.open(root)
    first.write_passwords()
    first.write_credentials(("tcp/127.0.0.1:7447",))
    first.close()
    again = StateFolder.open(root)
    assert again.identity == first.identity
    assert again.identity.cluster == "local"
    again.close()
    for path in [root, *(p for p in root.rglob("*"))]:
        assert path.stat().st_mode & 0o077 == 0, path


def test_each_role_gets_its_own_password_and_only_its_own_token(tmp_path: Path) -> None:
    state = StateFolder.open(tmp_path / "state", "lab")
    files = state.write_credentials(("tcp/10.0.0.5:7447",))
    found = {role: credentials.read(path) for role, path in files.items()}
    assert {c.cluster for c in found.values()} == {"lab"}
    assert len({c.password for c in found.values()}) == 3
    assert found["worker"].token == state.identity.worker_token
    assert found["operator"].token == state.identity.operator_token
    assert found["gateway"].token == ""
    state.close()


def test_second_coordinator_on_one_folder_is_refused_and_told_by_whom(tmp_path: Path) -> None:
    state = StateFolder.open(tmp_path)
    with pytest.raises(
        ConfigError, match=f"in use by another coordinator \\(process {os.getpid()}\\)"
    ) as refused:
        StateFolder.open(tmp_path)
    assert "another state has other hidden cases" in str(refused.value)
    state.close()
    StateFolder.open(tmp_path).close()


def test_folder_that_others_may_enter_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    with pytest.raises(ConfigError, match="chmod 700"):
        StateFolder.open(tmp_path)


def test_folder_of_another_cluster_or_a_damaged_one_is_refused_and_unlocked(tmp_path: Path) -> None:
    StateFolder.open(tmp_path, "lab").close()
    with pytest.raises(ConfigError, match="is of cluster 'lab', not 'field'"):
        StateFolder.open(tmp_path, "field")
    (tmp_path / "identity.json").write_text("{")
    with pytest.raises(ConfigError, match="damaged"):
        StateFolder.open(tmp_path, "lab")
    with pytest.raises(ConfigError, match="--cluster 'a/b'"):
        StateFolder.open(tmp_path, "a/b")


def test_too_long_a_path_has_a_stable_short_link(tmp_path: Path, short_home: Path) -> None:
    deep = tmp_path / ("x" * 100)
    found = []
    for _ in range(2):
        state = StateFolder.open(deep)
        protocol, _, path = state.socket_endpoint.partition("/")
        found.append(path)
        assert (protocol, Path(path).name) == ("unixsock-stream", "coordinator.sock")
        assert len(path) <= 100
        assert Path(path).parent.resolve() == deep
        state.close()
        assert not Path(path).parent.is_symlink()
    assert found[0] == found[1]
    assert found[0].startswith(str(short_home))


def test_links_of_states_that_are_gone_go_with_the_next(tmp_path: Path, short_home: Path) -> None:
    links = short_home / "evopolicy" / "sockets"
    links.mkdir(parents=True, mode=0o700)
    (links / "gone").symlink_to(tmp_path / "nowhere")
    (links / "there").symlink_to(tmp_path)
    state = StateFolder.open(tmp_path / ("x" * 100))
    assert state.socket_endpoint.startswith(f"unixsock-stream/{links}/")
    assert not (links / "gone").is_symlink()
    assert (links / "there").is_symlink()
    state.close()


def test_a_folder_that_others_may_change_holds_no_link(tmp_path: Path, short_home: Path) -> None:
    (short_home / "evopolicy").mkdir()
    (short_home / "evopolicy" / "sockets").mkdir()
    (short_home / "evopolicy" / "sockets").chmod(0o777)
    state = StateFolder.open(tmp_path / ("x" * 100))
    assert state.socket_endpoint.startswith(f"unixsock-stream//tmp/evopolicy-{os.getuid()}/")
    state.close()


def test_port_0_becomes_a_free_port() -> None:
    (endpoint,) = resolve_listen(["tcp/127.0.0.1:0"])
    assert int(endpoint.rsplit(":", 1)[1]) > 0
    assert resolve_listen(["tcp/[::1]:7447", "tls/host:1"]) == ("tcp/[::1]:7447", "tls/host:1")


@pytest.mark.parametrize(
    "endpoint",
    [
        "",
        *[
            "7447",
            "tcp",
            "tcp/host",
            "tcp/:7447",
            "tcp/host:x",
            "tcp/host:70000",
            "udp/host:1",
            "tcp/no.such.host.invalid:0",
        ],
    ],
)
def test_endpoint_that_cannot_be_listened_on_is_reported(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="--listen"):
        resolve_listen([endpoint])


def test_wildcard_address_is_dialled_as_loopback() -> None:
    assert reachable(("tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.5:7447")) == (
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tcp/10.0.0.5:7447",
    )
