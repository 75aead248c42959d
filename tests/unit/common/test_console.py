"""Tables on wide and on narrow terminals: nothing of a cell is lost."""

from __future__ import annotations

import io

import pytest

from evopolicy_common.console import Terminal, table

ROWS = (
    ("w-attic-3f2a", "attic.example.org", "active", "12", "gym/acrobot gym/lunarlander"),
    ("w-cellar-77aa", "cellar", "draining", "4", ""),
)
HEADINGS = ("worker", "host", "state", "slots", "environments")


def shown(width: int, headings: tuple[str, ...] = HEADINGS, rows: tuple[tuple[str, ...], ...] = ROWS) -> str:
    made = table(*headings, right=("slots",), whole=("run",))
    for row in rows:
        made.add_row(*row)
    out = io.StringIO()
    Terminal(file=out, width=width).print(made)
    return out.getvalue()


@pytest.mark.parametrize("width", [24, 40, 60, 80, 100, 200])
def test_no_line_is_longer_than_the_terminal_and_no_letter_is_lost(width: int) -> None:
    text = shown(width)
    assert max(map(len, text.splitlines())) <= width
    cells = "".join("".join(row) for row in ROWS)
    once = "".join(HEADINGS) + cells
    by_row = (
        "".join(heading for row in ROWS for heading, cell in zip(HEADINGS, row, strict=True) if cell) + cells
    )
    letters = sorted("".join(text.split()))
    assert letters in (sorted(once.replace(" ", "")), sorted(by_row.replace(" ", "")))
