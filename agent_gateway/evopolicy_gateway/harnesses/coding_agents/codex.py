"""OpenAI's Codex CLI: `codex exec --json`, continued by `codex exec resume ID`.

Its stream, one JSON object per line: `thread.started {thread_id}`, `turn.started`, `item.started|updated|completed
{item}`, `turn.completed {usage}`, `turn.failed {error}`, `error {message}`. An `error` that starts with "Reconnecting"
is only a notice; any error counts only if the turn does not complete. `usage` counts the thread from its start, across
resumes; `input_tokens` includes the cached ones and `output_tokens` the reasoning ones.

https://developers.openai.com/codex/noninteractive, https://github.com/openai/codex (codex-rs/exec)
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from evopolicy_gateway.harnesses.coding_agents.dialect import (
    Dialect,
    TurnReader,
    first_line,
    mapping,
    mappings,
    string,
    usage_of,
)
from evopolicy_gateway.harnesses.coding_agents.turn_failure import turn_failure_of
from evopolicy_gateway.harnesses.interface.agent_config import TokenPaths
from evopolicy_gateway.relay.usage import Usage

_BYPASS = "--dangerously-bypass-approvals-and-sandbox"
_ISOLATION = ("--ignore-user-config", "--ignore-rules")
TOKENS = TokenPaths(
    input="usage.input_tokens",
    cache_read="usage.cached_input_tokens",
    output="usage.output_tokens",
    reasoning="usage.reasoning_output_tokens",
    input_includes_cached=True,
)
_NOTICE = "Reconnecting"


class Codex(Dialect):
    name = "codex"
    program = ("codex",)
    cumulative = True
    tested_version = "0.169.0"
    install = "npm install -g @openai/codex"
    help_args = ("exec", "--help")

    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        words = ["exec", "resume"] if resume else ["exec"]
        words += ["--json", "--skip-git-repo-check", _BYPASS]
        if not self.config.user_config:
            # Versions without these options always read the user's settings.
            words += [option for option in _ISOLATION if option in options]
        if self.config.model is not None:
            words += ["--model", self.config.model]
        if self.config.effort is not None:
            words += ["--config", f'model_reasoning_effort="{self.config.effort}"']
        for name, server in self.kept.servers.items():
            env = ", ".join(f"{toml(variable)} = {toml(value)}" for variable, value in server.env.items())
            settings = {"command": toml(server.command), "args": toml(server.args), "env": f"{{{env}}}"}
            for key, value in settings.items():
                words += ["--config", f"mcp_servers.{name}.{key}={value}"]
        if self.relay is not None:
            provider = f'{{name="relay",base_url="{self.relay.url}/v1",env_key="OPENAI_API_KEY",wire_api="responses"}}'
            words += ["--config", "model_provider=relay", "--config", f"model_providers.relay={provider}"]
        words += self.config.extra_args
        if resume and session is not None:
            words.append(session)
        return [*words, "-"]

    def required_options(self) -> list[str]:
        return ["--json", "--skip-git-repo-check", _BYPASS]

    def reader(self) -> CodexReader:
        return CodexReader()


class CodexReader(TurnReader):
    def read_event(self, event: Mapping[str, object]) -> None:
        kind = event.get("type")
        if kind == "thread.started":
            self.session = string(event.get("thread_id")) or None
        elif kind == "turn.completed":
            self.done, self.failure = True, None
            self.usage = usage_of(event, TOKENS) or Usage()
        elif kind == "turn.failed":
            self.done = False
            self.failure = turn_failure_of(string(mapping(event.get("error")).get("message")))
        elif kind == "error":
            message = string(event.get("message"))
            if message.startswith(_NOTICE):
                self.requests_failed += 1
            elif not self.done:
                self.failure = turn_failure_of(message)
        elif kind in ("item.started", "item.updated", "item.completed"):
            self._item(mapping(event.get("item")), completed=kind == "item.completed")

    def _item(self, item: Mapping[str, object], *, completed: bool) -> None:
        kind = item.get("type") or item.get("item_type")
        if kind in ("agent_message", "assistant_message"):
            if completed:
                self.text = string(item.get("text"))
                self.action = first_line(self.text)
        elif kind == "command_execution":
            self.action = f"$ {first_line(string(item.get('command')))}"
        elif kind == "file_change":
            paths = [string(one.get("path")) for one in mappings(item.get("changes"))]
            self.action = f"edits {', '.join(path.rpartition('/')[2] for path in paths)}"


def toml(value: str | tuple[str, ...]) -> str:
    """JSON's strings and lists are TOML's too, except for pairs of escapes (surrogates) and a bare DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
