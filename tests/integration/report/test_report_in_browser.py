"""The report in a real headless Chromium: no console errors, images load, sorting, filtering and themes work."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Page
from invented.study import write_suite
from typer.testing import CliRunner

from evopolicy_results.cli.report import app

pytestmark = pytest.mark.system  # make test installs no browser

COLUMN = """(() => {
  const table = document.getElementById(%r);
  return [...table.tBodies[0].rows].filter((row) => !row.hidden).map((row) => row.cells[%d].textContent.trim());
})()"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("browser")
    write_suite(folder / "runs", environments=("gym/acrobot", "gym/racing", "gym/ant5"), n_submits=6)
    result = CliRunner().invoke(app, [str(folder / "runs"), "--out", str(folder / "report")])
    assert result.exit_code == 0, result.output
    return folder / "report"


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with Page() as found:
        yield found


UNFOLD = "document.querySelectorAll('details.fold').forEach((one) => { one.open = true; })"


@pytest.fixture
def index(page: Page, report: Path) -> Page:
    page.look()
    page.problems.clear()
    page.open(report / "index.html")
    page.run(UNFOLD)
    return page


def test_the_first_screen_answers_and_the_rest_is_folded(page: Page, report: Path) -> None:
    page.look(width=1280, height=800)
    page.open(report / "index.html")
    bottom = "document.querySelector({!r}).getBoundingClientRect().bottom"
    assert page.run(bottom.format("dl.answers")) <= 800
    assert page.run(bottom.format("#figure-overview")) <= 800
    assert page.run("document.querySelector('dl.answers').innerText").startswith(
        "Core16 (3 of 16)\nNorthwind leads: "
    )
    assert page.run("document.documentElement.scrollHeight") <= 3 * 800
    folded = "document.getElementById('evolution-table').checkVisibility()"
    assert page.run(folded) is False
    page.run("document.querySelector('nav.bar a[href=\"#evolution\"]').click()")
    page.until(folded)


def test_a_long_table_ends_at_a_row_until_all_are_asked_for(index: Page) -> None:
    table = "document.querySelector('table.short.cut')"
    rows = f"[...{table}.tBodies[0].rows].filter((row) => row.checkVisibility()).length"
    assert index.run(rows) == 20
    name = index.run(f"{table}.id")
    index.run(f"document.querySelector('button.more[data-table={name}]').click()")
    shown = f"[...document.getElementById({name!r}).tBodies[0].rows].every((row) => row.checkVisibility())"
    assert index.run(shown)


def column(page: Page, table: str, place: int) -> list[str]:
    return page.run(COLUMN % (table, place))


def click_header(page: Page, table: str, place: int) -> str:
    header = f"document.getElementById({table!r}).tHead.rows[0].cells[{place}]"
    return page.run(f"{header}.querySelector('button').click(), {header}.getAttribute('aria-sort')")


def test_every_page_opens_without_console_problems_and_with_its_images(page: Page, report: Path) -> None:
    page.problems.clear()
    for path in sorted(report.rglob("*.html")):
        page.open(path)
        broken = page.run(
            "Promise.all([...document.images].map((image) => { image.loading = 'eager'; return image.decode().then(()"
            " => null, () => image.src); })).then((found) => found.filter(Boolean))"
        )
        assert broken == [], path
        assert page.run("document.querySelector('h1').textContent.length") > 3
    assert page.problems == []


def test_clicking_a_header_sorts_by_numbers_both_ways_with_empty_cells_last(index: Page) -> None:
    table = "evolution-table"
    headers = index.run(
        f"[...document.getElementById('{table}').tHead.rows[0].cells].map((cell) => cell.textContent)"
    )
    area, to_80 = headers.index("Area"), headers.index("To 80 % (episodes)")
    assert click_header(index, table, area) == "descending"
    values = [float(text) for text in column(index, table, area)]
    assert values == sorted(values, reverse=True)
    assert click_header(index, table, area) == "ascending"
    assert [float(text) for text in column(index, table, area)] == sorted(values)
    for _ in range(2):
        click_header(index, table, to_80)
        dashes = [text == "–" for text in column(index, table, to_80)]
        assert dashes == sorted(dashes)
        assert any(dashes)
    assert index.run("document.querySelectorAll('#evolution-table [aria-sort]').length") == 1


def test_filter_keeps_rows_with_every_word_and_counts_them(index: Page) -> None:
    index.run(
        "(() => { const input = document.querySelector('[data-filter=evolution-table]'); input.value = 'carracing KES';"
        " input.dispatchEvent(new Event('input')); })()"
    )
    assert column(index, "evolution-table", 0) == ["CarRacing"]
    assert column(index, "evolution-table", 1) == ["Kestrel"]
    assert index.run("document.getElementById('evolution-table-count').textContent") == "1 of 12 rows"


