"""Prices of models from the operator's file."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from evopolicy import _cluster
from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.relay.usage import Prices
from evopolicy_gateway.run.texts import read_prices

FILE = '["m-1"]\ninput = 1.0\noutput = 10.0\n'
AGENT = 'harness = "codex"\nmodel = "m-1"\nmax_cost = 2.0\n'


def test_the_prices_of_the_agents_model_are_read(tmp_path: Path) -> None:
    (tmp_path / "prices.toml").write_text(FILE)
    config = AgentConfig(harness="codex", model="m-1")
    assert read_prices("prices.toml", config, tmp_path) == Prices(input=1.0, output=10.0)
    assert read_prices("prices.toml", None, tmp_path) is read_prices(None, config, tmp_path) is None


@pytest.mark.parametrize(
    ("text", "model", "told"),
    [
        (FILE, "m-2", r'has no prices for m-2: add a table \["m-2"\]'),
        (FILE, None, "the agent's model is not named"),
        ('["m-1"]\ninput = 1.0\n', "m-1", "missing required field `output`"),
        (FILE + "reading = 1.0\n", "m-1", "unknown field `reading`"),
        ("input = 1.0", "m-1", "Expected `object`"),
        ("[", "m-1", "prices.toml"),
    ],
)
def test_a_file_of_prices_is_named_with_its_fault(
    tmp_path: Path, text: str, model: str | None, told: str
) -> None:
    (tmp_path / "prices.toml").write_text(text)
    with pytest.raises(ConfigError, match=told):
        read_prices("prices.toml", AgentConfig(harness="codex", model=model), tmp_path)


def test_max_cost_needs_prices_which_an_option_gives(tmp_path: Path) -> None:
    (tmp_path / "prices.toml").write_text(FILE)
    (tmp_path / "agent.toml").write_text(AGENT)
    agent = f"file:{tmp_path / 'agent.toml'}"
    plan = _cluster.plan_of("toy/line", agent, prices=str(tmp_path / "prices.toml"), exp_id="e")
    terms = plan.harness().model
    assert terms is not None
    assert (terms.prices, terms.limits.max_cost) == (Prices(input=1.0, output=10.0), 2.0)
    without = msgspec.structs.replace(plan, prices=None)
    with pytest.raises(ConfigError, match=r"max_cost needs prices .* give a file with --prices"):
        without.harness()
    # Prices do not define a run: a sweep whose prices change goes on.
    assert plan.digest == without.digest
