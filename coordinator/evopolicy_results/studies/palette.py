"""An agent's look in every figure and page (colour, marker and dash), and the colours of edit types.

An agent has the same look in every figure of a report, given by its place among the agents' names. Colours are Okabe
and Ito's colour-blind-safe set (without yellow and black, each too weak on one of the two backgrounds), then three of
Tol's; after nine agents colours repeat with another dash. The random reference is always grey and dashed.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

Dash = str | tuple[int, tuple[float, ...]]
"""A line style of matplotlib."""
REFERENCE = "#868b92"

COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9",
    "#aa4499", "#999933", "#882255",
)  # fmt: skip
DASHES: tuple[Dash, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)))

EDIT_COLOURS = {"first": "#b9bec6", "synthesis": "#7b6fd0", "parametric": "#c9a227", "data": "#5f9e98"}
"""Colours of the timelines' bands; no agent uses them."""

MARKER_PATHS = {
    "o": "M8 2a6 6 0 1 0 .01 0z",
    "s": "M2.5 2.5h11v11h-11z",
    "^": "M8 1.5 15 14H1z",
    "D": "M8 1 15 8 8 15 1 8z",
    "v": "M8 14.5 1 2h14z",
    "P": "M5.5 1h5v4.5H15v5h-4.5V15h-5v-4.5H1v-5h4.5z",
    "X": "M4.5 1 8 4.5 11.5 1 15 4.5 11.5 8 15 11.5 11.5 15 8 11.5 4.5 15 1 11.5 4.5 8 1 4.5z",
    "<": "M1.5 8 14 1v14z",
    ">": "M14.5 8 2 1v14z",
    "|": "M6.5 1h3v14h-3z",
}
"""The markers as SVG paths in a 16 × 16 box, for pages."""
MARKERS = tuple(MARKER_PATHS)[:-1]
"""Without the reference's."""


class Look(msgspec.Struct, frozen=True, kw_only=True):
    """An agent's appearance in figures."""

    colour: str
    marker: str
    dash: Dash

    @property
    def path(self) -> str:
        """The marker as an SVG path; see `MARKER_PATHS`."""
        return MARKER_PATHS[self.marker]


def looks(agents: Sequence[str], reference: str | None) -> dict[str, Look]:
    """Each agent's look, by the place of its name among all agents of the report; the reference is grey and dashed."""
    out = {
        agent: Look(
            colour=COLOURS[place % len(COLOURS)],
            marker=MARKERS[place % len(MARKERS)],
            dash=DASHES[place // len(COLOURS) % len(DASHES)],
        )
        for place, agent in enumerate(sorted(agents, key=lambda name: (name.casefold(), name)))
    }
    return (
        out if reference is None else {**out, reference: Look(colour=REFERENCE, marker="|", dash=DASHES[1])}
    )
