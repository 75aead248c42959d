"""Writes the table of families into README.md and docs/reference/environments.md: `python docs/_site/families.py`.

Rows come from the catalogue, times from the table of played environments, and the original's coverage from
original.toml.
"""

from __future__ import annotations

import textwrap
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_worker.check_env import span, tables

TOP = Path(__file__).parents[2]
LIST = TOP / "docs" / "reference" / "environments.md"
DOCUMENTS = (TOP / "README.md", LIST)
END = "<!-- End of what it writes. -->"

CPU = """*CPU ms*: processor time of a step of the library's environment alone, without accelerations ("bare"), and in a worker's slot
with its policy and recording: minimum, median, and maximum of the ids that were measured, of which *measured* is the number. `-`:
none was. `*`: one of them was measured while the machine had more work than cores."""  # noqa: E501


def table() -> str:
    """The table of docs/reference/environments.md and the lines beneath it, as Markdown."""
    original, families = _original(), _families()
    named, newest = original["paper"]["families"], original["newest"]
    lines = [
        (
            "| suite | environments | named in the paper | deterministic | played | measured | CPU ms, bare | CPU ms,"
            " slot | to install |"
        ),
        "|---|--:|---|--:|--:|--:|--:|--:|---|",
    ]
    for suite in families:
        ids = suite.environments
        deterministic, n_played = _deterministic(suite), sum(each in _tables()[0] for each in ids)
        family = installs.family_of(ids[0])
        row = installs.installs()[family]
        how = f"`evopolicy-worker setup {family}`" if row.pins or row.apart else f"extra `{row.extra}`"
        cells = (
            f"[`{suite.name}`](environments/{suite.name}.md)",
            f"{len(ids):,}",
            named.get(suite.name, "-"),
            "all" if deterministic == len(ids) else f"{deterministic:,}",
            "all" if n_played == len(ids) else f"{n_played:,}",
            *_cost(suite),
            how + (" and Chromium" if row.browser else ""),
        )
        lines.append(f"| {' | '.join(cells)} |")
    paper = original["paper"]
    lacking = "\n".join(f"- {name}: {why}" for name, why in newest["left_out"].items())
    rows = "\n".join(lines)
    return f"""{rows}

The {len(families)} suites hold {_total(families):,} environments; the suite `paper13` holds the {len(named)} families that the paper
names. The paper validates its protocol on {paper["validated"]} tasks. The newest version of the original software has
about {newest["profiles"]} environment profiles in {newest["ecosystems"]} ecosystems, each with its own lock file. *Deterministic*: ids whose episodes depend
only on seed and actions. *Played*: ids that `check-env` has played.
{CPU}

evopolicy lacks these environments of that version:

{lacking}"""  # noqa: E501


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


def _total(families: list[catalogue.Suite]) -> int:
    return len({each for suite in families for each in suite.environments})


def _cost(suite: catalogue.Suite) -> tuple[str, str, str]:
    """The number of ids that were measured, and the spans of the bare times and of the slot's, ms."""
    known = [times for each in suite.environments if any(times := _tables()[1].get(each, ("", "")))]
    bare, slot = (span([each[column] for each in known], per=1000) for column in (0, 1))
    return f"{len(known):,}", bare, slot


@cache
def _tables() -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    return tables("\n".join(path.read_text("utf-8") for path in sorted(LIST.with_suffix("").glob("*.md"))))


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
