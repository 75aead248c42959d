r"""A table in LaTeX for a paper: booktabs rules, best in bold, second-best underlined, fitted to its page.

The output compiles with pdfLaTeX and the packages named in its first line. A table that is too wide gets small type,
then headings and texts on several lines, then panels one below the other that each repeat the row names. A table that
is too long continues over pages. Widths are estimated from numbers of characters, since type cannot be measured here.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from textwrap import wrap

import msgspec
from msgspec.structs import replace

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
    """Escapes `text`: no LaTeX commands, no ligatures of dashes; unknown letters become `?`."""
    return "".join(map(_character, re.sub("-(?=-)", "-" + _JOINER, " ".join(text.split()))))


def _character(character: str) -> str:
    if character in _CHARACTERS:
        return _CHARACTERS[character]
    if character in _ACCENTED or (character.isascii() and character.isprintable()):
        return character
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return "".join(_CHARACTERS.get(one, one) for one in plain if one.isprintable()) or "?"


_NORMAL, _SMALL = (5.0, 12.0), (3.8, 6.0)
"""By size of type: average width of a character and extra width of a column, both in points."""


class _Fit(msgspec.Struct, frozen=True):
    """One column with its texts by row; widths in characters."""

    column: Column
    texts: list[str]
    least: int
    natural: int
    """Width with its heading broken between words and its text unbroken."""
    width: int = 0
    """Width as set; below `natural` its text is broken into lines."""


def to_latex(table: Table) -> str:
    """The table as `table`, or as `longtable` if it is longer than a page."""
    fits = [
        _fit(column, [shown(row.get(column.key), column) for row in table.rows]) for column in table.columns
    ]
    full = [max(len(fit.column.title), fit.natural) for fit in fits]
    if _room(full, _NORMAL) <= _WIDTH and len(table.rows) <= _LINES // 2:
        small = []
        panels = [[replace(fit, natural=n, width=n) for fit, n in zip(fits, full, strict=True)]]
    else:
        small = ["\\scriptsize", "\\setlength{\\tabcolsep}{3pt}"]
        panels = _panels(fits)
    caption = f"\\caption{{{latex_text(table.caption or table.title)}}}"
    label = f"\\label{{tab:{table.name}}}"
    is_long = sum(map(_height, panels)) > _LINES
    if is_long:
        out = ["% needs \\usepackage{array,booktabs,longtable}", "\\begingroup", *small]
    else:
        out = ["% needs \\usepackage{array,booktabs}", "\\begin{table}", "\\centering", caption, label]
        out += [*small, "\\par\\vspace{0.5em}"]
    for number, panel in enumerate(panels):
        spec = "".join(map(_spec, panel))
        heading = ["\\toprule", " & ".join(map(_heading, panel)) + " \\\\", "\\midrule"]
        rows = _rows(table, panel)
        if is_long:
            out += [f"\\begin{{longtable}}{{{spec}}}", *([] if number else [f"{caption}{label}\\\\"])]
            out += [*heading, "\\endfirsthead", *heading, "\\endhead", "\\bottomrule", "\\endfoot"]
            out += [*rows, "\\end{longtable}"]
        else:
            out += ["\\par\\vspace{0.75em}"] * bool(number)
            out += [f"\\begin{{tabular}}{{{spec}}}", *heading, *rows, "\\bottomrule", "\\end{tabular}"]
    return "\n".join([*out, "\\endgroup" if is_long else "\\end{table}", ""])


def _room(widths: Sequence[int], size: tuple[float, float]) -> float:
    character, gap = size
    return sum(character * width + gap for width in widths)


def _fit(column: Column, texts: list[str]) -> _Fit:
    natural = max(map(len, [*column.title.split(), *texts]), default=1)
    if column.kind != "text":
        return _Fit(column, texts, natural, natural)
    pieces = max((len(piece) for text in [column.title, *texts] for piece in _pieces(text)), default=1)
    fewest = _FEWEST_OF_PROSE if natural >= _PROSE else _FEWEST
    return _Fit(column, texts, min(natural, max(fewest, pieces)), natural)


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
    panels: list[list[_Fit]] = []
    for n in range(2, len(rest) + 1):
        size = -(-len(rest) // n)
        panels = [[*names, *rest[i : i + size]] for i in range(0, len(rest), size)]
        if all(_least(panel) <= _WIDTH for panel in panels):
            break
    return [_set(panel) for panel in panels or [fits]]


def _least(fits: Sequence[_Fit]) -> float:
    return _room([fit.least for fit in fits], _SMALL)


def _set(panel: list[_Fit]) -> list[_Fit]:
    """Sets the columns' widths to the available room, breaking the longest texts first."""
    cap = min(max(fit.natural for fit in panel), int(_WIDTH / _SMALL[0]))
    while cap > 0 and _room([_capped(fit, cap) for fit in panel], _SMALL) > _WIDTH:
        cap -= 1
    return [replace(fit, width=_capped(fit, cap)) for fit in panel]


def _capped(fit: _Fit, cap: int) -> int:
    return min(fit.natural, max(fit.least, cap))


def _height(panel: list[_Fit]) -> int:
    """Number of lines of a panel, including its heading and rules."""
    lines = ([-(-len(text) // max(1, fit.width)) for text in fit.texts] for fit in panel)
    rows: list[tuple[int, ...]] = list(zip(*lines, strict=True))
    return 4 + sum(map(max, rows))


def _spec(fit: _Fit) -> str:
    if fit.width < fit.natural:
        return f">{{\\raggedright\\arraybackslash}}p{{{_SMALL[0] * fit.width:.0f}pt}}"
    return "l" if fit.column.kind == "text" else "r"


def _heading(fit: _Fit) -> str:
    title = " ".join(fit.column.title.split())
    lines = wrap(title, max(1, fit.width), break_long_words=False, break_on_hyphens=False)
    side = "l" if fit.column.kind == "text" else "r"
    words = "\\\\".join(map(latex_text, lines))
    return f"\\shortstack[{side}]{{{words}}}" if len(lines) > 1 else words


_MARKED = {0: "{}", 1: "\\textbf{{{}}}", 2: "\\underline{{{}}}"}


def _rows(table: Table, panel: list[_Fit]) -> list[str]:
    columns = [
        [
            _MARKED[table.marks.get((number, fit.column.key), 0)].format(_cell(text, fit))
            for number, text in enumerate(fit.texts)
        ]
        for fit in panel
    ]
    return [" & ".join(cells) + " \\\\" for cells in zip(*columns, strict=True)]


def _cell(text: str, fit: _Fit) -> str:
    if fit.column.kind != "text":
        return latex_text(re.sub(r"^-(?=\d)", "−", text))
    if fit.width == fit.natural:
        return latex_text(text)
    return " ".join("\\allowbreak{}".join(map(latex_text, _pieces(word))) for word in text.split())
