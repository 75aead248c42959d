"""Creates harnesses from the value of `--agent`."""

from __future__ import annotations

import difflib
import itertools
import os
import re
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, raised_as
from evopolicy_gateway import shipped
from evopolicy_gateway.harnesses.coding_agents import llm
from evopolicy_gateway.harnesses.coding_agents.acp import AcpAgent
from evopolicy_gateway.harnesses.coding_agents.acp_stream import Acp
from evopolicy_gateway.harnesses.coding_agents.claude_code import ClaudeCode
from evopolicy_gateway.harnesses.coding_agents.cli_agent import CliAgent
from evopolicy_gateway.harnesses.coding_agents.codex import Codex
from evopolicy_gateway.harnesses.coding_agents.configured import ConfiguredCli
from evopolicy_gateway.harnesses.coding_agents.dialect import Dialect
from evopolicy_gateway.harnesses.coding_agents.llm import Llm
from evopolicy_gateway.harnesses.command import CommandHarness, RemoteHarness, ReplayHarness
from evopolicy_gateway.harnesses.interface.agent_config import PROVIDERS, AcpTable, AgentConfig, read_agent
from evopolicy_gateway.harnesses.interface.base import Harness

FORMS = (
    "evolve, random, replay:DIR, command:PROGRAM…, acp:PROGRAM…, file:AGENT.toml,",
    "codex[:MODEL], claude-code[:MODEL], llm:PROVIDER/MODEL, remote",
)
"""Values of `--agent`, in two lines."""
_BY_KIND = {re.split(r"[:[]", form)[0]: form for form in reversed(re.findall(r"[^, ]+", " ".join(FORMS)))}
_MODELS = {
    "openai": re.compile(r"(chat)?gpt-.+|o\d.*"),
    "anthropic": re.compile(r"claude-.*\d.*"),
    "google": re.compile(r"gemini-.+"),
    "deepseek": re.compile(r"deepseek-.+"),
    "moonshot": re.compile(r"kimi-.+"),
    "mistral": re.compile(r"(mistral|magistral|devstral|codestral|ministral)-.+"),
}
"""Names of models by their providers."""
_INTERPRETER = re.compile(r"(python|bash|sh|node|perl|ruby)[\d.]*")
_SCRIPTS = "py|sh|js|ts|rb|pl"
_MODULES = {"evolve": "evolve", "random": "uniform"}
_DIALECTS: dict[str, type[Dialect]] = {"codex": Codex, "claude-code": ClaudeCode, "llm": Llm}


def entry_name(agent: str) -> str:
    """An agent's default leaderboard entry: `evolve`, `replay-gaits`; of a command the program's name, such as
    `my_agent`."""
    kind, _, rest = agent.partition(":")
    if kind == "replay":
        return f"replay-{Path(rest).resolve().name}"
    if kind == "command" and rest.strip():
        name = _program_name(_split(rest))
        return f"command-{name}" if name in _BY_KIND else name
    if kind == "acp" and rest.strip():
        return f"acp-{Path(_split(rest)[0]).name}"
    if kind in _DIALECTS and rest:
        return f"{rest} ({kind})"
    if kind == "file" and rest:
        return Path(rest).stem
    return kind


def _program_name(words: Sequence[str]) -> str:
    """`my_agent` of `python3 -u my_agent.py`, `pkg.agent` of `python3 -m pkg.agent`, `run` of `/opt/run.sh --fast`."""
    program, *rest = words
    if _INTERPRETER.fullmatch(Path(program).name):
        flags = list(itertools.takewhile(lambda word: word.startswith("-"), rest))
        if len(rest) > len(flags) and not any(flag.endswith("c") for flag in flags):  # after -c stands code
            program = rest[len(flags)]
    return re.sub(rf"\.({_SCRIPTS})$", "", Path(program).name)


def make(agent: str, started_in: Path, config: AgentConfig | None = None) -> Harness:
    """The harness of `--agent`, with a coding agent's settings if the operator has them. Raises ConfigError for invalid
    values.

    Files in a command or after `replay:` are relative to `started_in`, as the agent itself runs elsewhere.
    """
    kind, _, rest = agent.partition(":")
    config = config or config_of(agent, started_in)
    if config is not None:
        return _cli_agent(config, started_in)
    if agent in _MODULES:
        return CommandHarness(agent, _ours(_MODULES[agent]), continues=agent == "evolve")
    if agent == RemoteHarness.name:
        return RemoteHarness()
    if kind == "replay" and rest:
        folder = shipped.found(rest, started_in).resolve()
        if not folder.is_dir():
            raise ConfigError(f"--agent {agent}: {folder} is not a folder")
        return ReplayHarness([*_ours("replay"), str(folder)], folder)
    if kind == "command" and rest.strip():
        words = _split(rest)
        lost = _missing_files(words, started_in)
        hint = (
            f"{started_in} has no {', '.join(lost)}: relative paths are looked for there first"
            if lost
            else ""
        )
        return CommandHarness("command", _program(agent, words, started_in), hint=hint)
    meant = _meant(agent, started_in) or _nearest(agent)
    advice = f"--agent {shlex.quote(meant)}, or " if meant else ""
    error = ConfigError(f"--agent {agent!r} is not an agent; write {advice}one of these forms:")
    for line in FORMS:
        error.add_note(line)
    raise error


