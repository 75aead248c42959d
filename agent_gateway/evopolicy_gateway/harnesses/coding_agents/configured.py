"""A CLI described by a TOML file: its arguments, and dotted paths into its JSON events.

Lines that are not JSON are text of the agent. A turn is complete when the program exits with status 0 and no event
reported an error.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses.coding_agents.dialect import Dialect, TurnReader, first_line, usage_of
from evopolicy_gateway.harnesses.coding_agents.turn_failure import turn_failure_of
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig, Cli, Events
from evopolicy_gateway.inputs.kept import MCP_FILE
from evopolicy_gateway.relay.answers import values

_MCP = {"{mcp_config}": MCP_FILE}


class ConfiguredCli(Dialect):
    """The `[cli]` table of an agent's settings."""

    tells_end = False

    def __init__(self, config: AgentConfig) -> None:
        super().__init__(config)
        if config.cli is None or not config.program:
            raise ConfigError(
                f"harness {config.harness!r} is not built in: it needs `program` and a [cli] table"
            )
        self._cli: Cli = config.cli
        self.name = config.harness
        self.program = config.program
        self.cumulative = self._cli.events.tokens.counts == "session"
        self.version_args = self._cli.version
        self.makes_session_id = self._cli.own_session_id
        self.resumes = bool(self._cli.resume)
        self.prompt_on_stdin = self._cli.prompt == "stdin"
        if config.mcp and not (self._cli.mcp or self._cli.mcp_environment):
            raise ConfigError(
                f"harness {config.harness}: mcp needs the program's option for MCP servers: set cli.mcp, such as"
                ' mcp = ["--mcp-config", "{mcp_config}"], or in cli.mcp_environment'
            )

    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        template = self._cli.resume if resume else self._cli.first
        known = {
            "{model}": self.config.model,
            "{effort}": self.config.effort,
            "{session}": session,
            "{prompt}": prompt,
        }
        words: list[str] = []
        for word in template:
            unset = [name for name, value in known.items() if name in word and value is None]
            if unset:
                # `--model {model}` is dropped as a pair, `--model={model}` alone.
                if words and words[-1].startswith("-") and word == unset[0]:
                    words.pop()
                continue
            words.append(_filled(word, {name: value or "" for name, value in known.items()}))
        mcp_options = [_filled(word, _MCP) for word in self._cli.mcp] if self.kept.servers else []
        return words + mcp_options + list(self.config.extra_args)

    def environment(self) -> dict[str, str]:
        if not self.kept.servers:
            return {}
        return {name: _filled(value, _MCP) for name, value in self._cli.mcp_environment.items()}

    def reader(self) -> ConfiguredReader:
        return ConfiguredReader(self._cli.events)


class ConfiguredReader(TurnReader):
    def __init__(self, events: Events) -> None:
        super().__init__()
        self._events = events

    def read_event(self, event: Mapping[str, object]) -> None:
        self.session = _first(event, self._events.session) or self.session
        if text := _first(event, self._events.text):
            self.text, self.action = text, first_line(text)
        if action := _first(event, self._events.action):
            self.action = first_line(action)
        if error := _first(event, self._events.error):
            self.failure = turn_failure_of(error)
        paths = self._events.tokens
        if (usage := usage_of(event, paths)) is not None:
            self.usage = usage if paths.counts == "session" else self.usage + usage


def _first(document: Mapping[str, object], paths: tuple[str, ...]) -> str:
    texts = (value for path in paths for value in values(document, path) if isinstance(value, str) and value)
    return next(texts, "")


def _filled(word: str, known: Mapping[str, str]) -> str:
    """The word with the values of the names in it: in one pass, so that `{model}` inside a prompt is not replaced."""
    return re.sub("|".join(map(re.escape, known)), lambda match: known[match[0]], word)
