"""An operator's files for a run: texts in place of the standard ones, skills and MCP servers, prices.

The digests are settings of the run, which its commitment covers; the texts and files themselves stay with the gateway.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.run_record import AgentInput, inputs_digest
from evopolicy_common.regular_files import read_given
from evopolicy_gateway import shipped
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.inputs import declared as inputs
from evopolicy_gateway.relay.usage import Prices
from evopolicy_gateway.workspace.agents_md import PLACEHOLDERS
from evopolicy_gateway.workspace.prompts import Prompts, check_text, read_prompts, read_text


class Texts(msgspec.Struct, frozen=True, kw_only=True):
    """The texts of one run."""

    agents_md: str = ""
    """In place of `AGENTS.md`; empty: the standard text."""
    prompts: Prompts = Prompts()
    inputs: tuple[AgentInput, ...] = ()
    """Skills and MCP servers."""

    @property
    def digests(self) -> dict[str, Any]:
        """By their names in `RunSettings`: SHA-256, hex; empty for a standard text."""
        text = hashlib.sha256(self.agents_md.encode()).hexdigest() if self.agents_md else ""
        return {"agents_md": text, "prompts": self.prompts.digest, "inputs": inputs_digest(self.inputs)}


def read(
    agents_md: str | Path | None, prompts: str | Path | None, config: AgentConfig | None, started_in: Path
) -> Texts:
    """The texts in these files; without `prompts` those of `config`. ConfigError names the file."""
    text, chosen = "", (None if config is None else config.prompts) or Prompts()
    if agents_md is not None:
        path = shipped.found(agents_md, started_in)
        text = read_text(path)
        check_text(str(path), text, PLACEHOLDERS)
    if prompts is not None:
        chosen = read_prompts(shipped.found(prompts, started_in))
    declared = () if config is None else inputs.read(config.skills, config.mcp, started_in)
    return Texts(agents_md=text, prompts=chosen, inputs=tuple(each.recorded for each in declared))


def read_prices(file: str | Path | None, config: AgentConfig | None, started_in: Path) -> Prices | None:
    """Prices of the agent's model in a file; None without file or settings. ConfigError names the file."""
    if file is None or config is None:
        return None
    path = shipped.found(file, started_in)
    try:
        tables = msgspec.toml.decode(read_given(path, f"--set prices={path}"), type=dict[str, Prices])
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"--set prices={path}: {error}") from error
    if config.model is None:
        raise ConfigError(
            f"--set prices={path}: the agent's model is not named; write it as in codex:gpt-5.5, or in its file"
        )
    if config.model not in tables:
        raise ConfigError(
            f'--set prices={path} has no prices for {config.model}: add a table ["{config.model}"] with input and'
            " output, in US dollars per million tokens"
        )
    return tables[config.model]