def _meant(agent: str, started_in: Path) -> str | None:
    """The form of `--agent` that a file or program without its prefix was meant for; None if it is neither."""
    words = agent.split()
    if not words or ":" in agent:
        return None
    if agent.endswith(".toml"):
        return f"file:{agent}"
    if words[0].endswith(".py"):
        return f"command:python3 {agent}"
    if (started_in / words[0]).is_file() or (len(words) > 1 and shutil.which(words[0])):
        return f"command:{agent}"
    return f"replay:{agent}" if (started_in / agent).is_dir() else None


def _nearest(agent: str) -> str | None:
    """The form of `--agent` that a name of a model or a misspelt name was meant for."""
    if agent.startswith(tuple(f"{provider}/" for provider in PROVIDERS)):
        return f"llm:{agent}"
    for provider, names in _MODELS.items():
        if names.fullmatch(agent.lower()):
            return f"llm:{provider}/{agent}"
    kind, _, rest = agent.partition(":")
    for near in difflib.get_close_matches(kind.lower(), _BY_KIND, 1):
        form = _BY_KIND[near].removesuffix("[:MODEL]")
        return f"{near}:{rest}" if rest and _BY_KIND[near] != near else form
    return None


def config_of(agent: str, started_in: Path) -> AgentConfig | None:
    """The settings behind a coding agent's `--agent`; None for other agents. Raises ConfigError for an invalid file."""
    kind, _, rest = agent.partition(":")
    if kind == "file" and rest:
        return read_agent(shipped.found(rest, started_in))
    if kind == Llm.name and rest:
        return llm.config_of(rest)
    if kind == "acp" and rest.strip():
        return AgentConfig(harness=kind, program=tuple(_split(rest)), acp=AcpTable())
    return AgentConfig(harness=kind, model=rest or None) if kind in _DIALECTS else None


def _cli_agent(config: AgentConfig, started_in: Path) -> CliAgent:
    config.check()
    # Not in `check`: the operator's option may give the prices that an agent's file lacks.
    if config.max_cost is not None and config.prices is None:
        raise ConfigError(
            "max_cost needs prices in US dollars per million tokens: give a file with --set prices=FILE.toml, or write"
            " prices = { input = 1.0, output = 10.0 } in its file"
        )
    if config.program:
        config = msgspec.structs.replace(config, program=tuple(_absolute(config.program, started_in)))
    if config.acp is not None:
        if config.harness in _DIALECTS or config.cli is not None or not config.program:
            raise ConfigError(
                f"harness {config.harness}: an [acp] table needs `program` and a name of its own, and goes with no"
                " [cli] table"
            )
        return AcpAgent(Acp(config))
    dialect = _DIALECTS.get(config.harness)
    if dialect is not None and config.cli is not None:
        raise ConfigError(f"harness {config.harness} takes no [cli] table; give it another name")
    return CliAgent(ConfiguredCli(config) if dialect is None else dialect(config))


def _ours(module: str) -> list[str]:
    # -P: modules in the workspace, which the agent writes, must not shadow installed ones.
    return [sys.executable, "-P", "-m", f"evopolicy_gateway.agents.{module}"]


def _split(command: str) -> list[str]:
    with raised_as(ConfigError, f"--agent command:{command}", ValueError):
        return shlex.split(command)


def _program(agent: str, words: list[str], started_in: Path) -> list[str]:
    resolved = _absolute(words, started_in)
    if shutil.which(resolved[0]) is None:
        if os.path.isfile(resolved[0]):
            raise ConfigError(
                f"--agent {agent}: {words[0]} is not executable: chmod +x {shlex.quote(words[0])}"
            )
        raise ConfigError(
            f"--agent {agent}: program {words[0]!r} not found, neither as a file nor on the PATH"
        )
    lost = _missing_files(words[1:2], started_in)
    # An interpreter's first argument is its script; the workspace begins with `system/` and has no other scripts.
    if lost and _INTERPRETER.fullmatch(Path(words[0]).name) and Path(lost[0]).parts[0] != "system":
        raise ConfigError(
            f"--agent {agent}: {os.path.abspath(started_in / lost[0])} not found; paths are relative to the folder in"
            " which the command is started"
        )
    return resolved


def _missing_files(words: Sequence[str], started_in: Path) -> list[str]:
    """The words that have the form of a file's name, without such a file."""
    form = re.compile(rf"(\./|\.\./)?[\w./-]+\.({_SCRIPTS}|toml|yaml|json)")
    return [word for word in words if form.fullmatch(word) and not (started_in / word).exists()]


def _absolute(words: Sequence[str], started_in: Path) -> list[str]:
    """The words, with absolute paths for files that exist in `started_in`."""
    # Links are not resolved: a virtual environment's python is one, and its target is outside the environment.
    return [os.path.abspath(started_in / word) if (started_in / word).is_file() else word for word in words]