def test_timeline_picker_shows_one_environment_or_all(index: Page) -> None:
    shown = (
        "[...document.querySelectorAll('figure[data-timeline]')].filter((f) => !f.hidden).map((f) =>"
        " f.dataset.timeline)"
    )
    assert index.run(shown) == ["gym/acrobot"]
    choose = (
        "(() => {{ const p = document.getElementById('timeline-picker'); p.value = {!r}; p.dispatchEvent(new"
        " Event('change')); }})()"
    )
    index.run(choose.format("gym/ant5"))
    assert index.run(shown) == ["gym/ant5"]
    index.run(choose.format(""))
    assert len(index.run(shown)) == 3


def test_figure_is_saved_as_png(index: Page, tmp_path: Path) -> None:
    saved = index.run("""new Promise((done) => {
      HTMLAnchorElement.prototype.click = function () { done([this.download, this.href]); };
      document.querySelector('#figure-edit_hits button.png').click();
    })""")
    head, _, data = saved[1].partition(",")
    assert (saved[0], head) == ("edit_hits.png", "data:image/png;base64")
    picture = base64.b64decode(data)
    assert struct.unpack(">II", picture[16:24])[0] > 1000
    assert len(picture) > 10_000, "more than white"


def test_dark_theme_follows_the_system_and_the_button(index: Page) -> None:
    background = "getComputedStyle(document.body).backgroundColor"
    ink = "getComputedStyle(document.querySelector('figure svg text')).fill"
    light = index.run(background), index.run(ink)
    index.look(dark=True)
    dark = index.run(background), index.run(ink)
    assert light[0] == "rgb(255, 255, 255)"
    assert dark[0] != light[0]
    assert dark[1] != light[1]
    index.run("document.getElementById('theme').click()")
    assert index.run("document.documentElement.dataset.theme") == "light"
    assert (index.run(background), index.run(ink)) == light
    index.run("document.getElementById('theme').click()")
    index.run("document.getElementById('theme').click()")


def test_page_fits_a_phone_without_sideways_scrolling(page: Page, report: Path) -> None:
    page.look(width=390, height=800, phone=True)
    for path in [report / "index.html", *sorted((report / "traces").glob("*.html"))[:2]]:
        page.open(path)
        assert page.run("document.documentElement.scrollWidth") <= 390, path
        page.run(UNFOLD)
        assert page.run("document.documentElement.scrollWidth") <= 390, path
        assert page.run("window.innerWidth") == 390


def test_everything_can_be_reached_and_worked_by_keyboard(index: Page) -> None:
    focused = "document.activeElement"
    index.press("Tab")
    assert index.run(f"{focused}.textContent") == "Skip to the content"
    assert index.run(f"{focused}.getBoundingClientRect().left") >= 0
    index.press("Enter")
    assert index.run("location.hash") == "#main"
    stops = []
    for _ in range(25):
        index.press("Tab")
        stops.append(
            index.run(
                f"[{focused}.tagName, getComputedStyle({focused}).outlineStyle, {focused}.closest('main') !== null]"
            )
        )
    assert all(outline == "solid" and inside for _, outline, inside in stops), stops
    assert {tag for tag, _, _ in stops} >= {"DIV", "A", "BUTTON"}
    header = "document.getElementById('evolution-table').tHead.rows[0].cells[6]"
    index.run(f"{header}.querySelector('button').focus()")
    index.press("Enter")
    assert index.run(f"{header}.getAttribute('aria-sort')") == "descending"
    index.press("Space")
    assert index.run(f"{header}.getAttribute('aria-sort')") == "ascending"
    index.run("document.getElementById('timeline-picker').focus()")
    index.press("ArrowDown")
    assert (
        index.run("document.querySelector('figure[data-timeline]:not([hidden])').dataset.timeline")
        != "gym/acrobot"
    )
    scroller = "document.getElementById('audit-table').parentElement"
    index.run(f"{scroller}.focus()")
    assert index.run(f"{scroller}.scrollWidth > {scroller}.clientWidth")
    index.run(
        f"void (window.scrolled = new Promise((done) => {scroller}.addEventListener('scroll', () => done(true), {{"
        " once: true })))"
    )
    index.press("ArrowRight")
    assert index.run("window.scrolled")
    assert index.run(f"{scroller}.scrollLeft") > 0


@pytest.mark.parametrize("dark", [False, True])
def test_names_headings_landmarks_and_contrast_have_no_faults(page: Page, report: Path, dark: bool) -> None:
    for path in [report / "index.html", sorted((report / "traces").glob("*.html"))[0]]:
        page.look(dark=dark)
        page.open(path)
        page.run(UNFOLD)
        assert page.violations() == []
