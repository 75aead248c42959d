"""The operator's prices, from a file with a table for each model. No prices ship with this software."""

from __future__ import annotations

from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.regular_files import read_given
from evopolicy_gateway import shipped
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.relay.usage import Prices


def read(file: str | Path | None, config: AgentConfig | None, started_in: Path) -> Prices | None:
    """The prices of an agent's model; None without a file, or for an agent without a model. Raises
    ConfigError that names the file and the fault."""
    if file is None or config is None:
        return None
    path = shipped.found(file, started_in)
    try:
        tables = msgspec.toml.decode(read_given(path, f"--prices {path}"), type=dict[str, Prices])
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"--prices {path}: {error}") from error
    if config.model is None:
        raise ConfigError(
            f"--prices {path}: the agent's model is not named; write it as in codex:gpt-5.5, or in its file"
        )
    if config.model not in tables:
        raise ConfigError(
            f'--prices {path} has no prices for {config.model}: add a table ["{config.model}"] with input and'
            " output, in US dollars per million tokens"
        )
    return tables[config.model]
