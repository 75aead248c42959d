"""A table as data, and its plain forms: CSV (full precision) and Markdown (rounded, best and second marked)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any, Literal

import msgspec

Kind = Literal["text", "integer", "number", "percent"]
DASH = "–"
"""Shown where there is no value; CSV leaves the field empty."""


class Column(msgspec.Struct, frozen=True, kw_only=True):
    """One column: its field, its heading and how its values are shown."""

    key: str
    """Name of the field in CSV."""
    title: str
    kind: Kind = "text"
    digits: int = 3
    """Decimals that a `number` is shown with."""
    below: bool = False
    """A `number` above 0 that is less than its last decimal is shown as such (`<0.01`), not as 0."""
    note: str = ""
    """What it means, in a sentence, shown on demand."""


class Table(msgspec.Struct, frozen=True, kw_only=True):
    """Rows of values by column key; a missing or None value is shown as a dash."""

    name: str
    """File name without suffix."""
    title: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[dict[str, Any], ...]
    marks: dict[tuple[int, str], int] = {}
    """(row, column key) to 1 for the best and 2 for the second-best of its column."""
    links: dict[int, str] = {}
    """Row to a page about it, relative to the report."""


def shown(value: Any, column: Column) -> str:
    """`value` as text for reading; a true minus is not used, so that numbers can be copied."""
    if value is None:
        return DASH
    if column.kind == "percent":
        return f"{100.0 * value:.0f} %"
    if column.kind == "number" and isinstance(value, int | float):
        least = 10.0**-column.digits
        if column.below and 0.0 < value < least:
            return f"<{least:.{column.digits}f}"
        text = f"{value:.{column.digits}f}"
        return text.removeprefix("-") if float(text) == 0.0 else text
    return str(value)


def to_csv(table: Table) -> str:
    """Header of column keys; numbers unrounded; empty for no value."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([column.key for column in table.columns])
    for row in table.rows:
        values = [row.get(column.key) for column in table.columns]
        writer.writerow(["" if value is None else value for value in values])
    return out.getvalue()


def to_markdown(table: Table) -> str:
    """A pipe table under its title; best in bold, second-best in italics."""
    lines = [f"## {table.title}", "", table.caption, ""] if table.caption else [f"## {table.title}", ""]
    lines.append("| " + " | ".join(_pipe(column.title) for column in table.columns) + " |")
    lines.append("|" + "|".join("---" if column.kind == "text" else "---:" for column in table.columns) + "|")
    wrap = {0: "{}", 1: "**{}**", 2: "*{}*"}
    for number, row in enumerate(table.rows):
        cells = [
            wrap[table.marks.get((number, column.key), 0)].format(_pipe(shown(row.get(column.key), column)))
            for column in table.columns
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _pipe(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def best_marks(rows: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[tuple[int, str], int]:
    """Marks 1 and 2 for the highest and second-highest value of each column; equal values share a mark (as ranks do)."""
    marks: dict[tuple[int, str], int] = {}
    for key in keys:
        values = {i: row[key] for i, row in enumerate(rows) if row.get(key) is not None}
        for i, value in values.items():
            rank = 1 + sum(other > value for other in values.values())
            if rank <= 2 and len(values) > 1:
                marks[i, key] = rank
    return marks
