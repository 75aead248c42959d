"""The state folder: private, one coordinator at a time, the same identity after a restart."""

from __future__ import annotations

import fcntl
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.wire import credentials
from evopolicy_common.wire.credentials import ReadyCluster
from evopolicy_coordinator.storage.state_folder import InUseError, StateFolder, reachable, resolve_listen


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
    state = StateFolder.open(tmp_path / "state")
    files = state.write_credentials(("tcp/10.0.0.5:7447",))
    found = {role: credentials.read_credentials(path) for role, path in files.items()}
    assert {c.cluster for c in found.values()} == {"local"}
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
    with pytest.raises(InUseError):  # it is not a local cluster's
        refused_by(tmp_path).shared({})
    state.close()
    StateFolder.open(tmp_path).close()


def refused_by(root: Path) -> InUseError:
    with pytest.raises(InUseError) as refused:
        StateFolder.open(root)
    return refused.value


def test_a_local_cluster_is_shared_by_commands_with_its_options_alone(tmp_path: Path) -> None:
    options = {"--data": "/cases", "--hidden-isolation": "related"}
    state = StateFolder.open(tmp_path, local=options)
    assert refused_by(tmp_path).shared(options) is None  # it is starting
    ready = ReadyCluster(
        cluster="local", endpoints=("tcp/127.0.0.1:7447",), credentials={}, state=str(tmp_path)
    )
    state.serving(ready)
    assert refused_by(tmp_path).shared(dict(options)) == ready
    others = {"--hidden-isolation": "off", "env_timeout": "5"}
    with pytest.raises(ConfigError) as refused:
        refused_by(tmp_path).shared(others)
    assert (
        "(--data: /cases there, not given here; --hidden-isolation: related there, off here;"
        " env_timeout: not given there, 5 here)"
    ) in str(refused.value)
    assert "another folder with --state" in str(refused.value)
    with pytest.raises(InUseError):  # a coordinator of its own
        refused_by(tmp_path).shared(None)
    state.close()
    assert (tmp_path / "lock").read_text() == ""


def test_a_lock_without_a_word_is_in_use(tmp_path: Path) -> None:
    with (tmp_path / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(InUseError, match="process unknown"):
            refused_by(tmp_path).shared({})


def test_a_worker_has_ended_when_the_kernel_has_freed_its_lock(tmp_path: Path) -> None:
    """The attack: an agent without a jail ends its command and stops the command's worker, which then keeps a hidden
    episode. The next coordinator waits for that worker, and must not take it for one that has ended."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    commands = {"plays": os.getpid(), "stopped": gone.pid, "ended": os.getpid(), "ended-too": gone.pid}
    (tmp_path / "workers").mkdir()
    for name, command in commands.items():
        (tmp_path / "workers" / name).write_text(str(command))
    state = StateFolder.open(tmp_path, local={})
    with (tmp_path / "workers/plays").open() as plays, (tmp_path / "workers/stopped").open() as stopped:
        for each in (plays, stopped):
            fcntl.flock(each, fcntl.LOCK_EX)
        assert sorted(state.ended_workers()) == ["ended", "ended-too"]
    assert sorted(state.ended_workers()) == sorted(commands)
    state.close()


def test_folder_that_others_may_enter_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    with pytest.raises(ConfigError, match="chmod 700"):
        StateFolder.open(tmp_path)


def test_damaged_folder_is_refused_and_unlocked(tmp_path: Path) -> None:
    StateFolder.open(tmp_path).close()
    (tmp_path / "identity.json").write_text("{")
    for _ in range(2):
        with pytest.raises(ConfigError, match="damaged"):
            StateFolder.open(tmp_path)


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


WRONG = ("", "7447", "tcp", "tcp/host", "tcp/:7447", "tcp/host:x", "tcp/host:70000", "udp/host:1")


@pytest.mark.parametrize("endpoint", [*WRONG, "tcp/no.such.host.invalid:0"])
def test_endpoint_that_cannot_be_listened_on_is_reported(endpoint: str) -> None:
    with pytest.raises(ConfigError, match="--listen"):
        resolve_listen([endpoint])


def test_wildcard_address_is_dialled_as_loopback() -> None:
    assert reachable(("tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/10.0.0.5:7447")) == (
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tcp/10.0.0.5:7447",
    )
