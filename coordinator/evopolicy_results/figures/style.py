"""Drawing and writing of all figures: rcParams, SVG and PNG. Agents' looks are in `palette`.

On a page, the ink, muted text and grid follow its light or dark theme: `inline_svg` replaces their three colours,
which nothing else uses, by CSS variables.
"""

from __future__ import annotations

import hashlib
import io
import re
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from evopolicy_common.terminal import harmless

INK = "#15181d"
MUTED = "#5c6773"
GRID = "#d5dae1"
PNG_DPI = 160

RC: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.0,
    "svg.fonttype": "none",
    "text.parse_math": False,  # an agent's name may contain a dollar sign
    "axes.unicode_minus": True,
}


@dataclass(slots=True, kw_only=True)
class Plot:
    """A drawn figure with its texts and data."""

    name: str
    """File name without suffix."""
    title: str
    caption: str
    alt: str
    """Alternative text that describes the figure."""
    data: Any
    """JSON-able: the numbers drawn."""
    figure: Figure
    group: str
    """Section of the report."""


def new_figure(width: float, height: float, **subplots: Any) -> tuple[Figure, Any]:
    """A figure of that size in inches with constrained layout, and its axes as `Figure.subplots` returns them."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        return figure, figure.subplots(squeeze=False, **subplots)


def _settle(figure: Figure) -> None:
    """Freezes the layout: every layout pass moves it slightly, and both files must show the same."""
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        for _ in range(2):
            engine.execute(figure)
        # With "none", a placeholder stays, for which `savefig` draws everything twice.
        figure.set_layout_engine(None)


def svg_text(figure: Figure, name: str) -> str:
    """The figure as a stand-alone SVG: text as text, transparent background, deterministic bytes."""
    out = io.StringIO()
    with matplotlib.rc_context({**RC, "svg.hashsalt": name}):
        _settle(figure)
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return harmless(out.getvalue())  # XML has no control characters


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG on white."""
    out = io.BytesIO()
    with matplotlib.rc_context(RC):
        _settle(figure)
        figure.savefig(out, format="png", dpi=PNG_DPI, facecolor="white")
    return out.getvalue()


_PROLOGUE = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_METADATA = re.compile(r"<metadata>.*?</metadata>\s*", re.DOTALL)
_SIZE = re.compile(r'(<svg[^>]*?) width="[^"]*"')
_HEIGHT = re.compile(r'(<svg[^>]*?) height="[^"]*"')
_IDS = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_THEME = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--grid)"}


def inline_svg(svg: str, name: str, alt: str) -> str:
    """The SVG for use inside a page: themed, scaling with its container, labelled for assistive technology, ids
    unique."""
    prefix = "f" + hashlib.sha256(name.encode()).hexdigest()[:8] + "-"
    body = _METADATA.sub("", _PROLOGUE.sub("", svg, count=1))
    body = _IDS.sub(lambda match: match.group(1) + prefix, body)
    for colour, variable in _THEME.items():
        body = body.replace(colour, variable)
    body = _HEIGHT.sub(r"\1", _SIZE.sub(r"\1", body, count=1), count=1)
    label = harmless(alt).replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    body = body.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return body.replace("'DejaVu Sans'", "system-ui, 'DejaVu Sans'")
