"""Figure of worlds: scores in unchanged environments and in worlds, and how both grow with the episodes."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib
from matplotlib.axes import Axes

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_results.figures.plot import GRID, Plot
from evopolicy_results.figures.style import RC, new_figure
from evopolicy_results.reading.records import rows
from evopolicy_results.statistics.worlds import CurvePoint
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study


def worlds(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Left: each entry's mean in both. Right: its best so far over episodes, dashed in worlds."""
    found = study.worlds
    if found is None:
        return None
    overall = {one.entry: one for one in reversed(found.paired)}  # an entry's first row is its widest
    entries = [entry for entry in looks if entry in overall]
    figure, axes = new_figure(9.0, max(2.8, 1.2 + 0.45 * len(entries)), ncols=2)
    left, right = axes[0]
    with matplotlib.rc_context(RC):
        for place, entry in enumerate(entries):
            look, row = looks[entry], overall[entry]
            for shift, estimate, filled in ((-0.12, row.unchanged, True), (0.12, row.worlds, False)):
                left.hlines(place + shift, *_ends(estimate), color=look.colour, linewidth=1.4, alpha=0.7)
                face = look.colour if filled else "none"
                left.plot(estimate.value, place + shift, look.marker, color=look.colour, markerfacecolor=face)
        for entry, points in found.curves.items():
            x, look = [point.episodes for point in points], looks[entry]
            _curve(right, x, [point.unchanged for point in points], look, "-")
            _curve(right, x, [point.worlds for point in points], look, "--")
        for end in (0.0, 1.0):
            left.axvline(end, color=GRID, linewidth=0.9)
        left.set_yticks(range(len(entries)), entries)
        left.set_ylim(len(entries) - 0.5, -0.5)
        left.grid(axis="y", visible=False)
        left.set_xlabel("Held-out score (0 = random, 1 = best known)")
        right.set_xlabel("Train episodes consumed")
        right.set_ylabel("Best validation so far")
        right.set_ylim(bottom=-0.02)
    return Plot(
        name="worlds",
        title="Environments and their worlds",
        caption=(
            "Left: filled in unchanged environments, open in their worlds, mean over environments with 95 %"
            " intervals. Right: best validation mean so far, solid in unchanged environments, dashed in worlds;"
            " random actions count from the start. Bands: pointwise 95 % intervals over new worlds and runs; none"
            " where there is one of each."
        ),
        alt=f"Scores and learning curves of {len(entries)} entries in unchanged environments and in worlds.",
        data={"scores": rows(overall[entry] for entry in entries), "curves": _data(found.curves)},
        figure=figure,
        group="worlds",
    )


def _data(curves: Mapping[str, tuple[CurvePoint, ...]]) -> dict[str, object]:
    return {entry: rows(points) for entry, points in curves.items()}


def _ends(estimate: Estimate) -> tuple[float, float]:
    known = estimate.low is not None and estimate.high is not None
    return (estimate.low or 0.0, estimate.high or 0.0) if known else (estimate.value, estimate.value)


def _curve(panel: Axes, x: list[int], found: list[Estimate], look: Look, style: str) -> None:
    panel.plot(x, [each.value for each in found], style, drawstyle="steps-post", color=look.colour)
    low, high = zip(*map(_ends, found), strict=True)
    panel.fill_between(x, low, high, step="post", color=look.colour, alpha=0.1, linewidth=0)
