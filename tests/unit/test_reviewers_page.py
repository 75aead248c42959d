"""The page of answers to reviewers: each question has an answer, and each answer evidence that exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/explanation/reviewers.md"
ROWS = [
    tuple(cell.strip() for cell in line.strip("|").split("|"))
    for line in PAGE.read_text().splitlines()
    if line.startswith("| ") and not line.startswith("| question")
]


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as links name them."""
    heads = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:40])
def test_each_answer_has_evidence_that_exists(row: tuple[str, ...]) -> None:
    question, answer, evidence = row
    assert question.endswith("?")
    assert answer in ("yes", "partly", "no")
    links = re.findall(r"\]\(([^)#]+)(?:#([^)]+))?\)", evidence)
    assert links or answer == "no"
    for target, anchor in links:
        path = (PAGE.parent / target).resolve()
        assert path.is_file(), target
        assert not anchor or anchor in anchors(path), (target, anchor)
    if answer != "yes":
        # Sentences after the evidence say what is missing.
        assert re.sub(r".*\]\([^)]+\)", "", evidence).strip(" .") or answer == "no"


def test_the_page_answers_with_each_of_the_three_words() -> None:
    assert {row[1] for row in ROWS} == {"yes", "partly", "no"}
    assert len(ROWS) >= 20
