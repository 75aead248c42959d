"""Cards and their descriptions: an example, and the bytes that a check compares."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from evopolicy_results.publish import card as cards
from evopolicy_results.publish import contents, descriptions

EXAMPLE = Path(__file__).with_name("card-example.json")


@pytest.fixture
def example() -> cards.Card:
    return msgspec.json.decode(EXAMPLE.read_bytes(), type=cards.Card)


def test_the_example_is_a_cards_text(example: cards.Card) -> None:
    assert EXAMPLE.with_suffix(".md").read_text() == descriptions.markdown(example)
    assert contents.document(example) == EXAMPLE.read_bytes()


def test_the_same_card_gives_the_same_descriptions(example: cards.Card) -> None:
    """Published files hold these bytes, and a check makes them again: a change of them raises `VERSION`."""
    names = [contents.JOURNAL] + [
        f"{run.run}/{name}"
        for run in example.runs
        for name in (contents.RUN, contents.OPENING, contents.EPISODES)
    ]
    files = descriptions.files(example, dict.fromkeys(names, "0" * 64))
    digest = contents.digest(b"".join(files.values()))
    assert (cards.VERSION, digest) == (3, "fa65167542b9db796204ebaae2df13a970a7022850b827b1a84e7fb227d4c864")


def test_names_with_markup_stay_text_in_a_card(example: cards.Card) -> None:
    cell = msgspec.structs.replace(example.results[0], entry="a|b\n# <script>`x`")
    text = descriptions.markdown(msgspec.structs.replace(example, results=(cell,)))
    assert r"a\|b # \<script\>\`x\`" in text


@pytest.mark.parametrize(("moved", "is_same"), [(0.04, True), (0.06, False)])
def test_bounds_of_intervals_match_within_a_share_of_their_width(
    example: cards.Card, moved: float, is_same: bool
) -> None:
    number, cell = next((n, each) for n, each in enumerate(example.results) if each.low is not None)
    assert cell.low is not None
    assert cell.high is not None
    other = msgspec.structs.replace(cell, high=cell.high - moved * (cell.high - cell.low))
    results = (*example.results[:number], other, *example.results[number + 1 :])
    found = msgspec.structs.replace(example, results=results)
    assert (cards.matching(example, found) == found) is is_same
