"""Figures of policies' structure and runs' costs: realised structure, tokens, wall time by phase."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean

import matplotlib
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from evopolicy_results.behaviour.structure import FEATURES
from evopolicy_results.figures.plot import INK, Plot
from evopolicy_results.figures.style import RC, new_figure
from evopolicy_results.reading.records import rows
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study

_FEATURE_TITLES = ("Functions", "Branches", "Loops", "Nesting depth", "State attributes")
_PHASES = (
    ("agent_s", "agent", "#00224e", ""),
    ("queue_s", "queue", "#f5e2a0", ""),
    ("rollout_s", "rollout", "#7d7c78", ""),
    ("feedback_s", "feedback", "#fdea45", "////"),
    ("finalise_s", "finalise", "#c3b369", "\\\\\\\\"),
)


def structure(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """One panel per feature, one row per demand group and agent: group means of the selected policies."""
    if not study.structure:
        return None
    groups = [g for g in ("synthesis", "tuning") if any(r.demand == g for r in study.structure)] or ["all"]
    lines = [row for group in groups for row in study.structure if row.demand == group]
    figure, axes = new_figure(
        2.6 + 1.5 * len(FEATURES), 1.0 + 0.3 * len(lines), ncols=len(FEATURES), sharey=True
    )
    places = [i + 0.6 * groups.index(row.demand) for i, row in enumerate(lines)]
    with matplotlib.rc_context(RC):
        for panel, feature, title in zip(axes[0], FEATURES, _FEATURE_TITLES, strict=True):
            panel.set_title(title)
            top = max(getattr(row, feature) for row in lines) or 1.0
            for place, row in zip(places, lines, strict=True):
                look, value = looks[row.entry], getattr(row, feature)
                panel.hlines(place, 0.0, value, color=look.colour, linewidth=2.0, alpha=0.55)
                panel.plot(value, place, look.marker, color=look.colour, markersize=5.5)
                panel.annotate(
                    f"{value:.1f}",
                    (value, place),
                    xytext=(5, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=7.5,
                )
            panel.set_xlim(0.0, top * 1.4)
            panel.locator_params(axis="x", nbins=3)
            panel.grid(axis="y", visible=False)
        named = groups != ["all"]
        axes[0][0].set_yticks(places, [f"{r.entry} · {r.demand}" if named else r.entry for r in lines])
        axes[0][0].set_ylim(places[-1] + 0.6, -0.6)
        figure.supxlabel("Mean over the environments of the group (counts)", fontsize=9)
    return Plot(
        name="structure",
        title="Realised structure",
        caption=(
            "AST features of validation-selected policies (policy.py and the local modules it reaches), mean over each"
            " demand group's environments."
        ),
        alt=f"Dot plots of five code features for {len(lines)} rows of agents and demand groups.",
        data=rows(lines),
        figure=figure,
        group="structure",
    )


def tokens(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Three panels on a log scale: a run's non-cached input, cache and output; dots are environments, bars the mean."""
    counted = [row for row in study.tokens if row.n_runs]
    if not counted:
        return None
    entries = sorted({row.entry for row in counted}, key=str.casefold)
    kinds = (
        ("input_noncached", "Non-cached input"),
        ("cache", "Cache read + creation"),
        ("output", "Output"),
    )
    figure, axes = new_figure(
        2.0 + 2.3 * len(kinds), 1.1 + 0.34 * len(entries), ncols=len(kinds), sharey=True
    )
    with matplotlib.rc_context(RC):
        for panel, (key, title) in zip(axes[0], kinds, strict=True):
            panel.set_title(title)
            for place, entry in enumerate(entries):
                look = looks[entry]
                values = [
                    v
                    for row in counted
                    if row.entry == entry and (v := getattr(row, key)) is not None and v > 0
                ]
                panel.plot(
                    values, [place] * len(values), look.marker, color=look.colour, markersize=4, alpha=0.5
                )
                if values:
                    mean = fmean(values)
                    panel.vlines(mean, place - 0.3, place + 0.3, color=look.colour, linewidth=2.2)
            panel.set_xscale("log")
            panel.xaxis.set_major_locator(
                LogLocator(subs=(1.0, 2.0, 5.0) if _decades(panel) < 2.2 else (1.0,))
            )
            panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            panel.xaxis.set_minor_formatter(NullFormatter())
            panel.grid(axis="y", visible=False)
        axes[0][0].set_yticks(range(len(entries)), entries)
        axes[0][0].set_ylim(len(entries) - 0.5, -0.5)
        figure.supxlabel("Tokens of a run (millions, log scale)", fontsize=9)
    return Plot(
        name="tokens",
        title="Tokens",
        caption=(
            "Tokens of a run by environment (symbols) and their mean (bars). Diagnostic: no part of a score. Agents"
            " that tell nothing of tokens are absent."
        ),
        alt=f"Token use of {len(entries)} agents in three kinds.",
        data=rows(counted),
        figure=figure,
        group="cost",
    )


def _decades(panel: matplotlib.axes.Axes) -> float:
    low, high = panel.get_xlim()
    return math.log10(high / low) if 0.0 < low < high else 0.0


def wall_time(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Stacked bars, one per agent: mean wall time of a run by phase."""
    rows = [row for row in study.audit if row.agent_s is not None]
    entries = sorted({row.entry for row in rows}, key=str.casefold)
    means = {
        entry: {key: fmean(getattr(r, key) for r in rows if r.entry == entry) for key, *_ in _PHASES}
        for entry in entries
    }
    if not any(value for phases in means.values() for value in phases.values()):
        return None
    figure, axes = new_figure(7.2, 1.2 + 0.34 * len(entries))
    panel = axes[0][0]
    with matplotlib.rc_context(RC):
        left = [0.0] * len(entries)
        for key, title, colour, hatch in _PHASES:
            widths = [means[entry][key] / 60.0 for entry in entries]
            panel.barh(
                range(len(entries)), widths, left=left, height=0.6, color=colour, label=title, hatch=hatch,
                edgecolor=INK, linewidth=0.4,
            )  # fmt: skip
            left = [a + b for a, b in zip(left, widths, strict=True)]
        panel.set_yticks(range(len(entries)), entries)
        panel.set_ylim(len(entries) - 0.5, -0.5)
        panel.set_xlabel("Mean wall time of a run (minutes)")
        panel.grid(axis="y", visible=False)
        figure.legend(loc="outside upper center", ncols=len(_PHASES))
    return Plot(
        name="wall_time",
        title="Wall time by phase",
        caption=(
            "Mean wall time of a run: the agent alone, waiting for a slot, train episodes, feedback, and hidden"
            " evaluation."
        ),
        alt=f"Stacked bars of wall time for {len(entries)} agents.",
        data=means,
        figure=figure,
        group="cost",
    )
