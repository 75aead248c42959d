"""Observations in feedback as the published software (v0.1.0) has them: by the size of an episode's stacked
observations.

Above `MOST_INLINE_BYTES` they are in `observations.npy`, or in `observations.npz` for flat dictionaries, whose arrays
are summed, and every row has `obs: null`; otherwise they are in the rows. Whole numbers that are all within 0 to 255
are stacked as uint8. Observations that do not stack, such as ragged ones, nested dictionaries and texts, stay in the
rows.
"""

from __future__ import annotations

import io
from typing import Any

import msgspec
import numpy as np

from evopolicy_common.records.episodes.npz import read_arrays
from evopolicy_common.records.episodes.rendered import MAX_OBSERVATIONS_BYTES, OBSERVATIONS, ROWS, SINGLE

MOST_INLINE_BYTES = 4096
STACKED = "observations.npy"

_rows = msgspec.json.Decoder(dict[str, msgspec.Raw])
_NULL = msgspec.Raw(b"null")


def as_published(files: dict[str, bytes]) -> dict[str, bytes]:
    """An episode's files with its observations where the published software has them. ValueError for a damaged file."""
    rows = [_rows.decode(line) for line in files[ROWS].splitlines()]
    beside = files.get(OBSERVATIONS)
    if beside is None:
        columns = _columns([msgspec.json.decode(row["obs"]) for row in rows])
    else:
        columns = read_arrays(beside, MAX_OBSERVATIONS_BYTES)
    if not rows or not columns:
        return files
    columns = {name: _small(column) for name, column in columns.items()}
    kept = {name: data for name, data in files.items() if name not in (ROWS, OBSERVATIONS)}
    if sum(column.nbytes for column in columns.values()) <= MOST_INLINE_BYTES:
        shown = [msgspec.Raw(msgspec.json.encode(_row(columns, t))) for t in range(len(rows))]
        return kept | {ROWS: _text(rows, shown if beside is not None else [row["obs"] for row in rows])}
    file = io.BytesIO()
    if list(columns) == [SINGLE]:
        np.save(file, columns[SINGLE])
    else:
        np.savez_compressed(file, **columns)
    name = STACKED if list(columns) == [SINGLE] else OBSERVATIONS
    return kept | {ROWS: _text(rows, [_NULL] * len(rows)), name: file.getvalue()}


def _columns(obs: list[Any]) -> dict[str, np.ndarray[Any, Any]]:
    """The stacked observations by name; empty if they do not stack."""
    if not obs:
        return {}
    names = list(obs[0]) if isinstance(obs[0], dict) else [SINGLE]
    parts = {name: [each[name] for each in obs] if isinstance(obs[0], dict) else obs for name in names}
    try:
        columns = {name: np.array(part) for name, part in parts.items()}
    except ValueError:
        return {}
    return columns if all(column.dtype.kind in "biuf" for column in columns.values()) else {}


def _small(column: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    if column.dtype.kind in "iu" and column.size and column.min() >= 0 and column.max() <= 255:
        return column.astype(np.uint8)
    return column


def _row(columns: dict[str, np.ndarray[Any, Any]], t: int) -> Any:
    if list(columns) == [SINGLE]:
        return columns[SINGLE][t].tolist()
    return {name: column[t].tolist() for name, column in columns.items()}


def _text(rows: list[dict[str, msgspec.Raw]], obs: list[msgspec.Raw]) -> bytes:
    return b"".join(
        msgspec.json.encode({**row, "obs": shown}) + b"\n" for row, shown in zip(rows, obs, strict=True)
    )
