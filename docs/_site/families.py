"""Writes the table of families into README.md and docs/reference/environments.md: `python docs/_site/families.py`.

Rows come from the catalogue, the number of played ones from their tables, and the original's coverage from
original.toml.
"""

from __future__ import annotations

import re
import textwrap
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs

TOP = Path(__file__).parents[2]
LIST = TOP / "docs" / "reference" / "environments.md"
DOCUMENTS = (TOP / "README.md", LIST)
END = "<!-- End of what it writes. -->"


def table() -> str:
    """The table of docs/reference/environments.md and the lines beneath it, as Markdown."""
    original, families = _original(), _families()
    named, newest = original["paper"]["families"], original["newest"]
    lines = [
        "| suite | environments | named in the paper | extra |",
        "|---|--:|---|---|",
    ]
    for suite in families:
        ids = suite.environments
        family = installs.family_of(ids[0])
        row = installs.installs()[family]
        how = f"`evopolicy-worker setup {family}`" if row.pins or row.apart else f"`{row.extra}`"
        cells = (
            f"[`{suite.name}`](environments/{suite.name}.md)",
            f"{len(ids):,}",
            named.get(suite.name, "-"),
            how + (" and Chromium" if row.browser else ""),
        )
        lines.append(f"| {' | '.join(cells)} |")
    ids = sum(len(suite.environments) for suite in families)
    lacking = "; ".join(f"{name} ({why})" for name, why in newest["left_out"].items())
    rows = "\n".join(lines)
    return f"""{rows}

The {len(families)} suites hold {_total(families):,} environments; the suite `paper13` holds the {len(named)} families that the paper
names. The episodes of
{_share(sum(map(_deterministic, families)), ids)} ids depend only on seed and actions, and `check-env` has played
{_share(sum(each in played() for suite in families for each in suite.environments), ids)}.

{textwrap.fill(f"evopolicy lacks of the original software's newest version: {lacking}.", 125)}"""  # noqa: E501


def short() -> str:
    """The list of README.md."""
    families = _families()
    named = _original()["paper"]["families"]
    total, deterministic = _total(families), sum(map(_deterministic, families))
    ids = sum(len(suite.environments) for suite in families)
    every = "All are" if deterministic == ids else f"{deterministic:,} are"
    listed = ", ".join(
        f"{f'**`{suite.name}`**' if suite.name in named else f'`{suite.name}`'} {len(suite.environments):,}"
        for suite in families
    )
    text = (
        f"{listed}. The {len(families)} suites hold {total:,} environments; the paper names the families in bold"
        f" (together `paper13`). {every} deterministic: seed and actions determine the episode."
    )
    return textwrap.fill(text, 125, break_long_words=False, break_on_hyphens=False)


MARKS = {
    "<!-- Written by docs/_site/families.py. -->": table,
    "<!-- Written by docs/_site/families.py, short. -->": short,
}


def _original() -> dict[str, Any]:
    return tomllib.loads((TOP / "docs" / "_site" / "original.toml").read_text("utf-8"))


def _families() -> list[catalogue.Suite]:
    suites, families = catalogue.suites(), catalogue.families()
    return [each for name, each in suites.items() if name in families and name != "toy"]


def _deterministic(suite: catalogue.Suite) -> int:
    return sum(catalogue.entry(each).deterministic for each in suite.environments)


def _share(number: int, ids: int) -> str:
    return "all" if number == ids else f"{number:,}"


def _total(families: list[catalogue.Suite]) -> int:
    return len({each for suite in families for each in suite.environments})


@cache
def played() -> frozenset[str]:
    """The environments with a row on a page."""
    pages = "\n".join(path.read_text("utf-8") for path in sorted(LIST.with_suffix("").glob("*.md")))
    return frozenset(re.findall(r"^\| `(\S+)` \|", pages, re.MULTILINE))


def written(document: str) -> str:
    """A document with the table between its marks."""
    begin = next(mark for mark in MARKS if mark in document)
    before, _, rest = document.partition(begin)
    _, end, after = rest.partition(END)
    assert end, f"the document has no line {END!r} after {begin!r}"
    return f"{before}{begin}\n\n{MARKS[begin]()}\n\n{END}{after}"


if __name__ == "__main__":
    for path in DOCUMENTS:
        path.write_text(written(path.read_text("utf-8")), encoding="utf-8")
