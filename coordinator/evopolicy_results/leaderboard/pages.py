"""The pages of a leaderboard site as text. Markup is in `html/templates/`; `write` writes the files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from markupsafe import Markup

from evopolicy_results.html.pages import environment
from evopolicy_results.studies.palette import Look

MADE_BY = "Made by evopolicy leaderboard"
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


def section(ident: str, nav: str, *, title: str = "", **parts: Any) -> dict[str, Any]:
    """A section of the front page."""
    empty: dict[str, Any] = {
        "tables": [],
        "texts": [],
        "links": [],
        "reasons": [],
        "reasons_title": "",
        "code": "",
    }
    return {**empty, "id": ident, "nav": nav, "title": title or nav, **parts}


def front_page(
    *,
    title: str,
    lead: str,
    facts: Sequence[tuple[str, object]],
    notices: Sequence[dict[str, Any]],
    sections: Sequence[dict[str, Any]],
    looks: Mapping[str, Look],
) -> str:
    """`index.html`."""
    return (
        environment()
        .get_template("site.html.j2")
        .render(
            title=title,
            lead=lead,
            facts=facts,
            notices=notices,
            sections=sections,
            looks=looks,
            footer=f"{MADE_BY} from published results, each checked before it is shown.",
        )
    )


def bundle_page(
    *, title: str, lead: str, facts: Sequence[tuple[str, object]], tables: Sequence[dict[str, Any]]
) -> str:
    """Findings of the check of one file."""
    return (
        environment()
        .get_template("site_bundle.html.j2")
        .render(title=title, lead=lead, facts=facts, tables=tables)
    )


def episodes_page(*, title: str, lead: str, command: str, page: str, cards: Sequence[dict[str, Any]]) -> str:
    """The recorded held-out episodes of one run."""
    return (
        environment()
        .get_template("site_episodes.html.j2")
        .render(title=title, lead=lead, command=command, page=page, cards=cards)
    )


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
