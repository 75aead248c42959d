"""Pages of reports and sites, and how numbers are written on them. Markup is in `templates/`; every value is escaped
there."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import counted, duration, harmless, number
from evopolicy_results.figures.plot import inline_svg
from evopolicy_results.reading.environments import title_of


def visible(value: object) -> object:
    """A template's value: a text without control characters and marks that reverse text, markup as it is."""
    return harmless(value) if type(value) is str else value


class Notice(NamedTuple):
    """A note above a page's content."""

    title: str
    lines: Sequence[str] = ()


def section(ident: str, nav: str, *, title: str = "", ask: str = "", **parts: object) -> dict[str, object]:
    """A section of a front page. `nav`: its name in the navigation, and its heading unless `title` is given. `ask`: the
    question that it answers; the section is folded until it is asked for. Without one it is open."""
    lists = ("figures", "tables", "texts", "links", "picker", "reasons")
    empty: dict[str, object] = {**{name: [] for name in lists}, "reasons_title": "", "code": ""}
    return {**empty, "id": ident, "nav": nav, "title": title or nav, "ask": ask, **parts}


@cache
def environment() -> Environment:
    """The templates of all pages, with autoescaping."""
    made = Environment(
        loader=PackageLoader("evopolicy_results.html"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=visible,
    )
    made.filters |= {"number": number, "duration": duration, "words": in_words, "counted": counted}
    made.globals["inline"] = lambda plot: Markup(inline_svg(plot.svg, plot.name, plot.alt))
    made.globals["title_of"] = title_of
    for name in ("report.css", "report.js"):
        text = files(__package__ or "").joinpath("templates", name).read_text(encoding="utf-8")
        made.globals[name.split(".")[1]] = Markup(text)
    return made


def part(name: str, /, **values: object) -> str:
    """The HTML of one part of a run's page, by the macro that makes it."""
    return str(getattr(environment().get_template("run_parts.html.j2").module, name)(**values))


class PageView:
    """A page's content at one moment. Every part's HTML is one element whose id is the part's name."""

    def __init__(self, *lists: str) -> None:
        """`lists`: ids of the elements that hold lists of parts."""
        self.parts: dict[str, str] = {}
        self.lists: dict[str, list[str]] = {name: [] for name in lists}
        """By id of the element that holds them: names of parts, in order."""

    def row(self, of: str, ident: str, html: str) -> None:
        """Adds a part, once, to a list."""
        if ident not in self.parts:
            self.lists[of].append(ident)
            self.parts[ident] = html

    def elements(self) -> list[str]:
        """Ids of the elements that hold the content: the lists, and the parts in none of them."""
        listed = {name for order in self.lists.values() for name in order}
        return [*self.lists, *(name for name in self.parts if name not in listed)]


def page(
    template: str, *, view: PageView | None = None, own: Environment | None = None, **values: object
) -> str:
    """A page from the template of that name. In it `part(name)` and `listed(name)` put the view's parts, where it has
    them. `own`: the environment, unless it is the report's."""
    shown = view or PageView()

    def one(name: str) -> Markup:
        return Markup(shown.parts.get(name, ""))

    def listed(name: str) -> Markup:
        return Markup("".join(shown.parts[each] for each in shown.lists.get(name, ())))

    made = (own or environment()).get_template(f"{template}.html.j2")
    return made.render(part=one, listed=listed, **values)
