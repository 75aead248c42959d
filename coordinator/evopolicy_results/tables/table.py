"""A table as data, and its plain forms: CSV (full precision) and Markdown (rounded, best and second marked).

Cells contain text from agents and policies. In CSV a text that a spreadsheet would take for a formula gets a leading
apostrophe. In Markdown no text becomes HTML, an image or a link. Neither contains terminal control sequences.
"""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import msgspec
from msgspec.structs import replace

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_common.terminal import csv_cell, number, one_line
from evopolicy_results.statistics.aggregates import Bounded
from evopolicy_results.statistics.intervals import bounds_text, decimals, rounded

Kind = Literal["text", "integer", "number", "percent"]
INTERVAL = "95 % interval"
DASH = "–"
"""Shown for a missing value; CSV leaves the field empty."""


def at(record: object, path: str) -> object:
    """The attribute of a record at a path such as `gap.value`; None if an attribute on the way is None."""
    for name in path.split("."):
        record = None if record is None else getattr(record, name)
    return record


class Column(msgspec.Struct, frozen=True):
    """One column: its field, heading and display format."""

    key: str
    """Name of the field in CSV."""
    title: str
    kind: Kind = "text"
    digits: int = 3
    """Number of displayed decimals of a `number`."""
    below: bool = False
    """Whether a `number` above 0 but below its last decimal is shown as such (`<0.01`) instead of as 0."""
    note: str = ""
    """One-sentence explanation, shown on demand."""
    of: Callable[[Any], object] | str = ""
    """Its value in a record: a function, or a path of attributes (`at`); default: `key`."""
    spread: Callable[[Any], Estimate | Bounded | None] | None = None
    """The value with its interval, which gives the number of decimals."""

    def value(self, record: object) -> object:
        """The value in a record."""
        return self.of(record) if callable(self.of) else at(record, self.of or self.key)


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
    digits: dict[tuple[int, str], int] = {}
    """(row, column key) to the decimals that the number's interval supports."""
    runs: tuple[str, ...] = ()
    """By row, the name of the run that it is about; empty if the table is not about runs."""


def rows_of(records: Iterable[object], columns: Sequence[Column]) -> list[dict[str, Any]]:
    return [{column.key: column.value(each) for column in columns} for each in records]


def tabulated(
    name: str,
    title: str,
    columns: Sequence[Column],
    records: Iterable[Any],
    caption: str,
    *,
    run: Callable[[Any], str] | None = None,
) -> Table:
    """A row a record. `run`: the name of the run that a record is about."""
    records = list(records)
    known = [
        ((place, column.key), each)
        for place, record in enumerate(records)
        for column in columns
        if column.spread is not None and (each := column.spread(record)) is not None
    ]
    return Table(
        name=name,
        title=title,
        caption=caption,
        columns=tuple(columns),
        rows=tuple(rows_of(records, columns)),
        digits={key: n for key, each in known if (n := decimals(each.low, each.high)) is not None},
        runs=tuple(map(run, records)) if run is not None else (),
    )


def of_suites(tables: Sequence[tuple[str, Table]]) -> Table:
    """One table from those of several suites, given with the suites' titles: its first column names the suite."""
    (_, first), *others = tables
    if not others:
        return first
    every = [table for _, table in tables]
    columns = {column.key: column for table in every for column in table.columns}
    starts = list(itertools.accumulate((len(table.rows) for table in every), initial=0))
    captions = dict.fromkeys(sentence for table in every for sentence in _SENTENCE.findall(table.caption))
    return replace(
        first,
        title=first.title.removeprefix(tables[0][0]).strip().capitalize(),
        caption=" ".join(captions),
        columns=(Column("suite", "Suite"), *columns.values()),
        rows=tuple({"suite": title, **row} for title, table in tables for row in table.rows),
        marks=_moved(zip(starts, (table.marks for table in every), strict=False)),
        digits=_moved(zip(starts, (table.digits for table in every), strict=False)),
    )


