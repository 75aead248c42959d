"""How matplotlib draws all figures: rcParams, layout, SVG. Agents' looks are in `palette`."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import msgspec
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from evopolicy_common.terminal import harmless
from evopolicy_results.figures.plot import GRID, INK, MUTED, Plot
from evopolicy_results.studies.palette import Look

_POINTS_PER_REM = 11.0
"""Points per rem of the page: figures are shown slightly larger than printed."""

RC: dict[str, object] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    **dict.fromkeys(("font.size", "axes.labelsize"), 9.0),
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), MUTED),
    **dict.fromkeys(("axes.labelcolor", "axes.titlecolor", "text.color"), INK),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), INK),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.7),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.grid", "axes.axisbelow", "axes.unicode_minus"), True),
    **dict.fromkeys(("axes.facecolor", "figure.facecolor"), "none"),
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), 8.0),
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.0,
    "svg.fonttype": "none",
    "text.parse_math": False,  # an agent's name may contain a dollar sign
}


@contextmanager
def new_figure(
    width: float, height: float, *, names: Sequence[str] = (), **subplots: Any
) -> Iterator[tuple[Figure, Any]]:
    """A figure of that size in inches with constrained layout, and its axes as `Figure.subplots` returns them. `names`:
    of the axes' rows, from top to bottom."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(squeeze=False, **subplots)
        if names:
            name_rows(axes[0][0], names)
            for panel in axes[0]:
                panel.grid(axis="y", visible=False)
        yield figure, axes


def name_rows(panel: Axes, names: Sequence[str]) -> None:
    """Labels the rows 0, 1, … of a panel, the first at the top."""
    panel.set_yticks(range(len(names)), names)
    panel.set_ylim(len(names) - 0.5, -0.5)


def write_beside(panel: Axes, x: float, y: float, text: str, points: int, size: float = 8) -> None:
    """Writes `text` in that font size, so many points to the right of a place."""
    offset = (points, 0)
    panel.annotate(text, (x, y), xytext=offset, textcoords="offset points", va="center", fontsize=size)


def handles_of(entries: Iterable[str], looks: Mapping[str, Look]) -> list[Line2D]:
    return [
        Line2D([], [], color=look.colour, marker=look.marker, linestyle=look.dash, label=entry)
        for entry in entries
        for look in [looks[entry]]
    ]


def legend_above(figure: Figure, handles: Sequence[Line2D]) -> None:
    figure.legend(handles=handles, loc="outside upper center", ncols=min(5, len(handles)))


def drawn(plot: Plot) -> Plot:
    """The plot as SVG, without its figure."""
    if plot.figure is None:
        return plot
    width = round(plot.figure.get_figwidth() * 72.0 / _POINTS_PER_REM, 1)
    return msgspec.structs.replace(plot, svg=svg_text(plot.figure, plot.name), width=width, figure=None)


def svg_text(figure: Figure, name: str) -> str:
    """The figure as a stand-alone SVG: text as text, transparent background, deterministic bytes."""
    out = io.StringIO()
    with warnings.catch_warnings(), matplotlib.rc_context({**RC, "svg.hashsalt": name}):
        # The reader's fonts draw the text; the warning would print characters of names as they are.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        engine = figure.get_layout_engine()
        if engine is not None:
            engine.execute(figure)
            # Every pass moves the layout slightly. With "none", a placeholder stays, for which `savefig` draws twice.
            figure.set_layout_engine(None)
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return harmless(out.getvalue())  # XML has no control characters
