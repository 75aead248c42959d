r"""A table in LaTeX for a paper: booktabs rules, best in bold, second-best underlined, fitted to its page.

The output compiles with pdfLaTeX and the packages named in its first line. Long texts are broken into lines. A table of
many columns has panels one below the other that each repeat the row names; one of many rows goes on in further floats.
Each part is scaled down where it is wider or higher than its place (adjustbox).
"""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Sequence
from textwrap import wrap

import msgspec

from evopolicy_results.tables.table import DASH, Column, Table, texts_of

_COLUMNS = 10
"""Columns of a panel, besides those that name its rows."""
_ROWS = 45
"""Rows of a float."""
_LONG = 30
"""Length in characters above which a column's texts are broken into lines."""
_HEADING = 12
"""Length in characters above which a heading is broken between words."""
_UNBROKEN = 20
"""Length in characters above which a word without a natural break may be broken."""

_JOINER = "\N{WORD JOINER}"
_GREEK = (
    "αalpha βbeta γgamma δdelta εepsilon θtheta λlambda μmu πpi ρrho σsigma τtau ωomega ΔDelta ΣSigma ΩOmega"
)
_CHARACTERS = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "“": "``",
    "”": "''",
    "‘": "`",
    "’": "'",
    DASH: "--",
    "—": "---",
    "…": r"\ldots{}",
    "·": r"$\cdot$",
    "−": "$-$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "÷": r"$\div$",
    "≤": r"$\le$",
    "≥": r"$\ge$",
    "≠": r"$\ne$",
    "≈": r"$\approx$",
    "→": r"$\rightarrow$",
    "°": r"$^\circ$",
    "²": "$^2$",
    "µ": r"$\mu$",
    **{name[0]: rf"$\{name[1:]}$" for name in _GREEK.split()},
    _JOINER: "{}",
}
_ACCENTED = frozenset(map(chr, range(0xC0, 0x100))) - set("×÷ÐÞðþ")
"""Letters of Latin-1 that pdfLaTeX sets in any font encoding."""


def latex_text(text: str) -> str:
    """Escapes `text`: no LaTeX commands, no ligatures of dashes; letters as `_spelt` gives them, control characters
    become `?`."""
    return "".join(map(_character, re.sub("-(?=-)", "-" + _JOINER, " ".join(_spelt(text).split()))))


def _spelt(text: str) -> str:
    """`text` with code points in place of what pdfLaTeX cannot set, such as Arabic letters and emoji: names stay
    distinct."""
    groups = itertools.groupby(unicodedata.normalize("NFC", text), _is_unknown)
    return "".join(
        "-".join(f"U+{ord(one):04X}" for one in group) if unknown else "".join(group)
        for unknown, group in groups
    )


def _is_unknown(character: str) -> bool:
    return _character(character) == "?" != character and unicodedata.category(character) not in ("Cc", "Cs")


def _character(character: str) -> str:
    if character in _CHARACTERS:
        return _CHARACTERS[character]
    if character in _ACCENTED or (character.isascii() and character.isprintable()):
        return character
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return "".join(_CHARACTERS.get(one, one) for one in plain if one.isprintable()) or "?"


class _Column(msgspec.Struct, frozen=True):
    column: Column
    cells: list[str]
    is_long: bool

    @property
    def spec(self) -> str:
        if self.is_long:
            return ">{\\raggedright\\arraybackslash}p{12em}"
        return "l" if self.column.kind == "text" else "r"

    @property
    def heading(self) -> str:
        title = " ".join(self.column.title.split())
        lines = (
            [title] if self.is_long else wrap(title, _HEADING, break_long_words=False, break_on_hyphens=False)
        )
        words = "\\\\".join(map(latex_text, lines))
        return f"\\shortstack[{self.spec}]{{{words}}}" if len(lines) > 1 else words


def to_latex(table: Table) -> str:
    """The table as one `table` or, if it has many rows, several that go on under its number."""
    columns = [_column(table, column) for column in table.columns]
    # The first columns of text name a row; at least one does.
    n_names = next((i for i, one in enumerate(columns) if i and one.column.kind != "text"), len(columns))
    rest = columns[n_names:]
    size = max(1, -(-len(rest) // max(1, -(-len(rest) // _COLUMNS))))
    panels = [[*columns[:n_names], *rest[i : i + size]] for i in range(0, len(rest), size)] or [columns]
    parts = [range(i, min(i + _ROWS, len(table.rows))) for i in range(0, len(table.rows), _ROWS)] or [
        range(0)
    ]
    floats = [[_tabular(panel, part)] for part in parts for panel in panels]
    if len(panels) * len(table.rows) <= _ROWS:
        floats = [[tabular for (tabular,) in floats]]
    out = ["% needs \\usepackage{adjustbox,array,booktabs}"]
    caption = f"\\caption{{{latex_text(table.caption or table.title)}}}\\label{{tab:{table.name}}}"
    for number, tabulars in enumerate(floats):
        box = f"\\begin{{adjustbox}}{{max width=\\linewidth,max totalheight={0.7 / len(tabulars):.2f}\\textheight}}"
        more = "\\addtocounter{table}{-1}\\caption{(continued)}"
        out += ["\\begin{table}", "\\centering", more if number else caption]
        for tabular in tabulars:
            out += ["\\par\\vspace{0.75em}", box, *tabular, "\\end{adjustbox}"]
        out.append("\\end{table}")
    return "\n".join([*out, ""])


def _column(table: Table, column: Column) -> _Column:
    texts = texts_of(table, column)
    is_long = column.kind == "text" and max(map(len, texts), default=0) > _LONG
    cells = [
        _MARKED[table.marks.get((number, column.key), 0)].format(_cell(text, column, is_long))
        for number, text in enumerate(texts)
    ]
    return _Column(column, cells, is_long)


def _tabular(panel: Sequence[_Column], rows: range) -> list[str]:
    """The rows of a panel below its headings."""
    spec = "".join(one.spec for one in panel)
    lines = [" & ".join(one.cells[row] for one in panel) + " \\\\" for row in rows]
    headings = " & ".join(one.heading for one in panel) + " \\\\"
    return [
        f"\\begin{{tabular}}{{{spec}}}",
        "\\toprule",
        headings,
        "\\midrule",
        *lines,
        "\\bottomrule",
        "\\end{tabular}",
    ]


_MARKED = {0: "{}", 1: "\\textbf{{{}}}", 2: "\\underline{{{}}}"}


def _cell(text: str, column: Column, is_long: bool) -> str:
    if column.kind != "text":
        return latex_text(re.sub(r"^-(?=\d)", "−", text))
    if not is_long:
        return latex_text(text)
    return " ".join("\\allowbreak{}".join(map(latex_text, _pieces(word))) for word in text.split())


def _pieces(text: str) -> list[str]:
    """The parts of `text` that cannot be broken."""
    return re.findall(rf"[^\s/_,:=-]{{0,{_UNBROKEN - 1}}}[^\s]", text)
