"""From templates to HTML: parts and pages, the rows of a table that a request selects, and how numbers and
states are written. Markup is in `templates/`; every value is escaped there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TypeVar
from urllib.parse import urlencode

import msgspec
from jinja2 import ChoiceLoader, Environment, PackageLoader

from evopolicy_common.cli.conventions import bytes_text
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import short
from evopolicy_coordinator.web.content.run_folders import key_of
from evopolicy_results import html
from evopolicy_results.html import PageView

T = TypeVar("T")

PAGE_ROWS = 50
"""Rows of a table on one page."""
STATES = {
    "pending": ("·", "waiting"),
    "running": ("▶", "running"),
    "open": ("▶", "training"),
    "interrupted": ("‖", "interrupted"),
    "validation": ("▷", "validating"),
    "heldout": ("▷", "held-out"),
    "random": ("▷", "random reference"),
    "finished": ("✓", "finished"),
    "completed": ("✓", "completed"),
    "no_ok_submit": ("∅", in_words("no_ok_submit")),
    "error": ("!", "failed"),
    "cancelled": ("×", "cancelled"),
    "unreadable": ("!", "unreadable"),
}
_PRIORITIES = {
    "reference": "random reference, evaluation",
    "hidden": "validation, held-out, hidden evaluation",
}


@cache
def _environment() -> Environment:
    shared = html.environment()
    loaders = [PackageLoader(__package__ or ""), PackageLoader("evopolicy_results.html")]
    own = shared.overlay(loader=ChoiceLoader(loaders))
    own.filters = {
        **shared.filters,
        "bytes": bytes_text,
        "short": short,
        "state": state_words,
        "priority": lambda name: _PRIORITIES.get(name, name),
    }
    return own


@cache
def static_files() -> dict[str, tuple[bytes, str]]:
    """Static files of the pages, by name: bytes and content type."""
    types = {".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8"}
    own, report = files(__package__ or "") / "static", files("evopolicy_results.html") / "templates"
    paths = [own / name for name in ("web.css", "web.js", "idiomorph.min.js")]
    paths += [report / name for name in ("report.css", "report.js")]
    return {path.name: (path.read_bytes(), types[Path(path.name).suffix]) for path in paths}


def part(name: str, /, **values: object) -> str:
    """The HTML of one part, by the macro that makes it: here, or among those of a run's page."""
    macro = getattr(_environment().get_template("parts.html.j2").module, name, None)
    return html.part(name, **values) if macro is None else str(macro(**values))


def page(template: str, *, view: PageView | None = None, **values: object) -> str:
    """A whole page; the elements of its `view` are kept up to date."""
    live = "" if view is None else " ".join(view.elements())
    return html.page(template, view=view, own=_environment(), live=live, frame="web.html.j2", **values)


def state_words(state: str) -> str:
    """A run's state as people read it."""
    return STATES.get(state, ("?", in_words(state)))[1]


# ---- tables ----


class Words(msgspec.Struct, frozen=True, kw_only=True):
    """A request's selection of a table."""

    q: str = ""
    """Words that must all occur in a row."""
    page: int = 0
    before: int | None = None
    """Of a log: only what stands before that place."""

    def link(self, **changed: object) -> str:
        """The query of the same page with other words."""
        query = {"q": self.q, "page": self.page, "before": self.before, **changed}
        return "?" + urlencode({name: value for name, value in query.items() if value})


def ident(*texts: str) -> str:
    """An id for HTML from any texts."""
    return "x" + key_of("\n".join(texts))


def paged(
    every: Iterable[T], words: Words, texts: Callable[[T], Iterable[str]], what: str
) -> tuple[Sequence[T], str]:
    """The rows of the page that `words` select, and the page's place. `texts`: of a row, for the search."""
    wanted = words.q.lower().split()
    rows = [row for row in every if all(word in " ".join(texts(row)).lower() for word in wanted)]
    last = max(0, (len(rows) - 1) // PAGE_ROWS)
    at = min(max(0, words.page), last)
    place = {
        "first": at * PAGE_ROWS + 1 if rows else 0,
        "last": min(len(rows), (at + 1) * PAGE_ROWS),
        "total": len(rows),
        "previous": words.link(page=at - 1) if at else "",
        "next": words.link(page=at + 1) if at < last else "",
    }
    shown = part("pages", ident=f"{what}-pages", what=f"{what}s", pages=place)
    return rows[at * PAGE_ROWS : (at + 1) * PAGE_ROWS], shown
