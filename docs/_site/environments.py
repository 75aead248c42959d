"""Writes the tables of played environments, a page for each family: `python docs/_site/environments.py RESULTS`.

RESULTS is what `evopolicy-worker check-env --results` keeps. Rows of environments that it lacks stay as they are, and
so does the text above the table, which is written by hand. A family without a page gets one.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from evopolicy_common import catalogue
from evopolicy_worker.check_env import COLUMNS, read_checked

FOLDER = Path(__file__).parents[1] / "reference" / "environments"
MARK = "<!-- What follows is written by `make check-envs`. -->"
HEAD = """# {title}

`--env {name}` plays all environments of this page. [Environments](../environments.md#played-environments) explains the columns.

{mark}
"""  # noqa: E501


def shown() -> list[catalogue.Suite]:
    """Core16, and the suites that are families, in the order of the catalogue."""
    families = catalogue.families()
    return [each for name, each in catalogue.suites().items() if name == "core16" or name in families]


def earlier() -> str:
    """The text of all pages."""
    return "\n".join(path.read_text("utf-8") for path in sorted(FOLDER.glob("*.md")))


def written(suite: catalogue.Suite, results: Path | None, rows: str) -> str:
    """A family's page; `rows` has the rows of environments that are not in the results."""
    path = FOLDER / f"{suite.name}.md"
    usual = HEAD.format(title=suite.title, name=suite.name, mark=MARK)
    text, mark, _ = (path.read_text("utf-8") if path.exists() else usual).partition(MARK)
    assert mark, f"{path} has no line {MARK!r}"
    return f"{text}{MARK}\n\n{page(results, rows, suite.environments)}"


def page(results: Path | None, earlier: str = "", ids: Sequence[str] | None = None) -> str:
    """A Markdown table of the results in a file, with the number of environments played. `earlier`: a text whose rows
    stay where the file has none. `ids`: the environments, in order; by default the catalogue's."""
    rows = table(earlier)
    for env, each in (read_checked(results) if results else {}).items():
        rows[env] = each.cells()[1:]
    ids = list(catalogue.entries()) if ids is None else ids
    body = [f"| `{each}` | {' | '.join(rows[each])} |" for each in ids if each in rows]
    head = [f"| {' | '.join(COLUMNS)} |", "|---|--:|--:|---|---|---|--:|--:|---|"]
    return "\n".join([f"{len(body):,} of {len(ids):,} environments have been played.", "", *head, *body, ""])


def table(text: str) -> dict[str, tuple[str, ...]]:
    """The rows of pages without their ids, by environment id."""
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| `")]
    return {row[0].strip(" `"): tuple(map(str.strip, row[1:])) for row in rows if len(row) == len(COLUMNS)}


def write(results: Path | None, rows: str) -> None:
    """All pages."""
    for suite in shown():
        (FOLDER / f"{suite.name}.md").write_text(written(suite, results, rows), encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]), earlier())
