"""Claude Code: `claude --print --output-format stream-json`, its session started under our own id and resumed by it.

Its stream, one JSON object per line: `system` (subtype `init` with the session and the version, `api_retry` for its own
retries), `assistant` and `user` messages with content blocks, and one `result` at the end: `is_error`,
`api_error_status`, `errors`, and `usage` of this invocation, with cache reads and creations separate from
`input_tokens`. A message's own usage is repeated with each of its blocks and reports too little output, so it counts
only if no result came.

Tools are the paper's six; permissions are bypassed, since the jail confines the agent. As root the CLI refuses that
unless `IS_SANDBOX=1`.

https://code.claude.com/docs/en/headless, https://code.claude.com/docs/en/cli-reference
"""

from __future__ import annotations

import os
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
from evopolicy_gateway.inputs.kept import MCP_FILE
from evopolicy_gateway.relay.usage import Usage

TOOLS = "Bash,Read,Edit,Write,Glob,Grep"
_TOKENS = TokenPaths(
    input="usage.input_tokens",
    cache_read="usage.cache_read_input_tokens",
    cache_creation="usage.cache_creation_input_tokens",
    output="usage.output_tokens",
)
_MAX_OPEN_MESSAGES = 1000
_ISOLATION = (("--safe-mode",), ("--strict-mcp-config",))
_WITH_INPUTS = (("--setting-sources", "user"), ("--strict-mcp-config",))
"""`--safe-mode` would leave out skills and MCP servers. The user's own settings are not in the jail, unless they are
bound."""


class ClaudeCode(Dialect):
    name = "claude-code"
    program = ("claude",)
    tested_version = "2.1.330"
    install = "npm install -g @anthropic-ai/claude-code"
    help_args = ("--help",)
    makes_session_id = True
    skills_at = "~/.claude/skills"

    def arguments(self, session: str | None, *, resume: bool, prompt: str, options: str) -> list[str]:
        words = ["--print", "--output-format", "stream-json", "--verbose"]
        words += ["--permission-mode", "bypassPermissions"]
        # Versions without `--tools` can restrict the tools only by allowing them.
        tools = f"{TOOLS},Skill" if self.kept.skills else TOOLS
        words += ["--tools" if "--tools" in options else "--allowedTools", tools]
        if not self.config.user_config:
            isolation = _WITH_INPUTS if self.kept else _ISOLATION
            words += [word for option, *more in isolation if option in options for word in (option, *more)]
        if self.kept.servers:
            words += ["--mcp-config", MCP_FILE]
        if self.config.model is not None:
            words += ["--model", self.config.model]
        if self.config.effort is not None:
            words += ["--effort", self.config.effort]
        words += self.config.extra_args
        if session is not None:
            words += ["--resume" if resume else "--session-id", session]
        return words

    def environment(self) -> dict[str, str]:
        quiet = {"CLAUDE_CODE_DISABLE_NONESSENTIAL_TRAFFIC": "1", "DISABLE_AUTOUPDATER": "1"}
        return quiet | ({"IS_SANDBOX": "1"} if os.geteuid() == 0 else {})

    def required_options(self) -> list[str]:
        needed = ["--print", "--output-format", "--permission-mode", "--session-id", "--resume"]
        needed += ["--effort"] if self.config.effort is not None else []
        return needed + (["--mcp-config"] if self.config.mcp else [])

    def reader(self) -> ClaudeReader:
        return ClaudeReader()


class ClaudeReader(TurnReader):
    def __init__(self) -> None:
        super().__init__()
        self._messages: dict[str, Usage] = {}

    def read_event(self, event: Mapping[str, object]) -> None:
        kind = event.get("type")
        if kind == "system" and event.get("subtype") == "init":
            self.session = string(event.get("session_id")) or None
        elif kind == "system" and event.get("subtype") == "api_retry":
            self.requests_failed += 1
        elif kind == "assistant":
            self._message(mapping(event.get("message")))
        elif kind == "result":
            self._result(event)

    def _message(self, message: Mapping[str, object]) -> None:
        identity = string(message.get("id"))
        if identity:
            usage = usage_of(message, _TOKENS) or Usage()
            self.usage = self.usage - self._messages.pop(identity, Usage()) + usage
            self._messages[identity] = usage
            if len(self._messages) > _MAX_OPEN_MESSAGES:
                # Dropped messages stay counted: after so many others, a message is not reported again.
                del self._messages[next(iter(self._messages))]
        for block in mappings(message.get("content")):
            self._block(block)

    def _block(self, block: Mapping[str, object]) -> None:
        if block.get("type") == "text":
            self.text = string(block.get("text"))
            self.action = first_line(self.text) or self.action
        elif block.get("type") == "tool_use":
            given = mapping(block.get("input"))
            command = string(given.get("command"))
            target = string(given.get("file_path")) or string(given.get("pattern"))
            self.action = f"$ {first_line(command)}" if command else f"{string(block.get('name'))} {target}"

    def _result(self, result: Mapping[str, object]) -> None:
        usage = usage_of(result, _TOKENS) or Usage()
        if usage.total >= self.usage.total:
            self.usage = usage
        text = string(result.get("result"))
        if not result.get("is_error"):
            self.done, self.failure = True, None
            self.text = text or self.text
            return
        errors = result.get("errors")
        words = [string(one) for one in (errors if isinstance(errors, list) else ())]
        status = result.get("api_error_status")
        message = text or "; ".join(words) or string(result.get("subtype")).replace("_", " ")
        self.failure = turn_failure_of(message, status if isinstance(status, int) else None)
