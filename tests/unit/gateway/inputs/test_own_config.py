"""A CLI's configuration as a run's own copy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.secrets import Redaction
from evopolicy_gateway.harnesses import make
from evopolicy_gateway.harnesses.interface.agent_config import AcpTable, AgentConfig
from evopolicy_gateway.inputs.own_config import PLACES, copy, places, secrets
from evopolicy_gateway.processes.agent_process import AgentLog


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    own_home = tmp_path / "operator"
    (own_home / ".codex" / "sessions").mkdir(parents=True)
    (own_home / ".codex" / "prompts").mkdir()
    (own_home / ".codex" / "config.toml").write_text("model = 'mine'")
    (own_home / ".codex" / "auth.json").write_text("{}")
    (own_home / ".codex" / "auth.json").chmod(0o600)
    (own_home / ".codex" / "prompts" / "brief.md").write_text("Be brief.")
    (own_home / ".codex" / "sessions" / "another-run.jsonl").touch()
    monkeypatch.setenv("HOME", str(own_home))
    return own_home


def test_settings_and_login_are_copied_and_sessions_are_not(home: Path, tmp_path: Path) -> None:
    (home / ".codex" / "prompts" / "brief.md").chmod(0o6766)
    copy(places(True, "/opt/bin/codex"), tmp_path / "run")
    own = tmp_path / "run" / "home" / ".codex"
    assert sorted(path.name for path in own.rglob("*")) == ["auth.json", "brief.md", "config.toml", "prompts"]
    assert (own / "auth.json").stat().st_mode & 0o777 == 0o600
    assert (own / "prompts" / "brief.md").stat().st_mode & 0o7777 == 0o764
    (own / "config.toml").write_text("model = 'theirs'")
    assert (home / ".codex" / "config.toml").read_text() == "model = 'mine'"


@pytest.mark.parametrize("given_first", [True, False])
def test_nothing_is_written_over_a_link_that_the_agent_left(
    home: Path, tmp_path: Path, given_first: bool
) -> None:
    """Also where the operator gave the login only when the run was resumed."""
    copy(places(given_first, "codex"), tmp_path / "run")
    own, target = tmp_path / "run" / "home" / ".codex", tmp_path / "operators"
    target.mkdir()
    if given_first:
        own.rename(own.with_name("gone"))
    own.symlink_to(target)
    copy(places(True, "codex"), tmp_path / "run")
    assert list(target.iterdir()) == []


def test_a_copy_that_was_interrupted_begins_anew(home: Path, tmp_path: Path) -> None:
    config = home / ".codex" / "config.toml"
    config.chmod(0o400)
    begun = tmp_path / "run" / "home.begun" / ".codex"
    begun.mkdir(parents=True)
    (begun / "config.toml").write_text("half")
    (begun / "config.toml").chmod(0o400)
    copy(places(True, "codex"), tmp_path / "run")
    assert (tmp_path / "run" / "home" / ".codex" / "config.toml").read_text() == "model = 'mine'"
    assert (tmp_path / "run" / "home").stat().st_mode & 0o777 == 0o700


def test_fields_about_other_folders_are_left_out_of_a_settings_file(home: Path, tmp_path: Path) -> None:
    known = {"oauthAccount": {"id": "me"}, "projects": {"/secret/place": {"history": ["my prompt"]}}}
    (home / ".claude.json").write_text(json.dumps(known))
    (home / ".claude.json").chmod(0o600)
    copy(places(True, "claude"), tmp_path / "run")
    own = tmp_path / "run" / "home" / ".claude.json"
    assert json.loads(own.read_text()) == {"oauthAccount": {"id": "me"}}
    assert own.stat().st_mode & 0o777 == 0o600


def test_no_key_of_a_copied_login_stays_in_the_agents_log(home: Path, tmp_path: Path) -> None:
    """Tokens that have the form of no known provider's."""
    files = {
        ".codex/auth.json": '{"auth_mode": "chatgpt", "tokens": {"refresh_token": "rt_0123456789abcdef"}}',
        ".codex/config.toml": (
            '[mcp_servers.x.env]\nX_TOKEN = "toml-0123456789abcdef"\n[tui]\ntheme = "a-very-long-theme-name"'
        ),
        ".gemini/.env": "export MY_KEY='env-0123456789abcdef'\nregion=europe-west-and-more\n",
        ".local/share/opencode/auth.json": '{"anthropic": {"type": "oauth", "refresh": "oc-0123456789abcdef"}}',
        ".claude/settings.json": "no JSON",
    }
    for name, text in files.items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(text)
    (home / ".qwen").mkdir()
    (home / ".qwen" / "oauth_creds.json").write_bytes(b"\xff" + b"[" * 100_000)
    texts = [text for name in PLACES for text in secrets(places(True, name))]
    expected = {f"{kind}0123456789abcdef" for kind in ("rt_", "toml-", "env-", "oc-")}
    assert set(texts) == expected
    log = AgentLog(tmp_path / "agent.jsonl", Redaction(["an-api-key-of-the-environment"]).knowing(texts))
    log.raw(" ".join([*expected, "an-api-key-of-the-environment"]).encode(), "stdout")
    log.close()
    logged = json.loads((tmp_path / "agent.jsonl").read_text())["text"]
    assert logged == " ".join(["[redacted]"] * 5)


def test_paths_are_named_for_a_program_that_is_not_known(home: Path, tmp_path: Path) -> None:
    assert places(False, "kimi") == ()
    with pytest.raises(ConfigError, match=r'name them, such as user_config = \["~/.kimi/config.toml"\]'):
        places(True, "/opt/kimi")
    assert places(("~/.kimi/config.toml",), "kimi") == ("~/.kimi/config.toml",)
    for path in ("/etc/passwd", "~/../x", "~/", "x"):
        with pytest.raises(ConfigError, match="files and folders of your home"):
            places((path,), "kimi")


def test_an_agent_behind_the_protocol_takes_it_too(tmp_path: Path) -> None:
    pytest.importorskip("acp")
    config = AgentConfig(harness="mine", program=("no-such-agent",), acp=AcpTable(), user_config=True)
    with pytest.raises(ConfigError, match="it is not known where no-such-agent keeps its settings"):
        make("mine", tmp_path, config)
