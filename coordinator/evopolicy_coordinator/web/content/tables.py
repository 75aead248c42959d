"""Tables of pages: the part of one that a request asks for, and the rows of its page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar
from urllib.parse import urlencode

import msgspec

from evopolicy_coordinator.web.content.run_folders import key_of

T = TypeVar("T")

PAGE_ROWS = 50
"""Rows of a table on one page."""


class Words(msgspec.Struct, frozen=True, kw_only=True):
    """A request's selection of a table."""

    q: str = ""
    """Words that must all occur in a row."""
    page: int = 0
    before: int | None = None
    """Of a log: only what stands before that place."""

    def link(self, **changed: Any) -> str:
        """The query of the same page with other words."""
        query = {"q": self.q, "page": self.page, "before": self.before, **changed}
        return "?" + urlencode({name: value for name, value in query.items() if value})


def ident(*texts: str) -> str:
    """An id for HTML from any texts."""
    return "x" + key_of("\n".join(texts))


def paged(
    every: Iterable[T], words: Words, texts: Callable[[T], Iterable[str]]
) -> tuple[Sequence[T], dict[str, Any]]:
    """The rows of the page that `words` select, and the page's place. `texts`: of a row, for the search."""
    wanted = words.q.lower().split()
    rows = [row for row in every if all(word in " ".join(texts(row)).lower() for word in wanted)]
    last = max(0, (len(rows) - 1) // PAGE_ROWS)
    at = min(max(0, words.page), last)
    view = {
        "first": at * PAGE_ROWS + 1 if rows else 0,
        "last": min(len(rows), (at + 1) * PAGE_ROWS),
        "total": len(rows),
        "previous": words.link(page=at - 1) if at else "",
        "next": words.link(page=at + 1) if at < last else "",
    }
    return rows[at * PAGE_ROWS : (at + 1) * PAGE_ROWS], view
