"""Tables and curves of a leaderboard site. Markup is in `html/templates/`; `write` writes the files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
from markupsafe import Markup

_WIDTH, _HEIGHT = 240.0, 72.0
_LONG = 60


class Link(msgspec.Struct, frozen=True):
    """A cell with a link."""

    text: str
    href: str


Cell = str | int | float | Link


def plain_view(
    ident: str, title: str, caption: str, columns: Sequence[str], rows: Sequence[Sequence[Cell]]
) -> dict[str, Any]:
    """A table for the page; cells that are numbers sort as numbers."""
    return {
        "id": f"{ident}-table",
        "title": title,
        "caption": caption,
        "files": [],
        "filter": len(rows) > 8,
        "folded": False,
        "columns": [
            {"title": name, "numeric": bool(rows) and _is_number(rows[0][place]), "note": ""}
            for place, name in enumerate(columns)
        ],
        "rows": [[_cell(cell) for cell in row] for row in rows],
    }


def _is_number(cell: Cell) -> bool:
    return isinstance(cell, int | float)


def _cell(cell: Cell) -> dict[str, Any]:
    text = cell.text if isinstance(cell, Link) else f"{cell:.4g}" if isinstance(cell, float) else str(cell)
    numeric = _is_number(cell)
    return {
        "text": text,
        "value": cell if numeric else None,
        "cls": "n" if numeric else "long" if len(text) > _LONG else "",
        "href": cell.href if isinstance(cell, Link) else None,
        "entry": text if isinstance(cell, str) else None,
    }


def curve_svg(sums: Sequence[float], label: str) -> Markup:
    """The sum of rewards over an episode as a small line."""
    low, high = min(sums), max(sums)
    span = high - low or 1.0
    step = _WIDTH / max(1, len(sums) - 1)
    points = " ".join(
        f"{place * step:.1f},{4.0 + (_HEIGHT - 8.0) * (1.0 - (value - low) / span):.1f}"
        for place, value in enumerate(sums)
    )
    return Markup(
        '<svg role="img" aria-label="{}" viewBox="0 0 {:g} {:g}" style="width:100%;height:auto">'
        '<polyline points="{}" fill="none" stroke="currentColor" stroke-width="1.5"/></svg>'
    ).format(label, _WIDTH, _HEIGHT, points)
