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


def test_a_wide_terminal_gets_a_line_for_each_row() -> None:
    lines = shown(120).splitlines()
    assert [line.split()[0] for line in lines] == ["worker", "w-attic-3f2a", "w-cellar-77aa"]


def test_a_phone_gets_a_line_for_each_cell_that_is_not_empty() -> None:
    lines = [line.rstrip() for line in shown(30).splitlines()]
    assert lines == [
        "worker        w-attic-3f2a",
        "host          attic.example.or",
        "              g",
        "state         active",
        "slots         12",
        "environments  gym/acrobot",
        "              gym/lunarlander",
        "",
        "worker  w-cellar-77aa",
        "host    cellar",
        "state   draining",
        "slots   4",
    ]


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


def test_a_narrow_table_of_few_columns_stays_a_table() -> None:
    lines = shown(30, ("name", "state"), (("w", "active"), ("x", "lost"))).splitlines()
    assert [line.split() for line in lines] == [["name", "state"], ["w", "active"], ["x", "lost"]]


def test_words_of_headings_and_whole_columns_never_fold() -> None:
    row = ("r-93859e511889fb5e", "gym/some-environment-of-a-long-name", "12")
    lines = shown(44, ("run", "environment", "running"), (row,)).splitlines()
    assert lines[0].split() == ["run", "environment", "running"]
    assert lines[1].split()[0] == "r-93859e511889fb5e"
    assert len(lines) == 4
