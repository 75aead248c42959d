"""Sequences of typed records that convert to tables."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any, Generic, TypeVar, overload

import msgspec

R = TypeVar("R", bound=msgspec.Struct)

_SHOWN = 20
"""Rows of a table in a notebook."""


class Records(Sequence[R], Generic[R]):
    """Records of one kind, in order; `to_pandas` and `to_polars` make data frames when these packages are installed."""

    def __init__(self, kind: type[R], records: Sequence[R]) -> None:
        self._kind = kind
        self._records = tuple(records)

    @overload
    def __getitem__(self, index: int) -> R: ...

    @overload
    def __getitem__(self, index: slice) -> Records[R]: ...

    def __getitem__(self, index: int | slice) -> R | Records[R]:
        if isinstance(index, slice):
            return Records(self._kind, self._records[index])
        return self._records[index]

    def __len__(self) -> int:
        return len(self._records)

    def __repr__(self) -> str:
        return f"<{len(self)} {self._kind.__name__}>"

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the records' fields."""
        return self._kind.__struct_fields__

    @property
    def types(self) -> dict[str, str]:
        """Each field's type as the source writes it, such as `float | None`."""
        return {name: str(self._kind.__annotations__[name]) for name in self.columns}

    def to_dicts(self) -> list[dict[str, Any]]:
        """One dict per record."""
        return [msgspec.structs.asdict(one) for one in self]

    def to_pandas(self) -> Any:
        """Returns a pandas.DataFrame. Raises ModuleNotFoundError when pandas is not installed."""
        import pandas

        return pandas.DataFrame(self.to_dicts(), columns=list(self.columns))

    def to_polars(self) -> Any:
        """Returns a polars.DataFrame. Raises ModuleNotFoundError when polars is not installed."""
        import polars

        return polars.DataFrame({name: [getattr(one, name) for one in self] for name in self.columns})

    def _repr_html_(self) -> str:
        return self._table()

    def _table(self, first: int = 0) -> str:
        """Returns an HTML table of the first 20 rows. `first`: the first column."""
        columns = self.columns[first:]
        head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
        rows = [[html.escape(_text(getattr(one, name))) for name in columns] for one in self[:_SHOWN]]
        body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
        more = f"<p>… {len(self) - _SHOWN} more rows</p>" if len(self) > _SHOWN else ""
        return f"<table><tr>{head}</tr>{body}</table>{more}"


def _text(value: object) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def bars(values: Sequence[float | None], title: str) -> str:
    """Returns an SVG bar chart from zero, first value at the left; None leaves a gap. Empty text without values."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    low, high = min(0.0, *known), max(0.0, *known)
    span = (high - low) or 1.0
    width, height = 12, 120

    def y(value: float) -> float:
        return height * (high - value) / span

    drawn = "".join(
        f'<rect x="{width * index + 1}" y="{min(y(value), y(0.0)):.1f}" width="{width - 2}"'
        f' height="{max(1.0, abs(y(value) - y(0.0))):.1f}" fill="#4477aa"><title>{index}: {value:.4g}</title></rect>'
        for index, value in enumerate(values)
        if value is not None
    )
    return (
        f"<p>{html.escape(title)}: {min(known):.4g} to {max(known):.4g}</p>"
        f'<svg width="{width * len(values)}" height="{height}" role="img">{drawn}</svg>'
    )
