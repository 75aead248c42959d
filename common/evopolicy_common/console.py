"""Tables, live views and progress bars, made with rich. The rules for all output are in `terminal`.

This is a module of its own because rich is large and most commands do not need it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import rich.console
from rich.console import ConsoleOptions, JustifyMethod, RenderableType, RenderResult
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from evopolicy_common.installation import as_called
from evopolicy_common.terminal import harmless

if TYPE_CHECKING:
    from rich.progress import Progress

T = TypeVar("T")
WIDTH = 200
"""Columns without a terminal: a truncated table is worse than a long line."""

_LEAST_WIDTH = 12
"""Least width of a column whose cells may fold, unless all words are shorter: words up to this length never break."""


class Terminal(rich.console.Console):
    """A console that prints texts literally: no markup, no emoji codes, no unprintable characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(harmless(as_called(text)), **options)

    def on_broken_pipe(self) -> None:
        # Concerns stderr: results are on stdout, which ends the program by itself.
        self.quiet = True

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            # Control segments come from rich itself: they move the cursor of a live table.
            yield segment if segment.control else segment._replace(text=harmless(segment.text))


class NarrowTable(Table):
    """A table without lines that becomes a list of its rows, a cell a line, where its columns have no room."""

    def __init__(self) -> None:
        super().__init__(box=None, pad_edge=False)

    def __rich_console__(self, console: rich.console.Console, options: ConsoleOptions) -> RenderResult:
        widths = [
            max(Measurement.get(console, options, cell).maximum for cell in (column.header, *column.cells))
            for column in self.columns
        ]
        least = [
            width
            if column.no_wrap
            else max(min(_longest_word(column), _LEAST_WIDTH), _longest_word(column.header))
            for width, column in zip(widths, self.columns, strict=True)
        ]
        gaps = len(widths) - 1
        gap = 2 if sum(widths) + 2 * gaps <= options.max_width else 1
        room = options.max_width - gap * gaps
        if sum(least) <= room:
            while sum(widths) > room:
                widest = max(range(len(widths)), key=lambda at: (widths[at] > least[at], widths[at]))
                widths[widest] -= 1
            self.padding = (0, gap, 0, 0)
            for column, width in zip(self.columns, widths, strict=True):
                column.width = width
            yield from super().__rich_console__(console, options)
            return
        for number, row in enumerate(zip(*(column.cells for column in self.columns), strict=True)):
            one = Table.grid(padding=(0, 2, 0, 0))
            one.add_column(style="dim", overflow="fold")
            one.add_column(overflow="fold")
            for column, cell in zip(self.columns, row, strict=True):
                if str(cell):
                    one.add_row(column.header, cell)
            yield from ([""] if number else [])
            yield one


def _longest_word(of: Column | RenderableType) -> int:
    texts = of.cells if isinstance(of, Column) else (of,)
    return max((len(word) for text in texts for word in str(text).split()), default=0)


def filled_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table of these rows without the columns in which every cell is empty."""
    kept = [index for index in range(len(headings)) if any(row[index] for row in rows)]
    made = table(*(headings[index] for index in kept))
    for row in rows:
        made.add_row(*(row[index] for index in kept))
    return made


def table(*headings: str, right: Collection[str] = (), whole: Collection[str] = ()) -> Table:
    """A table whose cells fold on narrow terminals, as other commands need their full content. `right`:
    headings of right-aligned columns. `whole`: headings of columns that never fold, as people copy them."""
    made = NarrowTable()
    for heading in headings:
        justify: JustifyMethod = "right" if heading in right else "left"
        made.add_column(heading, overflow="fold", justify=justify, no_wrap=heading in whole)
    return made


def listing(
    records: Iterable[T],
    columns: Mapping[str, Callable[[T], str]],
    *,
    right: Collection[str] = (),
    whole: Collection[str] = (),
) -> Table:
    """A `table` with a row a record. `columns`: by heading, the cell of a record."""
    made = table(*columns, right=right, whole=whole)
    for one in records:
        made.add_row(*(cell(one) for cell in columns.values()))
    return made


def progress_bars(console: Terminal) -> Progress:
    """A bar for each task, shown on a terminal alone."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def terminal(*, stderr: bool = False) -> Terminal:
    """A console as wide as the terminal, or `WIDTH` columns without one."""
    console = Terminal(stderr=stderr)
    return console if console.is_terminal else Terminal(stderr=stderr, width=WIDTH)
