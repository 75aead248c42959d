"""An operator's texts for agents: read from files, checked, digested."""

from __future__ import annotations

from pathlib import Path

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.run.texts import Texts, read
from evopolicy_gateway.workspace.prompts import FIRST, NEXT_TURN, STANDARD, Prompts


def test_without_files_the_texts_are_the_standard_ones_and_have_no_digest(tmp_path: Path) -> None:
    texts = read(None, None, None, tmp_path)
    assert texts == Texts()
    assert texts.digests == {"agents_md": "", "prompts": "", "inputs": ""}
    assert texts.prompts.begin() == FIRST
    assert "5 episodes of the budget are left" in texts.prompts.stopped(5)
    assert "Ask /info" in texts.prompts.stopped(None)
    assert "5 episodes of the budget are left" in texts.prompts.resumed(5)


def test_texts_replace_or_extend_the_standard_ones(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text('first = "$standard Be brief."\ngo_on = "$left left."\n')
    (tmp_path / "rules.md").write_text("My rules.")
    texts = read("rules.md", "p.toml", None, tmp_path)
    assert texts.prompts.begin() == f"{FIRST} Be brief."
    assert texts.prompts.stopped(3) == texts.prompts.stopped(3, NEXT_TURN) == "3 left."
    assert [len(digest) for digest in texts.digests.values()] == [64, 64, 0]


def test_an_agent_files_prompts_count_unless_the_run_has_some(tmp_path: Path) -> None:
    config = AgentConfig(harness="codex", prompts=Prompts(first="hers"))
    (tmp_path / "p.toml").write_text('first = "mine"\n')
    assert read(None, None, config, tmp_path).prompts.begin() == "hers"
    assert read(None, "p.toml", config, tmp_path).prompts.begin() == "mine"
    # A digest depends on the texts, not on where they stand.
    (tmp_path / "q.toml").write_text("# a comment\nfirst = 'hers'\n")
    assert read(None, "q.toml", None, tmp_path).digests == read(None, None, config, tmp_path).digests


def test_the_printed_prompts_are_the_standard_ones() -> None:
    printed = Prompts(**STANDARD)
    assert (printed.begin(), printed.stopped(4), printed.resumed(4)) == (
        Prompts().begin(),
        Prompts().stopped(4),
        Prompts().resumed(4),
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
        read(None, "p.toml", None, tmp_path)
    assert "p.toml" in str(caught.value)
