"""The settings of a jail, and the ones that are refused before anything is started."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from program_runs import put_program

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.jail.settings import HTTPS, JailSettings, check_bubblewrap, host


@given(
    name=st.from_regex(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,20}[A-Za-z0-9])?", fullmatch=True),
    port=st.none() | st.integers(1, 65535),
)
def test_a_host_is_a_name_and_a_port(name: str, port: int | None) -> None:
    text = name if port is None else f"{name}:{port}"
    assert host(text) == (name.lower(), HTTPS if port is None else port)


@pytest.mark.parametrize(
    "text", ["", "*", "*.example.org", "a:0", "a:70000", "https://a", "a/b", "a:b", "a b", ".a"]
)
def test_anything_but_a_host_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--allow-host"):
        host(text)


def test_a_path_that_holds_an_open_runs_credentials_is_refused(tmp_path: Path) -> None:
    state = tmp_path / "e" / "toy_line" / "t" / ".gateway"
    state.mkdir(parents=True)
    for path in (tmp_path, state.parent, state):
        with pytest.raises(ConfigError, match="credentials"):
            JailSettings(read=(str(path),)).check()
    link = tmp_path / "link"
    link.symlink_to(state)
    with pytest.raises(ConfigError, match="credentials"):
        JailSettings(write=(str(link),)).check()


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (JailSettings(read=("/",)), "--jail none"),
        (JailSettings(read=("/no/such/path",)), "--jail-bind /no/such/path"),
        (JailSettings(write=("/no/such/path",)), "--jail-bind-rw /no/such/path"),
        (JailSettings(environment=("A=b",)), "--jail-env"),
        (JailSettings(environment=("NOBODY_HAS_SET_THIS",)), "NOBODY_HAS_SET_THIS"),
        (JailSettings(mode="off"), "--jail 'off'"),  # type: ignore[arg-type]
    ],
)
def test_a_wrong_option_is_named(settings: JailSettings, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        settings.check()


def test_a_machine_without_bubblewrap_gets_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="--jail none"):
        JailSettings().check()
    JailSettings(mode="none").check()


def test_a_bubblewrap_that_fails_is_quoted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_program(tmp_path / "bwrap", "echo no namespaces for you >&2\nexit 1")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"no namespaces for you.*--jail none"):
        check_bubblewrap()


def test_ctrl_c_does_not_reach_a_tried_bubblewrap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = 'read -r pid name state parent group rest < /proc/$$/stat\n[ "$group" = $$ ]'
    put_program(tmp_path / "bwrap", text)
    monkeypatch.setenv("PATH", str(tmp_path))
    check_bubblewrap()


def test_the_record_tells_the_modes_apart() -> None:
    modes = [JailSettings(mode=mode).recorded for mode in ("bwrap", "open-network", "none")]
    assert modes == ["bwrap", "bwrap, open network", "none"]
    assert JailSettings().chosen() == {}