def _moved(
    each: Iterable[tuple[int, dict[tuple[int, str], int]]],
) -> dict[tuple[int, str], int]:
    return {(start + row, key): value for start, own in each for (row, key), value in own.items()}


_SENTENCE = re.compile(r"\S.*?[.:](?=\s|$)")


def with_interval(
    key: str, title: str, of: Callable[[Any], Estimate | Bounded], digits: int
) -> tuple[Column, Column]:
    return (
        Column(key, title, "number", digits=digits, of=lambda each: of(each).value, spread=of),
        Column(f"{key}_interval", INTERVAL, of=lambda each: interval_text(of(each))),
    )


def interval_text(estimate: Estimate | Bounded | None) -> str | None:
    """The interval, or the reason why there is none."""
    if estimate is None:
        return None
    return bounds_text(estimate.value, estimate.low, estimate.high) or estimate.reason or None


def texts_of(table: Table, column: Column) -> list[str]:
    """A column's values as display texts. Where intervals give the decimals, a number without one has four digits."""
    digits = {place: n for (place, key), n in table.digits.items() if key == column.key}
    values = [row.get(column.key) for row in table.rows]
    return [
        _shown(value, column)
        if not digits or not isinstance(value, int | float)
        else rounded(value, digits[place])
        if place in digits
        else number(value)
        for place, value in enumerate(values)
    ]


def _shown(value: Any, column: Column) -> str:
    if value is None:
        return DASH
    if column.kind == "percent":
        return f"{100.0 * value:.0f} %"
    if column.kind == "number" and isinstance(value, int | float):
        least = 10.0**-column.digits
        is_below = column.below and 0.0 < value < least
        return f"<{least:.{column.digits}f}" if is_below else rounded(value, column.digits)
    return str(value)


def to_csv(table: Table) -> str:
    """Header of column keys; unrounded numbers; missing values empty; an apostrophe before formulas."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([csv_cell(column.key) for column in table.columns])  # may be names of agents
    writer.writerows([csv_cell(row.get(column.key)) for column in table.columns] for row in table.rows)
    return out.getvalue()


def to_markdown(table: Table) -> str:
    """A pipe table under its title; best in bold, second-best in italics."""
    title = f"## {_pipe(table.title)}"
    lines = [title, "", _pipe(table.caption), ""] if table.caption else [title, ""]
    lines.append("| " + " | ".join(_pipe(column.title) for column in table.columns) + " |")
    lines.append("|" + "|".join("---" if column.kind == "text" else "---:" for column in table.columns) + "|")
    wrap = {0: "{}", 1: "**{}**", 2: "*{}*"}
    texts = [texts_of(table, column) for column in table.columns]
    for place in range(len(table.rows)):
        cells = [
            wrap[table.marks.get((place, column.key), 0)].format(_pipe(own[place]))
            for column, own in zip(table.columns, texts, strict=True)
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


_MARKUP = re.compile(r"[\\|`\[\]<>]")
_ENTITIES = {"<": "&lt;", ">": "&gt;"}
"""Not every renderer accepts a backslash before these two."""


def _pipe(text: str) -> str:
    """A cell's text, escaped so that it neither ends the cell nor becomes HTML, code, a link or an image."""
    return _MARKUP.sub(lambda match: _ENTITIES.get(match[0], f"\\{match[0]}"), one_line(text))


def best_marks(rows: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[tuple[int, str], int]:
    """Marks 1 and 2 for the highest and second-highest value of each column; equal values share a mark."""
    marks: dict[tuple[int, str], int] = {}
    for key in keys:
        values = {i: row[key] for i, row in enumerate(rows) if row.get(key) is not None}
        for i, value in values.items():
            rank = 1 + sum(other > value for other in values.values())
            if rank <= 2 and len(values) > 1:
                marks[i, key] = rank
    return marks
