"""An agent's settings, from a TOML file or a suite's `[[agents]]` table.

`docs/how-to/coding-agents.md` lists them with examples. Unknown keys are refused. A file holds no secrets:
`environment` is written to `run.json`, and `pass_environment` only names variables that must be set.
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta

from evopolicy_common.errors import DECODE_ERRORS, ConfigError, raised_as
from evopolicy_common.regular_files import read_given
from evopolicy_gateway.inputs.declared import McpServer
from evopolicy_gateway.relay.apis import Protocol, Upstream
from evopolicy_gateway.relay.limits import Limits
from evopolicy_gateway.relay.usage import Prices
from evopolicy_gateway.workspace.prompts import Prompts

ProviderName = Literal["openai", "anthropic", "google", "deepseek", "moonshot", "mistral", "openrouter"]
ApiName = Literal["responses", "chat", "messages", "gemini"]
USUAL_COST = 20.0
"""Limit of a run's cost with prices, US dollars."""


class TokenPaths(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where an event reports token counts: dotted paths such as `usage.input_tokens`; empty for unreported counts."""

    input: str = ""
    cache_read: str = ""
    cache_creation: str = ""
    output: str = ""
    reasoning: str = ""
    total: str = ""
    """For a stream whose `output` excludes reasoning: output is `total` minus `input`, if larger."""
    input_includes_cached: bool = False
    """Whether the stream includes `cache_read` in `input`, as Codex does."""
    counts: Literal["turn", "session"] = "turn"
    """Extent of the numbers."""


class Events(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The meaning of a CLI's JSON lines: dotted paths, where `*` stands for every element of a list.

    `[name=value]` matches only objects with that value, such as `[type=result].error.message`. The first path with a
    value counts; an event without any is ignored.
    """

    session: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    """The agent's text."""
    action: tuple[str, ...] = ()
    """The agent's action, for people who watch."""
    error: tuple[str, ...] = ()
    """The error with which the turn failed."""
    tokens: TokenPaths = TokenPaths()


class Cli(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to use a CLI without a harness of its own. `{model}`, `{effort}`, `{session}`, `{prompt}` are filled in.

    If no model or effort is set, an argument that needs it is dropped together with the option before it.
    """

    first: tuple[str, ...]
    """Arguments of a session's first turn."""
    resume: tuple[str, ...] = ()
    """Arguments of later turns; empty: the CLI has no sessions."""
    prompt: Literal["stdin", "argument"] = "stdin"
    """`argument`: the prompt replaces `{prompt}` in the arguments."""
    own_session_id: bool = False
    """evopolicy generates the session's id (a UUID), and `{session}` passes it in `first` too."""
    version: tuple[str, ...] = ("--version",)
    mcp: tuple[str, ...] = ()
    """Arguments added for MCP servers; `{mcp_config}` is a file with `{"mcpServers": {…}}`."""
    mcp_environment: dict[str, str] = {}
    """Variables in place of such arguments, filled in likewise."""
    events: Events = Events()


class AcpTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to use an agent that speaks the Agent Client Protocol. Its program is `program`."""

    auth: str = ""
    """Id of the login method to choose, where the agent wants one."""
    mode: str = ""
    """Id of the session mode. Empty: the agent's own, but `default` in place of `auto`."""
    counts: Literal["turn", "session"] = "turn"
    """Extent of the tokens that end a turn."""


class ApiTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The model's API, to which the relay passes requests on."""

    provider: ProviderName | None = None
    """Chooses base URL, API and key variable. None: a server at `base_url`."""
    api: ApiName | None = None
    """None: the provider's, else `chat`."""
    base_url: str = ""
    """Such as `https://api.example.com/v1`; empty: the provider's."""
    insecure_http: bool = False
    """Allows `http://` on the local network, where others may read prompts, answers and the key."""
    key: str | None = None
    """Variable with the API key; None: the provider's, such as OPENAI_API_KEY; empty: no key."""
    key_header: str = ""
    """Header with the key, such as Azure's `api-key`; empty: the protocol's."""
    headers: dict[str, str] = {}
    """Further headers; each value names a variable with the header's value."""
    query: dict[str, str] = {}
    """Added to each address, such as Azure's `api-version`."""
    parameters: dict[str, Any] = {}
    """This and the following: only for the built-in agent. Further fields of each request, such as `temperature`."""
    system: str = ""
    """In place of the built-in system prompt."""
    max_output_tokens: Annotated[int, Meta(ge=1)] = 32_000
    """Of one answer; only with the API messages, which needs it."""
    context_tokens: Annotated[int, Meta(ge=1000)] = 180_000
    """A longer conversation loses the outputs of earlier commands."""

    @property
    def spoken(self) -> ApiName:
        return self.api or (PROVIDERS[self.provider].api if self.provider else "chat")

    @property
    def protocol(self) -> Protocol:
        """The family of APIs that the relay serves."""
        return _FAMILIES[self.spoken]

    @property
    def url(self) -> str:
        return self.base_url or (PROVIDERS[self.provider].base_url if self.provider else "")

    @property
    def variable(self) -> str:
        """Name of the variable with the key; empty: none."""
        return PROVIDERS[self.provider or self.protocol].variable if self.key is None else self.key

    def check(self) -> None:
        """Raises ConfigError when the address is missing, or cannot be reached from a jail."""
        if not self.url:
            names = ", ".join(PROVIDERS)
            raise ConfigError(f"[api] needs a provider ({names}), or the base_url of another server")
        if _is_reachable(self.url, insecure_http=self.insecure_http):
            return
        if self.insecure_http:
            way = "or http:// on this machine or at a private address, to which the host's name must lead"
        else:
            way = "or http:// on this machine; insecure_http = true allows http:// in the local network too"
        raise ConfigError(f"api.base_url = {self.base_url!r}: https://HOST… is needed, {way}")


class ProviderDefaults(NamedTuple):
    base_url: str
    variable: str
    """Usual name of the variable with the key."""
    api: ApiName


PROVIDERS: dict[ProviderName, ProviderDefaults] = {
    "openai": ProviderDefaults("https://api.openai.com/v1", "OPENAI_API_KEY", "responses"),
    "anthropic": ProviderDefaults("https://api.anthropic.com", "ANTHROPIC_API_KEY", "messages"),
    "google": ProviderDefaults("https://generativelanguage.googleapis.com", "GEMINI_API_KEY", "gemini"),
    "deepseek": ProviderDefaults("https://api.deepseek.com", "DEEPSEEK_API_KEY", "chat"),
    "moonshot": ProviderDefaults("https://api.moonshot.ai/v1", "MOONSHOT_API_KEY", "chat"),
    "mistral": ProviderDefaults("https://api.mistral.ai/v1", "MISTRAL_API_KEY", "chat"),
    "openrouter": ProviderDefaults("https://openrouter.ai/api/v1", "OPENROUTER_API_KEY", "chat"),
}
_FAMILIES: dict[ApiName, Protocol] = {
    "responses": "openai",
    "chat": "openai",
    "messages": "anthropic",
    "gemini": "google",
}
_BASES: dict[Protocol, str] = {
    "openai": "OPENAI_BASE_URL",
    "anthropic": "ANTHROPIC_BASE_URL",
    "google": "GOOGLE_GEMINI_BASE_URL",
}
"""Variables with which an agent is given another base URL."""
_OWN_APIS: dict[str, tuple[Protocol, tuple[str, ...]]] = {
    "codex": ("openai", ("CODEX_API_KEY", "OPENAI_API_KEY")),
    "claude-code": ("anthropic", ("ANTHROPIC_API_KEY", "ANTHROPIC_AUTH_TOKEN")),
}
"""Of harnesses that need no `[api]` table: protocol, and the variables that may hold the key."""
_OWN_PROVIDER = ("model_provider", "openai_base_url")
"""In the arguments of a Codex with a provider of its own, which the relay cannot stand in for."""


def relay_variables(protocol: Protocol, url: str, token: str) -> dict[str, str]:
    """Variables that lead an agent to the relay. Empty ones replace the operator's."""
    address = f"{url}/v1" if protocol == "openai" else url
    other = {"ANTHROPIC_AUTH_TOKEN": ""} if protocol == "anthropic" else {}
    return {_BASES[protocol]: address, PROVIDERS[protocol].variable: token, **other}


class AgentConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All of an agent's settings."""

    harness: str
    """`codex`, `claude-code`, `llm` with an `[api]` table, or any other name with an `[acp]` or `[cli]` table."""
    model: str | None = None
    """Model string in the CLI's form; None for its default."""
    models: Literal["any", "declared"] = "any"
    """`declared`: the relay refuses requests for other models than `model`."""
    hosted_tools: Literal["record", "refuse"] = "record"
    """`refuse`: the relay refuses requests with tools that the provider runs, such as a web search."""
    effort: str | None = None
    program: tuple[str, ...] = ()
    """Replaces the CLI on the PATH."""
    extra_args: tuple[str, ...] = ()
    environment: dict[str, str] = {}
    pass_environment: tuple[str, ...] = ()
    provider: str | None = None
    """Provider whose outage or quota pauses this agent; None: the harness's."""
    user_config: bool | tuple[str, ...] = False
    """Gives the CLI a copy of the user's settings, rules, memory and login; paths in `~/`, if evopolicy does not know
    the CLI's."""
    retries: int = 5
    """Most retries in a row, for one turn."""
    backoff_s: float = 4.0
    """Seconds before the first retry; doubled for each further one."""
    reprompts: int = 8
    """Prompts to continue for an agent that stops with budget left."""
    silence_s: float = 3600.0
    """Seconds without output after which a CLI is restarted in its session."""
    pause_s: float = 900.0
    """First pause for an outage or quota, seconds; doubled up to an hour."""
    max_pause_s: float = 86_400.0
    """Limit of all pauses of a run, seconds."""
    max_requests: Annotated[int, Meta(ge=1)] | None = None
    """Limit per run of requests to the model; None: that of `Limits`."""
    max_tokens: Annotated[int, Meta(ge=1)] | None = None
    """Limit per run, all kinds of tokens together."""
    max_cost: Annotated[float, Meta(gt=0)] | None = None
    """Limit per run, US dollars; needs `prices`. None: 20, and no limit without prices or with a published
    profile."""
    prices: Prices | None = None
    prompts: Prompts | None = None
    """Texts in place of the standard prompts; the run's options win."""
    skills: tuple[str, ...] = ()
    """Folders with a SKILL.md each, below the folder in which the command is started."""
    skills_at: str = ""
    """Folder in which the agent looks for skills, as `~/.agents/skills`; empty: that of its program."""
    mcp: dict[str, McpServer] = {}
    """MCP servers by name."""
    cli: Cli | None = None
    api: ApiTable | None = None
    """The model's API, for the built-in agent and agents that read its address and key from the usual variables."""
    acp: AcpTable | None = None
    """Of an agent that speaks the Agent Client Protocol."""

    @property
    def secret(self) -> tuple[str, ...]:
        """Names of the operator's variables whose values are removed from the agent's log."""
        names = (*self.pass_environment, self.api.variable if self.api is not None else "")
        return tuple(dict.fromkeys(filter(None, names)))

    def check(self, environment: Mapping[str, str] | None = None) -> None:
        """Raises ConfigError that names the wrong setting."""
        variables = os.environ if environment is None else environment
        if missing := [name for name in self.pass_environment if not variables.get(name)]:
            raise ConfigError(f"pass_environment: {', '.join(missing)} not set; export it before starting")
        key = "" if self.api is None else self.api.variable
        if key and not os.environ.get(key):
            raise ConfigError(f"the variable {key} with the API's key is not set; export it before starting")
        for name in () if self.api is None else self.api.headers.values():
            if not os.environ.get(name):
                raise ConfigError(f"api.headers: the variable {name} is not set; export it before starting")
        if self.models == "declared" and self.model is None:
            raise ConfigError('models = "declared" needs `model`')
        if self.api is not None:
            self.api.check()
        pauses = {"backoff_s": self.backoff_s, "silence_s": self.silence_s, "pause_s": self.pause_s}
        for name, value in pauses.items():
            if not 0.0 < value < float("inf"):
                raise ConfigError(f"{name} = {value}: must be a number of seconds above 0")
        if self.retries < 0 or self.reprompts < 0:
            raise ConfigError("retries and reprompts must be at least 0")
        if self.prompts is not None:
            self.prompts.check("prompts")
        if self.skills_at and not re.fullmatch(r"(~|/inputs)(/[\w.-]*\w)+", self.skills_at):
            raise ConfigError(
                f"skills_at = {self.skills_at!r}: give a folder of the agent's home, such as ~/.agents/skills"
            )
        cli = self.cli
        if cli is not None and self.effort and not any("{effort}" in word for word in cli.first):
            raise ConfigError(f"effort = {self.effort!r}, and no argument in cli.first has {{effort}}")
        if cli is not None and cli.prompt == "argument":
            for name, words in (("first", cli.first), ("resume", cli.resume)):
                if words and not any("{prompt}" in word for word in words):
                    raise ConfigError(f'cli.{name} has no {{prompt}}, and cli.prompt is "argument"')

    @property
    def limits(self) -> Limits:
        """Limits of the run's use of its model."""
        given = {name: getattr(self, name) for name in ("max_requests", "max_tokens", "max_cost")}
        return Limits(**{name: value for name, value in given.items() if value is not None})

    def upstream(self, environment: Mapping[str, str]) -> Upstream | None:
        """The API behind the relay, with its key; None for an agent that cannot use the relay: one with a
        subscription's login, or a provider of its own. `environment`: the operator's variables."""
        variables = {**environment, **self.environment}
        if self.api is not None:
            return Upstream(
                protocol=self.api.protocol,
                base_url=self.api.url,
                key=variables.get(self.api.variable, "") if self.api.variable else "",
                key_header=self.api.key_header,
                headers={name: variables.get(value, "") for name, value in self.api.headers.items()},
                query=self.api.query,
            )
        if self.harness not in _OWN_APIS or self.user_config:
            return None
        protocol, names = _OWN_APIS[self.harness]
        variable = next((name for name in names if variables.get(name)), None)
        base = variables.get(_BASES[protocol]) or PROVIDERS[protocol].base_url
        own = any(word in argument for argument in self.extra_args for word in _OWN_PROVIDER)
        if variable is None or own or not _is_reachable(base):
            return None
        header = "authorization" if variable == "ANTHROPIC_AUTH_TOKEN" else ""
        return Upstream(protocol=protocol, base_url=base, key=variables[variable], key_header=header)

    @property
    def provider_name(self) -> str:
        if self.provider is None and self.api is not None:
            return urlsplit(self.api.url).hostname or self.harness
        own = _OWN_APIS.get(self.harness, (self.harness, ()))
        return self.provider or own[0]

    def settings(self) -> dict[str, object]:
        """The part recorded in `run.json`."""
        kept = msgspec.to_builtins(self)
        del kept["harness"]
        return {name: value for name, value in kept.items() if value not in (None, [], {})}


def _is_reachable(url: str, *, insecure_http: bool = False) -> bool:
    """Whether a jail can reach the URL: by TLS through its proxy, or a port of this machine. `insecure_http`: or, by
    plain HTTP, a host all of whose addresses are private."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return False
    if not parts.hostname or parts.scheme != "http":
        return bool(parts.hostname) and parts.scheme == "https"
    if parts.hostname in ("localhost", "127.0.0.1") or not insecure_http:
        return parts.hostname in ("localhost", "127.0.0.1")
    try:
        found = socket.getaddrinfo(parts.hostname, port or 80, type=socket.SOCK_STREAM)
    except OSError:
        return False
    return all(ipaddress.ip_address(str(each[4][0]).partition("%")[0]).is_private for each in found)


def read_agent(path: Path) -> AgentConfig:
    """The settings in a TOML file. Raises ConfigError with the file and the fault."""
    data = read_given(path, str(path))
    with raised_as(ConfigError, path, ConfigError, *DECODE_ERRORS):
        config = msgspec.toml.decode(data, type=AgentConfig)
        config.check()
    return config
