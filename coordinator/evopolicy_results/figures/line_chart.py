"""Small charts as SVG, written by hand with attributes only: the content security policy allows no inline style."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from typing import NamedTuple

from evopolicy_results.studies.palette import COLOURS, REFERENCE

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 760.0, 62.0, 14.0, 26.0, 30.0
_DASHES = ("", "6 3", "2 3", "8 3 2 3")
_MAX_POINTS = 600
"""Of one line: more than that a screen cannot show."""


class ChartLine(NamedTuple):
    """One line: points in order of x; a point whose y is no finite number makes a gap."""

    name: str
    points: Sequence[tuple[float, float]]
    dots: bool = False
    steps: bool = False
    """Whether a value holds until the next one."""
    colour: str = ""
    """Instead of that of its place; such a line with steps is dashed."""


def chart(
    title: str,
    x_title: str,
    lines: Sequence[ChartLine],
    *,
    height: float = 180.0,
    x_max: float | None = None,
    reference: tuple[str, float] | None = None,
) -> str:
    """A chart; empty where no line has a point. `reference`: name and value of a dashed level line."""
    lines = [line._replace(points=_thinned(line.points)) for line in lines]
    values = [y for line in lines for _, y in line.points if math.isfinite(y)]
    xs = [x for line in lines for x, y in line.points if math.isfinite(y)]
    if not values:
        return ""
    if reference is not None:
        values.append(reference[1])
    low, high = min(values), max(values)
    room = (high - low) * 0.06 or max(1.0, abs(high) * 0.1)
    low, high = low - room if low < 0 else max(0.0, low - room), high + room
    x_low, x_high = min(0.0, *xs), max(x_max or 0.0, *xs, 1e-9)

    def x(value: float) -> float:
        return _LEFT + (value - x_low) / (x_high - x_low) * (_WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return _TOP + (high - value) / (high - low) * (height - _TOP - _BOTTOM)

    out = [
        f'<svg role="img" aria-label="{escape(title, quote=True)}" viewBox="0 0 {_WIDTH:g} {height:g}" '
        'font-family="system-ui, sans-serif" font-size="11">'
        f'<text x="{_LEFT}" y="14" font-weight="600" class="ink">{escape(title)}</text>'
    ]
    for tick in _ticks(low, high):
        out.append(
            f'<path d="M{_LEFT} {y(tick):.1f}H{_WIDTH - _RIGHT}" class="rule"/>'
            f'<text x="{_LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end" class="ink">{_number(tick)}</text>'
        )
    for tick in _ticks(x_low, x_high):
        out.append(
            f'<text x="{x(tick):.1f}" y="{height - _BOTTOM + 14:.1f}" text-anchor="middle"'
            f' class="ink">{_number(tick)}</text>'
        )
    out.append(
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{height - 3:.1f}" text-anchor="middle"'
        f' class="dim">{escape(x_title)}</text>'
    )
    if reference is not None:
        name, level = reference
        out.append(
            f'<path d="M{_LEFT} {y(level):.1f}H{_WIDTH - _RIGHT}" fill="none" stroke="{REFERENCE}" stroke-dasharray="5'
            f' 3"><title>{escape(name)}: {level:.4g}</title></path>'
        )
    for place, line in enumerate(lines):
        colour, dash = _stroke(place, line)
        path = _path(line, x, y)
        out.append(
            f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.6"'
            + (f' stroke-dasharray="{dash}"' if dash else "")
            + f"><title>{escape(line.name)}</title></path>"
        )
        if line.dots:
            out += [
                f'<circle cx="{x(px):.1f}" cy="{y(py):.1f}" r="3.2" fill="{colour}"><title>{escape(line.name)} at'
                f" {px:g}: {py:.4g}</title></circle>"
                for px, py in line.points
                if math.isfinite(py)
            ]
    out.append("</svg>")
    if len(lines) > 1 or reference is not None:
        out.append(_legend(lines, reference))
    return "".join(out)


def _legend(lines: Sequence[ChartLine], reference: tuple[str, float] | None) -> str:
    strokes = []
    for place, line in enumerate(lines):
        colour, dash = _stroke(place, line)
        strokes.append((line.name, f'"{colour}"' + (' stroke-dasharray="4 2"' if dash else "")))
    if reference is not None:
        strokes.append((reference[0], f'"{REFERENCE}" stroke-dasharray="4 2"'))
    items = (
        '<li><svg class="mark" viewBox="0 0 16 16" aria-hidden="true"><path d="M1 8h14" stroke-width="3" '
        f"stroke={stroke}/></svg>{escape(name)}</li>"
        for name, stroke in strokes
    )
    return f'<ul class="legend">{"".join(items)}</ul>'


def _stroke(place: int, line: ChartLine) -> tuple[str, str]:
    """Colour and dash."""
    if line.colour:
        return line.colour, _DASHES[1] if line.steps else ""
    return COLOURS[place % len(COLOURS)], _DASHES[place // len(COLOURS) % len(_DASHES)]


def _path(line: ChartLine, x: Callable[[float], float], y: Callable[[float], float]) -> str:
    out, pen = "", False
    for px, py in line.points:
        if math.isfinite(py):
            move, then = ("H", "V") if pen and line.steps else ("L" if pen else "M", " ")
            out += f"{move}{x(px):.1f}{then}{y(py):.1f}"
        pen = math.isfinite(py)
    return out


def _thinned(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most `_MAX_POINTS` of finite x: of each stretch its least and its greatest value, in order."""
    points = [(x, y) for x, y in points if math.isfinite(x)]
    if len(points) <= _MAX_POINTS:
        return points
    size = math.ceil(2 * len(points) / _MAX_POINTS)
    kept: list[tuple[float, float]] = []
    for start in range(0, len(points), size):
        stretch = points[start : start + size]
        ends = {min(stretch, key=lambda point: point[1]), max(stretch, key=lambda point: point[1])}
        kept += sorted(ends)
    return kept


def _ticks(low: float, high: float) -> list[float]:
    span = high - low
    rough = span / 5
    if not math.isfinite(rough) or rough <= 0:
        return []
    magnitude = 10.0 ** math.floor(math.log10(rough))
    step = next(each * magnitude for each in (1, 2, 5, 10) if each * magnitude >= rough)
    first = math.ceil(low / step)
    return [i * step for i in range(first, math.floor(high / step) + 1)][:12]


def _number(value: float) -> str:
    return f"{value:.4g}" if abs(value) > 1e-12 else "0"
