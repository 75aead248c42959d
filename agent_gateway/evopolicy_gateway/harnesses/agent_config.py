"""An agent's settings, from a TOML file or a suite's `[[agents]]` table.

`docs/how-to/coding-agents.md` lists them with examples. Unknown keys are refused. A file holds no secrets: `environment` is written to
`run.json`, `pass_environment` only names variables that must be set.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ConfigError
from evopolicy_gateway.harnesses.usage import Prices


class TokenPaths(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where an event tells the tokens; dotted paths such as `usage.input_tokens`, empty for what it does not tell."""

    input: str = ""
    cache_read: str = ""
    cache_creation: str = ""
    output: str = ""
    reasoning: str = ""
    total: str = ""
    """Of a stream whose `output` lacks the reasoning: what `total` is above `input` is output."""
    input_includes_cached: bool = False
    """The stream counts `cache_read` into `input`, as Codex does."""
    counts: Literal["turn", "session"] = "turn"
    """What the numbers add up: one turn, or the session so far."""


class Events(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a CLI's JSON lines mean: dotted paths, where `*` stands for every element of a list.

    `[name=value]` goes on only where the object has that value, such as `[type=result].error.message`. The first path with a value counts, and an event without any is passed over.
    """

    session: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    """What the agent says."""
    action: tuple[str, ...] = ()
    """What it does, for people who watch."""
    error: tuple[str, ...] = ()
    """The turn failed, and this is why."""
    tokens: TokenPaths = TokenPaths()


class Cli(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to speak with a CLI that there is no harness for. `{model}`, `{effort}`, `{session}`, `{prompt}` are filled in.

    An argument that needs a model or an effort is dropped with the one before it where none is set.
    """

    first: tuple[str, ...]
    """Arguments of a session's first turn."""
    resume: tuple[str, ...] = ()
    """Arguments of later turns; empty: the CLI knows no sessions, each turn starts anew."""
    prompt: Literal["stdin", "argument"] = "stdin"
    """`argument`: it stands where `{prompt}` is."""
    own_session_id: bool = False
    """The session's id is made here (a UUID), and given by `{session}` in `first` too."""
    version: tuple[str, ...] = ("--version",)
    events: Events = Events()


class AgentConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All of an agent's settings."""

    harness: str
    """`codex`, `claude-code`; any other name with a `[cli]` table."""
    model: str | None = None
    """Model string, as the CLI takes it; None for its own default."""
    effort: str | None = None
    program: tuple[str, ...] = ()
    """In place of the CLI on the PATH."""
    extra_args: tuple[str, ...] = ()
    environment: dict[str, str] = {}
    pass_environment: tuple[str, ...] = ()
    provider: str | None = None
    """Whose outage or quota pauses this agent; default: the harness's usual one."""
    user_config: bool = False
    """Let the CLI read the user's own settings, rules and memory: off, so that a run depends on this file alone."""
    retries: int = 5
    """In a row, for one turn."""
    backoff_s: float = 4.0
    """Before the first retry; doubled for each further one."""
    reprompts: int = 8
    """Times that an agent which stops with budget left is told to go on."""
    silence_s: float = 3600.0
    """A CLI that says nothing for so long is ended, and its session resumed."""
    pause_s: float = 900.0
    """First pause of an outage or a quota without a told end; doubled up to an hour."""
    max_pause_s: float = 86_400.0
    """All pauses of a run together; after them the run ends."""
    max_tokens: int | None = None
    """Per run, all kinds together."""
    max_cost: float | None = None
    """Per run, US dollars; needs `prices`."""
    prices: Prices | None = None
    cli: Cli | None = None

    def check(self, environment: Mapping[str, str] | None = None) -> None:
        """ConfigError naming the setting that is wrong."""
        variables = os.environ if environment is None else environment
        missing = [name for name in self.pass_environment if not variables.get(name)]
        if missing:
            raise ConfigError(f"pass_environment: {', '.join(missing)} not set; export it before starting")
        for name in ("backoff_s", "silence_s", "pause_s"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ConfigError(f"{name} = {getattr(self, name)}: a number of seconds above zero is needed")
        if self.retries < 0 or self.reprompts < 0:
            raise ConfigError("retries and reprompts are counts, from 0")
        if self.max_cost is not None and self.prices is None:
            raise ConfigError("max_cost needs [prices], in US dollars per million tokens")
        if self.cli is not None and self.effort and not any("{effort}" in word for word in self.cli.first):
            raise ConfigError(f"effort = {self.effort!r}, and no argument in cli.first has {{effort}}")
        if self.cli is not None and self.cli.prompt == "argument":
            for name, words in (("first", self.cli.first), ("resume", self.cli.resume)):
                if words and not any("{prompt}" in word for word in words):
                    raise ConfigError(f'cli.{name} has no {{prompt}}, and cli.prompt is "argument"')

    @property
    def provider_name(self) -> str:
        return self.provider or {"codex": "openai", "claude-code": "anthropic"}.get(
            self.harness, self.harness
        )

    def settings(self) -> dict[str, object]:
        """What `run.json` keeps of it."""
        kept = msgspec.to_builtins(self)
        return {
            name: value for name, value in kept.items() if value not in (None, [], {}) and name != "harness"
        }


def read_agent(path: Path) -> AgentConfig:
    """The settings in a TOML file. ConfigError says what is wrong and where."""
    try:
        config = msgspec.toml.decode(path.read_bytes(), type=AgentConfig)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except DECODE_ERRORS as error:
        raise ConfigError(f"{path}: {error}") from error
    try:
        config.check()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config
