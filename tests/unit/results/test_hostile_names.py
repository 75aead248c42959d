r"""Names and texts of strangers in reports: no script, no `\\input`, no control characters, nothing that reverses the
text after it."""

from __future__ import annotations

import csv
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

from hypothesis import given, settings
from hypothesis import strategies as st
from invented.policies import Version, policy
from invented.run_dirs import amend, write_run

from evopolicy_common.terminal import harmless
from evopolicy_coordinator.web.content.rendering import _environment as live_environment
from evopolicy_results.html import environment
from evopolicy_results.report import write_report
from evopolicy_results.studies.study import study
from evopolicy_results.tables.latex import to_latex
from evopolicy_results.tables.table import Column, Table, to_csv, to_markdown

PIECES = ["<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "\\input{/etc/passwd}", "$^_%&#~{", "\x1b[2J\x07\x0b",  # noqa: E501
          "\u202egnp.exe\u2066", "\u2028", "\ufeff", "{{7*7}}", "=cmd|'/C calc'!A0", "| a [b](javascript:c) `d`", "\n\n# title"]  # fmt: skip  # noqa: E501
hostile = st.one_of(st.text(), st.lists(st.sampled_from(PIECES), max_size=4).map("".join))
_COMMAND = re.compile(r"\\\\[A-Za-z]+")


class Page(HTMLParser):
    """The tags, attributes and texts of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.scripts = 0
        self.handlers: list[tuple[str, str]] = []
        self.found: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        self.handlers += [(tag, name) for name, _ in attrs if name.startswith("on")]
        self.found += [value or "" for name, value in attrs if name == "title"]

    def handle_data(self, data: str) -> None:
        self.found.append(data)


def is_shown_as_it_is(text: str) -> bool:
    return harmless(text) == text


@settings(max_examples=100, deadline=None)
@given(hostile)
def test_no_table_has_more_than_the_text(text: str) -> None:
    columns = (Column("who", text), Column(text, "X"), Column("n", "N", "integer"))
    row = {"who": text, text: text, "n": 1}
    table = Table(name="t", title=text, caption=text, columns=columns, rows=(row,))
    written = to_csv(table), to_markdown(table), to_latex(table)
    assert all(map(is_shown_as_it_is, written))
    lines = list(csv.reader(io.StringIO(written[0], newline="")))
    assert [len(line) for line in lines] == [3, 3]
    assert not any(cell.lstrip().startswith(("=", "@")) for line in lines for cell in line)
    assert "<" not in written[1]
    none = Table(name="t", title="", caption="", columns=(Column("who", ""), Column("x", "X")), rows=(row,))
    words = set(_COMMAND.findall(to_latex(none) + to_latex(table)))
    assert not words & {"\\input", "\\include", "\\write", "\\csname", "\\def", "\\catcode"}


@settings(max_examples=100, deadline=None)
@given(hostile)
def test_a_page_shows_the_text_and_nothing_else(text: str) -> None:
    for each in (environment(), live_environment()):
        page = each.from_string('<p title="{{ text }}">{{ text }}</p>').render(text=text)
        read = Page(page)
        assert (read.scripts, read.handlers) == (0, [])
        wanted = harmless(text)
        assert read.found[0] == wanted
        assert "".join(read.found[1:]) == wanted


def test_no_file_of_a_report_has_more_than_the_names(tmp_path: Path) -> None:
    name = "".join(PIECES)
    versions = [Version(policy(gain=gain), (-90.0,), -95.0, says=name) for gain in (1.0, 2.0)]
    for entry in ("one", "other"):
        run = write_run(tmp_path / "runs", versions, entry=entry)
        code = run / "checkpoints" / "submit_001" / "policy.py"
        code.chmod(0o644)
        code.write_text(f"# {name}\n" + code.read_text())
        agent = json.loads((run / "run.json").read_text())["agent"]
        agent = {key: f"{entry}{name}" for key, value in agent.items() if isinstance(value, str)}
        names = {"model": name, "env_title": name, "env_family": name, "exp_id": name}
        amend(run, {**names, "agent": agent, "outcome": {"closed_reason": name}})
    found = study([tmp_path / "runs"])
    assert len(found.runs) == 2
    write_report(found, tmp_path / "report")
    scripts = []
    for path in (tmp_path / "report").rglob("*.*"):
        if path.suffix in (".html", ".svg", ".csv", ".md", ".tex"):
            text = path.read_text()
            assert is_shown_as_it_is(text), path
            assert path.suffix == ".csv" or "<script>alert" not in text, path
            assert path.suffix != ".tex" or "\\input" not in text, path
        if path.suffix == ".svg":
            ElementTree.fromstring(text)
        if path.suffix == ".html":
            read = Page(text)
            assert read.handlers == [], path
            scripts.append(read.scripts)
    assert max(scripts) <= 1
