r"""A table in LaTeX for a paper: booktabs rules, best in bold, second-best underlined, fitted to its page.

The output compiles with pdfLaTeX and the packages named in its first line. A table that is too wide gets small type,
then headings and texts on several lines, then panels one below the other that each repeat the row names. A table that
is too long continues over pages. Widths are estimated from numbers of characters, since type cannot be measured here.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

import msgspec

from evopolicy_results.tables.table import DASH, Column, Table, shown

_WIDTH = 375.0
"""Maximum width in points: slightly less than the text of common one-column styles, as bold is wider than average."""
_LINES = 50
"""Number of lines of small type that fit on a page under a caption."""
_FEWEST = 10
"""Minimum characters per line of a broken text; `_FEWEST_OF_PROSE` applies to texts of `_PROSE` characters or more."""
_FEWEST_OF_PROSE = 22
_PROSE = 60
_UNBROKEN = 20
"""Length in characters above which a word without a natural break may be broken."""

_JOINER = "\N{WORD JOINER}"
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
    **{name[0]: rf"$\{name[1:]}$" for name in ("αalpha", "βbeta", "γgamma", "δdelta", "εepsilon", "θtheta")},
    **{name[0]: rf"$\{name[1:]}$" for name in ("λlambda", "μmu", "πpi", "ρrho", "σsigma", "τtau", "ωomega")},
    **{name[0]: rf"$\{name[1:]}$" for name in ("ΔDelta", "ΣSigma", "ΩOmega")},
    _JOINER: "{}",
}
_ACCENTED = frozenset(map(chr, range(0xC0, 0x100))) - set("×÷ÐÞðþ")
"""Letters of Latin-1 that pdfLaTeX sets in any font encoding."""


def latex_text(text: str) -> str:
    """Escapes `text`: no LaTeX commands, no ligatures of dashes; unknown letters become `?`."""
    return "".join(map(_character, re.sub("-(?=-)", "-" + _JOINER, " ".join(text.split()))))


def _character(character: str) -> str:
    if character in _CHARACTERS:
        return _CHARACTERS[character]
    if character in _ACCENTED or (character.isascii() and character.isprintable()):
        return character
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return "".join(_CHARACTERS.get(one, one) for one in plain if one.isprintable()) or "?"


class _Type(msgspec.Struct, frozen=True):
    """A size of type: average width of a character and extra width of a column, both in points."""

    character: float
    gap: float


_NORMAL = _Type(5.0, 12.0)
_SMALL = _Type(3.8, 6.0)


class _Fit(msgspec.Struct, frozen=True):
    """The width of one column, in characters."""

    column: Column
    least: int
    natural: int
    """Width with its heading broken between words and its text unbroken."""
    width: int = 0
    """Width as set; below `natural` its text is broken into lines."""


def to_latex(table: Table) -> str:
    """The table as `table`, or as `longtable` if it is longer than a page."""
    cells = [[shown(row.get(column.key), column) for column in table.columns] for row in table.rows]
    caption = f"\\caption{{{latex_text(table.caption or table.title)}}}"
    label = f"\\label{{tab:{table.name}}}"
    full = [max([len(column.title), *map(len, texts)]) for column, texts in _columns(table, cells)]
    if _room(full, _NORMAL) <= _WIDTH and len(cells) <= _LINES // 2:
        fits = [[_Fit(column, n, n, n) for column, n in zip(table.columns, full, strict=True)]]
        small = []
    else:
        fits = _panels([_fit(column, texts) for column, texts in _columns(table, cells)])
        small = ["\\scriptsize", "\\setlength{\\tabcolsep}{3pt}"]
    lines = sum(_height(table, panel, cells) for panel in fits)
    if lines > _LINES:
        out = ["% needs \\usepackage{array,booktabs,longtable}", "\\begingroup", *small]
        for number, panel in enumerate(fits):
            above = [] if number else [f"{caption}{label}\\\\"]
            out += _longtable(table, panel, cells, above)
        return "\n".join([*out, "\\endgroup", ""])
    out = ["% needs \\usepackage{array,booktabs}", "\\begin{table}", "\\centering", caption, label, *small]
    out.append("\\par\\vspace{0.5em}")
    for number, panel in enumerate(fits):
        out += ["\\par\\vspace{0.75em}"] * bool(number) + _tabular(table, panel, cells)
    return "\n".join([*out, "\\end{table}", ""])


def _columns(table: Table, cells: list[list[str]]) -> list[tuple[Column, list[str]]]:
    return [(column, [row[i] for row in cells]) for i, column in enumerate(table.columns)]


def _room(widths: Sequence[int], type_: _Type) -> float:
    return sum(type_.character * width + type_.gap for width in widths)


def _fit(column: Column, texts: list[str]) -> _Fit:
    natural = max(map(len, [*column.title.split(), *texts]), default=1)
    if column.kind != "text":
        return _Fit(column, natural, natural, natural)
    pieces = max((len(piece) for text in [column.title, *texts] for piece in _pieces(text)), default=1)
    fewest = _FEWEST_OF_PROSE if natural >= _PROSE else _FEWEST
    return _Fit(column, min(natural, max(fewest, pieces)), natural, natural)


def _pieces(text: str) -> list[str]:
    """The parts of `text` that cannot be broken."""
    return re.findall(rf"[^\s/_,:=-]{{0,{_UNBROKEN - 1}}}[^\s]", text)


def _panels(fits: list[_Fit]) -> list[list[_Fit]]:
    """Groups of columns that fit side by side, each with the first columns, which name a row."""
    texts = next((i for i, fit in enumerate(fits) if fit.column.kind != "text"), len(fits))
    head = max(1, texts)
    while head > 1 and _least(fits[:head]) > _WIDTH / 3:
        head -= 1
    names, rest = fits[:head], fits[head:]
    if _least(fits) <= _WIDTH or not rest:
        return [_set(fits)]
    for n in range(2, len(rest) + 1):
        size = -(-len(rest) // n)
        panels = [[*names, *rest[i : i + size]] for i in range(0, len(rest), size)]
        if all(_least(panel) <= _WIDTH for panel in panels) or n == len(rest):
            return [_set(panel) for panel in panels]
    return [_set(fits)]


def _least(fits: Sequence[_Fit]) -> float:
    return _room([fit.least for fit in fits], _SMALL)


def _set(panel: list[_Fit]) -> list[_Fit]:
    """Sets the columns' widths to the available room, breaking the longest texts first."""
    cap = min(max(fit.natural for fit in panel), int(_WIDTH / _SMALL.character))
    while cap > 0 and _room([_capped(fit, cap) for fit in panel], _SMALL) > _WIDTH:
        cap -= 1
    return [msgspec.structs.replace(fit, width=_capped(fit, cap)) for fit in panel]


