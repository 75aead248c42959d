"""The paper's own tables, as package data to test the scoring against. `data/SOURCE.md` names the source of each."""

from __future__ import annotations

import csv
import io
from importlib.resources import files

from evopolicy_results.scoring.scores import ScoreTable, read_score_csv


def text(name: str) -> str:
    """The CSV text of one table, by its file's name without the ending."""
    return files("evopolicy_results").joinpath("data", f"{name}.csv").read_text(encoding="utf-8")


def heldout_returns() -> ScoreTable:
    """The paper's table of held-out returns: four agents and the random reference on Core16, one run per cell."""
    return read_score_csv(text("table1_heldout_returns"), source="table1_heldout_returns.csv")


def rows(name: str) -> list[dict[str, str]]:
    """One table as printed, one dict per row."""
    return list(csv.DictReader(io.StringIO(text(name))))
