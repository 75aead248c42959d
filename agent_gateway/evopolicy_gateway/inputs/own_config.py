"""A CLI's configuration and login as a run's own copy: the agent may change it, and nothing of it reaches the
operator's folder.

Sessions, histories and logs are not copied: they tell of other runs.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.left_files import keep_to_owner
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.secrets import is_secret

_CLAUDE = (
    *("~/.claude.json", "~/.claude/.credentials.json", "~/.claude/settings.json", "~/.claude/CLAUDE.md"),
    *("~/.claude/skills", "~/.claude/agents", "~/.claude/commands", "~/.claude/rules", "~/.claude/plugins"),
)
PLACES = {
    "codex": (
        *("~/.codex/config.toml", "~/.codex/auth.json", "~/.codex/AGENTS.md", "~/.codex/prompts"),
        *("~/.codex/rules", "~/.codex/skills", "~/.agents/skills"),
    ),
    "claude": _CLAUDE,
    "claude-agent-acp": _CLAUDE,
    "gemini": (
        *("~/.gemini/settings.json", "~/.gemini/oauth_creds.json", "~/.gemini/google_accounts.json"),
        *("~/.gemini/.env", "~/.gemini/GEMINI.md", "~/.gemini/commands", "~/.gemini/extensions"),
        *("~/.gemini/skills", "~/.agents/skills"),
    ),
    "qwen": (
        *("~/.qwen/settings.json", "~/.qwen/oauth_creds.json", "~/.qwen/.env", "~/.qwen/QWEN.md"),
        *("~/.qwen/commands", "~/.qwen/extensions", "~/.qwen/skills"),
    ),
    "opencode": ("~/.config/opencode", "~/.local/share/opencode/auth.json", "~/.agents/skills"),
}
"""Settings, rules, memory and login of CLIs, by the name of the program."""
_OTHER_RUNS = {"~/.claude.json": ("projects", "githubRepoPaths")}
"""Fields that tell of other folders and their sessions, such as prompts and the last session's cost."""

_OPENCODES = ("access", "refresh")
"""Fields of a login that do not say that they are tokens."""
_MIN_SECRET = 16
"""Shorter texts in a settings file are words, such as the kind of login."""


def places(user_config: bool | tuple[str, ...], program: str) -> tuple[str, ...]:
    """Paths that `user_config` copies. ConfigError for one outside `~/`, or `true` for an unknown CLI."""
    if not isinstance(user_config, bool):
        for path in user_config:
            if not path.startswith("~/") or os.path.normpath(path) != path.rstrip("/") or path == "~/":
                raise ConfigError(
                    f"user_config: {path!r}: give files and folders of your home, such as ~/.kimi/config.toml"
                )
        return user_config
    if not user_config:
        return ()
    name = os.path.basename(program)
    if name not in PLACES:
        raise ConfigError(
            f"user_config = true: it is not known where {name} keeps its settings; name them, such as"
            f' user_config = ["~/.{name}/config.toml"]'
        )
    return PLACES[name]


def copy(paths: Sequence[str], private: Path) -> None:
    """Makes the home of a run's agent below `private` with copies of the operator's files, as far as they exist. Raises
    ConfigError when one cannot be read.

    Only where there is no home yet: an agent that has played may have put links in the places of the files.
    """
    home, begun = private / "home", private / "home.begun"
    if os.path.lexists(home):
        return
    remove_tree(begun)
    begun.mkdir(mode=0o700, parents=True)
    for path in paths:
        source, target = Path(path).expanduser(), begun / path.removeprefix("~/")
        try:
            if source.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                _copy_file(path, source, target)
            elif source.is_dir():
                # Links stay links: where they lead out of the folder, the jail has nothing.
                shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True)
        except (OSError, shutil.Error) as error:
            raise ConfigError(f"user_config: {path} cannot be copied: {error}") from error
    keep_to_owner(begun)
    begun.rename(home)


def _copy_file(path: str, source: Path, target: Path) -> None:
    shutil.copy2(source, target)
    if path not in _OTHER_RUNS:
        return
    try:
        document = json.loads(source.read_bytes())
    except (ValueError, RecursionError):
        document = {}
    if isinstance(document, dict):
        kept = {name: value for name, value in document.items() if name not in _OTHER_RUNS[path]}
        target.chmod(0o600)
        target.write_text(json.dumps(kept))


def secrets(paths: Sequence[str]) -> list[str]:
    """Keys and tokens in the operator's files (not in folders), which the agent's log must not show."""
    texts: list[str] = []
    for path in paths:
        source = Path(path).expanduser()
        # A folder, or a file in another form: the redaction of key-like texts covers it.
        with contextlib.suppress(OSError, ValueError, RecursionError):
            texts += _secrets_in(_document(source.name, source.read_text()))
    return [text for text in texts if len(text) >= _MIN_SECRET and not any(map(str.isspace, text))]


def _document(name: str, text: str) -> Any:
    if name.endswith(".env"):
        pairs = (line.removeprefix("export ").split("=", 1) for line in text.splitlines() if "=" in line)
        return {variable.strip(): value.strip().strip("'\"") for variable, value in pairs}
    return tomllib.loads(text) if name.endswith(".toml") else json.loads(text)


def _secrets_in(value: object, name: str = "") -> Iterator[str]:
    if isinstance(value, str) and (is_secret(name) or name in _OPENCODES):
        yield value
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from _secrets_in(one, key)
    elif isinstance(value, list):
        for one in value:
            yield from _secrets_in(one, name)
