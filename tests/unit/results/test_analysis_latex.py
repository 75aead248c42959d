"""Tables in LaTeX: what is escaped, and that no table is wider or longer than its page.

Where pdfLaTeX is installed, what is written is also compiled.
"""

from __future__ import annotations

import re
import shutil
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from invented.small_table import TABLE
from program_runs import run_program

from evopolicy_results.tables.latex import latex_text, to_latex
from evopolicy_results.tables.table import Column, Table

WORDS = "what the agent said of its submit, in some more words than go into a line of a page"


def table(n_text: int, n_numbers: int, n_rows: int, text: str = WORDS) -> Table:
    texts = tuple(Column(f"t{i}", f"Text {i}") for i in range(n_text))
    numbers = tuple(Column(f"x{i}", f"Number {i}", "number") for i in range(n_numbers))
    row = {**{c.key: text for c in texts}, **{c.key: 1.5 for c in numbers}}
    columns = (Column("who", "Agent"), *texts, *numbers)
    rows = tuple({"who": f"agent {i}", **row} for i in range(n_rows))
    return Table(name="w", title="W", caption="", columns=columns, rows=rows)


def test_what_means_something_to_latex_is_escaped_and_the_best_are_marked() -> None:
    text = to_latex(TABLE)
    assert "A \\& B\\_1 & \\textbf{1.23} & 50 \\% & \\textbf{3} \\\\" in text
    assert "C\\textbar{}D & -- & 13 \\% & 0 \\\\" in text
    assert "E & \\underline{0.00} & -- & \\textbf{3} \\\\" in text
    assert "\\begin{tabular}{lrrr}" in text
    assert "\\caption{50 \\% of it.}" in text


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("0 … 1, −2 ≤ x", r"0 \ldots{} 1, $-$2 $\le$ x"),
        ("--model a---b", "-{}-model a-{}-{}-b"),
        ("é ﬁ 中\x00", "é fi U+4E2D?"),
        ("cafe\N{COMBINING ACUTE ACCENT} مثال", "café U+0645-U+062B-U+0627-U+0644"),
        ("fast 🚀", "fast U+1F680"),
        (" two\n lines ", "two lines"),
        ("\\input{/etc/passwd}", r"\textbackslash{}input\{/etc/passwd\}"),
    ],
)
def test_text_is_what_pdflatex_can_set(text: str, latex: str) -> None:
    assert latex_text(text) == latex


@given(st.text(st.characters(codec="utf-8")))
def test_no_text_holds_a_command_of_its_own_or_an_unknown_letter(text: str) -> None:
    found = latex_text(text)
    assert all(c.isascii() or (unicodedata.category(c) in ("Lu", "Ll") and ord(c) < 256) for c in found)
    assert "\n" not in found
    bare = re.sub(r"\\[&%$#_{}]", "", found)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    assert not set("%#&~") & set(bare)


def test_a_table_too_wide_is_in_panels_that_each_name_their_rows() -> None:
    text = to_latex(table(0, 24, 2))
    assert text.count("\\begin{tabular}") == text.count("\\end{tabular}") > 1
    assert text.count("\nagent 1 & ") == text.count("\\begin{tabular}")
    assert text.count(" & 1.500") == 48
    assert text.count("\\begin{table}") == text.count("\\label") == 1


def test_entries_of_other_scripts_stay_apart_within_the_page() -> None:
    names = ("模型甲", "模型乙", "مثال", "🚀", "🛸")
    columns = (Column("who", "Agent"), *(Column(f"x{i}", "Number", "number") for i in range(6)))
    rows = tuple({"who": name, **{f"x{i}": 1.5 for i in range(6)}} for name in names)
    text = to_latex(Table(name="n", title="N", caption="", columns=columns, rows=rows))
    shown = [line.partition(" & ")[0] for line in text.splitlines() if " & 1.500" in line]
    assert len({name.replace("\\allowbreak{}", "") for name in shown}) == len(names)
    assert not any("?" in name for name in shown)


def test_a_table_too_long_goes_on_in_further_floats_under_its_heading() -> None:
    text = to_latex(table(0, 3, 80))
    assert text.count("\\begin{table}") == text.count("\\toprule") == 2
    assert text.count("\\label") == text.count("\\addtocounter{table}{-1}\\caption{(continued)}") == 1
    assert text.count(" & 1.500") == 240
    assert text.count("Number") == 6


@pytest.mark.skipif(
    shutil.which("pdflatex") is None, reason="needs pdflatex: apt-get install texlive-latex-extra"
)
def test_what_is_written_compiles_and_fits_the_page(tmp_path: Path) -> None:
    names = []
    strange = f"{WORDS} \\input{{x}} _^~#$%& … − × 中 --x gymnasium/MiniGrid-ObstructedMaze-1Q-v1"
    for i, one in enumerate([TABLE, table(0, 24, 2), table(2, 3, 2), table(3, 30, 60, strange)]):
        (tmp_path / f"{i}.tex").write_text(to_latex(one))
        names.append(f"\\input{{{i}.tex}}")
    page = "\\documentclass{article}\\textwidth=397pt\\usepackage{adjustbox,array,booktabs}"
    (tmp_path / "all.tex").write_text(page + "\\begin{document}" + "\n".join(names) + "\\end{document}\n")
    for _ in range(2):
        done = run_program("pdflatex", "-interaction=nonstopmode", "all.tex", cwd=tmp_path)
        assert done.returncode == 0, done.stdout[-3000:]
    assert "Float too large" not in done.stdout
    assert "Overfull" not in done.stdout
