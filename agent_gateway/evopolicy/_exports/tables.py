"""Runs, submits and episodes as CSV and Parquet files."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from evopolicy._records import Records
from evopolicy._runs import Runs
from evopolicy_common.terminal import csv_cell


def names(runs: Runs) -> dict[str, str]:
    """The name of each run below the folder that all have in common, by its path: files for others hold no path of this
    machine."""
    folders = [run.folder for run in runs]
    common = os.path.commonpath([(folder, *folder.parents)[:4][-1] for folder in folders]) if folders else ""
    return {str(folder): os.path.relpath(folder, common) for folder in folders}


def time_of(text: str) -> datetime:
    """1970 for a text that is no time: one damaged file must not end the export of all other runs."""
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError):
        return datetime.fromtimestamp(0, UTC)


def _tables(runs: Runs) -> Iterator[tuple[str, Records[Any], list[dict[str, Any]]]]:
    """A table's name, its records, and their rows."""
    known = names(runs)
    tables: dict[str, Records[Any]] = {
        "runs": runs.summaries(),
        "submits": runs.submits(),
        "episodes": runs.episodes(),
    }
    for name, records in tables.items():
        yield name, records, [row | {"run": known[row["run"]]} for row in records.to_dicts()]


def write_csv(runs: Runs, out: Path) -> list[Path]:
    """Writes `runs.csv`, `submits.csv` and `episodes.csv`: UTF-8, a header, empty cells for missing values."""
    written = []
    for name, records, rows in _tables(runs):
        path = out / f"{name}.csv"
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(records.columns)
            writer.writerows(map(csv_cell, row.values()) for row in rows)
        written.append(path)
    return written


def write_parquet(runs: Runs, out: Path) -> list[Path]:
    """Writes `runs.parquet`, `submits.parquet` and `episodes.parquet`, with columns of the records' types."""
    import pyarrow
    from pyarrow import parquet

    types = {"str": "string", "int": "int64", "float": "float64", "bool": "bool_"}
    written = []
    for name, records, rows in _tables(runs):
        fields = [
            pyarrow.field(column, getattr(pyarrow, types[text.partition(" ")[0]])(), nullable="None" in text)
            for column, text in records.types.items()
        ]
        path = out / f"{name}.parquet"
        parquet.write_table(pyarrow.Table.from_pylist(rows, schema=pyarrow.schema(fields)), path)
        written.append(path)
    return written
