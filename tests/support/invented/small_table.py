"""A small table with what written forms must take care of: special characters, gaps, ties, a value that rounds to
-0."""

from __future__ import annotations

from evopolicy_results.tables.table import Column, Table, best_marks

ROWS = (
    {"who": "A & B_1", "x": 1.23456, "share": 0.5, "n": 3},
    {"who": "C|D", "x": None, "share": 0.126, "n": 0},
    {"who": "E", "x": -0.0001, "share": None, "n": 3},
)
TABLE = Table(
    name="t",
    title="A table",
    caption="50 % of it.",
    columns=(
        Column("who", "Agent"),
        Column("x", "Score", "number", digits=2),
        Column("share", "Share", "percent"),
        Column("n", "Runs", "integer"),
    ),
    rows=ROWS,
    marks=best_marks(ROWS, ["x", "n"]),
)
