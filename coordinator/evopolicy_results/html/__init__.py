"""Pages of reports and sites."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from evopolicy_common.terminal import harmless


def visible(value: object) -> object:
    """A template's value: a text without control characters and marks that reverse text, markup as it is."""
    return harmless(value) if type(value) is str else value


def notice(title: str, lines: Iterable[str] = ()) -> dict[str, Any]:
    """A note above a page's content."""
    return {"title": title, "lines": list(lines)}


def section(ident: str, nav: str, *, title: str = "", ask: str = "", **parts: Any) -> dict[str, Any]:
    """A section of a front page. `nav`: its name in the navigation, and its heading unless `title` is given. `ask`: the
    question that it answers; the section is folded until it is asked for. Without one it is open."""
    lists = ("figures", "tables", "texts", "links", "picker", "reasons")
    empty: dict[str, Any] = {**{name: [] for name in lists}, "reasons_title": "", "code": ""}
    return {**empty, "id": ident, "nav": nav, "title": title or nav, "ask": ask, **parts}
