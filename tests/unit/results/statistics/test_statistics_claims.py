"""Each claim of docs/explanation/statistics.md has a measured row, and the rows are within the page's bounds."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[4]
PAGE = (ROOT / "docs" / "explanation" / "statistics.md").read_text(encoding="utf-8")
CLAIMS: dict[str, Any] = runpy.run_path(str(ROOT / "tests" / "bench" / "coverage.py"))["CLAIMS"]
TABLES = dict(re.findall(r"<!-- claim: ([\w-]+) -->\n(.*?)<!-- end -->", PAGE, re.DOTALL))
SAYS = re.compile(
    r"cover(s|ed)?\b|false gap|every second|half of the experiments|resolved|on average", re.IGNORECASE
)
"""Words of sentences that claim how often something is right."""
NOT_CLAIMS = ("We chose them by measured coverage", "make bench-coverage", "Degrees of freedom")


def rows_of(name: str) -> dict[str, list[str]]:
    lines = [line.strip("|").split("|") for line in TABLES[name].strip().splitlines()]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in [lines[0], *lines[2:]]}


def test_the_page_and_the_bench_have_the_same_claims() -> None:
    assert set(TABLES) == set(CLAIMS)


@pytest.mark.parametrize("name", CLAIMS)
def test_a_claim_has_each_of_its_rows_by_setting(name: str) -> None:
    claim = CLAIMS[name]
    assert rows_of(name) == {claim.head: list(claim.columns)} | {
        setting: cells for setting, cells in rows_of(name).items() if setting in claim.rows
    }
    assert list(rows_of(name)) == [claim.head, *claim.rows]


def test_a_paragraph_that_claims_a_rate_names_its_row() -> None:
    text = re.sub(r"<!-- claim: .*?<!-- end -->", "", PAGE, flags=re.DOTALL)
    paragraphs = [part for part in text.split("\n\n") if not part.startswith(("|", "#", "```"))]
    claiming = [
        part for part in paragraphs if SAYS.search(part) and not any(text in part for text in NOT_CLAIMS)
    ]
    assert claiming
    assert [part for part in claiming if not re.search(r"<!-- by: ([\w-]+) -->", part)] == []
    assert set(re.findall(r"<!-- by: ([\w-]+) -->", PAGE)) == set(CLAIMS)


@pytest.mark.parametrize("name", CLAIMS)
def test_measured_rates_are_within_the_claimed_bounds(name: str) -> None:
    claim = CLAIMS[name]
    assert claim.exceptions <= set(claim.rows)
    for setting in claim.rows:
        for bounds, side in ((claim.at_least, 1.0), (claim.at_most, -1.0)):
            for bound, cell in zip(bounds, rows_of(name)[setting], strict=False):
                found = re.match(r"([\d.]+) ± ([\d.]+)", cell)
                if bound is not None and found is not None and setting not in claim.exceptions:
                    value, error = map(float, found.groups())
                    assert side * (value - bound) >= -2.0 * error, (setting, cell)
