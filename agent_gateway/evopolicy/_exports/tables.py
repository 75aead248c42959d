"""Runs, submits and episodes as CSV and Parquet files."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from evopolicy._records import Records
from evopolicy._runs import Runs
from evopolicy_common.terminal import csv_cell


def _tables(runs: Runs) -> Iterator[tuple[str, Records[Any]]]:
    yield "runs", runs.summaries()
    yield "submits", runs.submits()
    yield "episodes", runs.episodes()


def write_csv(runs: Runs, out: Path) -> list[Path]:
    """Writes `runs.csv`, `submits.csv` and `episodes.csv`: UTF-8, a header, empty cells for missing values."""
    written = []
    for name, records in _tables(runs):
        path = out / f"{name}.csv"
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(records.columns)
            writer.writerows(
                [csv_cell(getattr(one, column)) for column in records.columns] for one in records
            )
        written.append(path)
    return written


def write_parquet(runs: Runs, out: Path) -> list[Path]:
    """Writes `runs.parquet`, `submits.parquet` and `episodes.parquet`, with columns of the records' types."""
    import pyarrow
    from pyarrow import parquet

    types = {
        "str": pyarrow.string(),
        "int": pyarrow.int64(),
        "float": pyarrow.float64(),
        "bool": pyarrow.bool_(),
    }
    written = []
    for name, records in _tables(runs):
        fields = [
            pyarrow.field(column, types[str(text).partition(" ")[0]], nullable="None" in str(text))
            for column, text in records.types.items()
        ]
        path = out / f"{name}.parquet"
        parquet.write_table(
            pyarrow.Table.from_pylist(records.to_dicts(), schema=pyarrow.schema(fields)), path
        )
        written.append(path)
    return written
