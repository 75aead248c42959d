"""An operator's files: texts for agents and prices of models, read, checked, and digested."""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import pytest

from evopolicy import _cluster
from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses.coding_agents.llm import listed_prices, prices_of
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig, ApiTable
from evopolicy_gateway.relay.usage import Prices
from evopolicy_gateway.run.plan import Texts, read_prices, read_texts
from evopolicy_gateway.workspace.prompts import FIRST, NEXT_TURN, Prompts


def test_without_files_the_texts_are_the_standard_ones_and_have_no_digest(tmp_path: Path) -> None:
    texts = read_texts(None, None, None, tmp_path)
    assert texts == Texts()
    assert texts.digests == {"agents_md": "", "prompts": "", "inputs": ""}
    assert texts.prompts.begin() == FIRST
    assert "5 episodes of the budget are left" in texts.prompts.stopped(5)
    assert "Ask /info" in texts.prompts.stopped(None)
    assert "5 episodes of the budget are left" in texts.prompts.resumed(5)


def test_texts_replace_or_extend_the_standard_ones(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text('first = "$standard Be brief."\ngo_on = "$left left."\n')
    (tmp_path / "rules.md").write_text("My rules.")
    texts = read_texts("rules.md", "p.toml", None, tmp_path)
    assert texts.prompts.begin() == f"{FIRST} Be brief."
    assert texts.prompts.stopped(3) == texts.prompts.stopped(3, NEXT_TURN) == "3 left."
    assert [len(digest) for digest in texts.digests.values()] == [64, 64, 0]


def test_an_agent_files_prompts_count_unless_the_run_has_some(tmp_path: Path) -> None:
    config = AgentConfig(harness="codex", prompts=Prompts(first="hers"))
    (tmp_path / "p.toml").write_text('first = "mine"\n')
    assert read_texts(None, None, config, tmp_path).prompts.begin() == "hers"
    assert read_texts(None, "p.toml", config, tmp_path).prompts.begin() == "mine"
    # A digest depends on the texts, not on where they stand.
    (tmp_path / "q.toml").write_text("# a comment\nfirst = 'hers'\n")
    assert (
        read_texts(None, "q.toml", None, tmp_path).digests == read_texts(None, None, config, tmp_path).digests
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('frist = "x"', "frist"),
        ('first = "$left"', "unknown placeholder"),
        ('go_on = ""', "is empty"),
        ("first = [", "p.toml"),
    ],
)
def test_a_file_of_prompts_that_cannot_be_used_is_named(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(ConfigError, match=fault) as caught:
        read_texts(None, "p.toml", None, tmp_path)
    assert "p.toml" in str(caught.value)


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
    with pytest.raises(ConfigError, match=r"max_cost needs prices .* give a file with --set prices"):
        without.harness()
    # Prices do not define a run: a sweep whose prices change goes on.
    assert plan.digest == without.digest


def test_prices_limit_the_cost_but_in_a_published_profile(tmp_path: Path) -> None:
    (tmp_path / "prices.toml").write_text(FILE)
    (tmp_path / "agent.toml").write_text('harness = "codex"\nmodel = "m-1"\n')
    agent, prices = f"file:{tmp_path / 'agent.toml'}", str(tmp_path / "prices.toml")
    with_prices = _cluster.plan_of("toy/line", agent, prices=prices, exp_id="e")
    published = msgspec.structs.replace(with_prices.settings, profile="published")
    plans = [
        (with_prices, 20.0),
        (_cluster.plan_of("toy/line", agent, exp_id="e"), None),
        (msgspec.structs.replace(with_prices, settings=published), None),
    ]
    for plan, expected in plans:
        terms = plan.harness().model
        assert terms is not None
        assert terms.limits.max_cost == expected


def test_the_built_in_agent_knows_its_providers_list_prices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ANTHROPIC_API_KEY", "key-of-nobody")
    plan = _cluster.plan_of("toy/line", "llm:anthropic/claude-sonnet-4-5", exp_id="e")
    terms = plan.harness().model
    assert terms is not None
    assert terms.prices is not None
    assert 0.0 < terms.prices.cache_read < terms.prices.input < terms.prices.output
    assert terms.limits.max_cost == 20.0
    own = ApiTable(provider="anthropic", base_url="http://127.0.0.1:1")
    assert prices_of(AgentConfig(harness="llm", model="claude-sonnet-4-5", api=own)) is None
    assert listed_prices("anthropic", "no-such-model") is None
    monkeypatch.setitem(sys.modules, "genai_prices.data_snapshot", None)
    assert listed_prices.__wrapped__("anthropic", "claude-sonnet-4-5") is None
