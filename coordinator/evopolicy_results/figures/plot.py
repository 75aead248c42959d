"""A figure with its texts, and its SVG for use inside a page. Needs no drawing library.

On a page, the ink, muted text and grid follow its light or dark theme: `inline_svg` replaces their three colours,
which nothing else uses, by CSS variables.
"""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Any

import msgspec

from evopolicy_common.terminal import harmless

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#15181d"
MUTED = "#5c6773"
GRID = "#d5dae1"


class Plot(msgspec.Struct, frozen=True, kw_only=True):
    """A figure with its texts and data: drawn by matplotlib, or an SVG."""

    name: str
    """File name without suffix."""
    title: str
    caption: str
    alt: str
    """Alternative text that describes the figure."""
    data: Any
    """JSON-able: the numbers drawn."""
    figure: Figure | None = None
    svg: str = ""
    """A stand-alone SVG, if there is no `figure`."""
    width: float = 56.0
    """Maximum width on a page, rem."""


_PROLOGUE = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_METADATA = re.compile(r"<metadata>.*?</metadata>\s*", re.DOTALL)
_TAG = re.compile(r"<svg[^>]*>")
_SIZE = re.compile(r' (?:width|height)="[^"]*"')
_IDS = re.compile(r'(\bid="|href="#|url\(#)')
_THEME = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--grid)"}


def inline_svg(svg: str, name: str, alt: str) -> str:
    """The SVG for use inside a page: themed, scaled with its container, labelled for screen readers, ids unique."""
    prefix = "f" + hashlib.sha256(name.encode()).hexdigest()[:8] + "-"
    body = _METADATA.sub("", _PROLOGUE.sub("", svg, count=1))
    body = _IDS.sub(lambda match: match.group(1) + prefix, body)
    for colour, variable in _THEME.items():
        body = body.replace(colour, variable)
    body = _TAG.sub(lambda match: _SIZE.sub("", match[0]), body, count=1)
    label = harmless(alt).replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    body = body.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return body.replace("'DejaVu Sans'", "system-ui, 'DejaVu Sans'")
