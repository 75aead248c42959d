"""Tables, live views and progress for people, made with rich. `terminal` has the rules of all that is printed.

A module of its own, as rich is large and most of what commands print needs none of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import rich.console
from rich.console import ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from evopolicy_common.terminal import harmless

WIDTH = 200
"""Columns where there is no terminal: a table that is cut off is worse than a long line."""


class Terminal(rich.console.Console):
    """A console that takes texts as they are: no markup, no emoji codes, nothing that is not printable."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(harmless(text), **options)

    def on_broken_pipe(self) -> None:
        # Of stderr: the results are on stdout, which ends the program by itself.
        self.quiet = True

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            # Control segments are rich's own: they move the cursor of a live table.
            yield segment if segment.control else segment._replace(text=harmless(segment.text))


def table(*headings: str, right: Collection[str] = ()) -> Table:
    """A table that cuts nothing: where the terminal is narrow, cells fold, as other commands need what stands in them.

    `right`: headings of columns that are aligned at the right.
    """
    made = Table(box=None, pad_edge=False)
    for heading in headings:
        made.add_column(heading, overflow="fold", justify="right" if heading in right else "left")
    return made


def terminal(*, stderr: bool = False) -> Terminal:
    """For people: as wide as their terminal, and `WIDTH` columns where there is none."""
    found = Terminal(stderr=stderr)
    return found if found.is_terminal else Terminal(stderr=stderr, width=WIDTH)