def _capped(fit: _Fit, cap: int) -> int:
    return min(fit.natural, max(fit.least, cap))


def _height(table: Table, panel: list[_Fit], cells: list[list[str]]) -> int:
    """Number of lines of a panel, including its heading and rules."""
    places = [(table.columns.index(fit.column), fit.width) for fit in panel]
    return 4 + sum(max(-(-len(row[i]) // max(1, width)) for i, width in places) for row in cells)


def _tabular(table: Table, panel: list[_Fit], cells: list[list[str]]) -> list[str]:
    begin = f"\\begin{{tabular}}{{{_spec(panel)}}}"
    rows = _rows(table, panel, cells)
    return [begin, "\\toprule", _heading(panel), "\\midrule", *rows, "\\bottomrule", "\\end{tabular}"]


def _longtable(table: Table, panel: list[_Fit], cells: list[list[str]], above: list[str]) -> list[str]:
    heading = ["\\toprule", _heading(panel), "\\midrule"]
    return [
        f"\\begin{{longtable}}{{{_spec(panel)}}}",
        *above,
        *heading,
        "\\endfirsthead",
        *heading,
        "\\endhead",
        "\\bottomrule",
        "\\endfoot",
        *_rows(table, panel, cells),
        "\\end{longtable}",
    ]


def _spec(panel: list[_Fit]) -> str:
    def one(fit: _Fit) -> str:
        if fit.width < fit.natural:
            return f">{{\\raggedright\\arraybackslash}}p{{{_SMALL.character * fit.width:.0f}pt}}"
        return "l" if fit.column.kind == "text" else "r"

    return "".join(map(one, panel))


def _heading(panel: list[_Fit]) -> str:
    def one(fit: _Fit) -> str:
        lines: list[str] = []
        for word in fit.column.title.split():
            if lines and len(lines[-1]) + 1 + len(word) <= fit.width:
                lines[-1] += f" {word}"
            else:
                lines.append(word)
        side = "l" if fit.column.kind == "text" else "r"
        words = "\\\\".join(map(latex_text, lines))
        return f"\\shortstack[{side}]{{{words}}}" if len(lines) > 1 else words

    return " & ".join(map(one, panel)) + " \\\\"


_MARKED = {0: "{}", 1: "\\textbf{{{}}}", 2: "\\underline{{{}}}"}


def _rows(table: Table, panel: list[_Fit], cells: list[list[str]]) -> list[str]:
    places = [(table.columns.index(fit.column), fit) for fit in panel]
    return [
        " & ".join(
            _MARKED[table.marks.get((number, fit.column.key), 0)].format(_cell(row[i], fit))
            for i, fit in places
        )
        + " \\\\"
        for number, row in enumerate(cells)
    ]


def _cell(text: str, fit: _Fit) -> str:
    if fit.column.kind != "text":
        return latex_text(re.sub(r"^-(?=\d)", "−", text))
    if fit.width == fit.natural:
        return latex_text(text)
    return " ".join("\\allowbreak{}".join(map(latex_text, _pieces(word))) for word in text.split())
