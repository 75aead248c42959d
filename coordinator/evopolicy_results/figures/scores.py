"""Figures of outcomes: rank scores, score evolution, normalised performance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean

import matplotlib
from matplotlib.lines import Line2D

from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.figures.plot import GRID, INK, Plot
from evopolicy_results.figures.style import RC, new_figure
from evopolicy_results.reading.environments import family_of, family_title, title_of
from evopolicy_results.reading.records import rows
from evopolicy_results.scoring.evolution import Evolution, best_at
from evopolicy_results.scoring.normalised import DEMANDS
from evopolicy_results.studies.palette import REFERENCE, Look
from evopolicy_results.studies.study import Study, Suite


def rank_scores(suite: Suite, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Suite and family rank scores, one panel each, agents from best to worst."""
    standings = suite.board.standings
    if not any(row.score is not None for row in standings):
        return None
    families = list(dict.fromkeys(family_of(env) for env in suite.board.environments))
    panels = ["", *families] if len(families) > 1 else [""]
    figure, axes = new_figure(
        2.1 + 1.75 * len(panels), 0.9 + 0.3 * len(standings), ncols=len(panels), sharey=True, sharex=True
    )
    with matplotlib.rc_context(RC):
        for panel, family in zip(axes[0], panels, strict=True):
            panel.set_title(suite.title if not family else family_title(family))
            for place, row in enumerate(standings):
                value = row.families.get(family) if family else row.score
                if value is None:
                    continue
                look = looks[row.entry]
                panel.hlines(place, 0.0, value, color=look.colour, linewidth=2.2, alpha=0.55)
                panel.plot(value, place, look.marker, color=look.colour, markersize=6.5)
                sure = suite.statistics.standings.of(row.entry)
                end = value
                if not family and sure is not None:
                    ends = [sure.score_low, sure.score_high]
                    panel.plot(ends, [place, place], "|-", color=INK, markersize=9, linewidth=1.2, zorder=1.9)
                    end = sure.score_high
                panel.annotate(
                    f"{value:.3f}",
                    (end, place),
                    xytext=(6, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8,
                )
            panel.set_xlim(-0.03, 1.32)
            panel.set_xticks([0.0, 0.5, 1.0])
            panel.set_ylim(len(standings) - 0.5, -0.5)
            panel.grid(axis="y", visible=False)
        axes[0][0].set_yticks(range(len(standings)), [row.entry for row in standings])
        figure.supxlabel("Mean rank score (1 = best on every environment)", fontsize=9)
    first = standings[0]
    resampled = suite.statistics.standings
    return Plot(
        name=f"rank_scores_{suite.name}",
        title=f"{suite.title} rank scores",
        caption="Mean rank score over the suite and over each family of environments."
        + (f" Bars with ends: 95 % interval over {resampled.over}." if resampled.rows else ""),
        alt=f"Dot plot of rank scores, suite and {len(families)} families. Best: {first.entry}"
        + (f" at {first.score:.2f}." if first.score is not None else "."),
        data=rows(standings),
        figure=figure,
        group="leaderboard",
    )


def score_evolution(suite: Suite, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Small multiples, one per environment: best validation mean over consumed episodes, one step curve per run."""
    found = [one for one in study.evolutions if one.env in suite.table.environments and one.steps]
    envs = [env for env in suite.table.environments if any(one.env == env for one in found)]
    if not envs:
        return None
    n_columns = min(4, len(envs))
    n_rows = math.ceil(len(envs) / n_columns)
    width = 2.6 * n_columns if n_columns > 1 else 5.2
    figure, axes = new_figure(width, 0.7 + 1.75 * n_rows, nrows=n_rows, ncols=n_columns)
    shown = [entry for entry in suite.table.agents if any(one.entry == entry for one in found)]
    with matplotlib.rc_context(RC):
        panels = list(axes.flat)
        for panel, env in zip(panels, envs, strict=False):
            _evolution_panel(panel, env, [one for one in found if one.env == env], suite, looks)
        for panel in panels[len(envs) :]:
            panel.set_visible(False)
        figure.supxlabel("Train episodes consumed", fontsize=9)
        figure.supylabel(
            "Best validation mean return so far" if n_rows > 1 else "Best validation mean\nreturn so far",
            fontsize=9,
        )
        handles = [_handle(entry, looks) for entry in shown]
        if suite.table.reference is not None:
            handles.append(Line2D([], [], color=REFERENCE, linestyle=":", label=suite.table.reference))
        figure.legend(handles=handles, loc="outside upper center", ncols=min(5, len(handles)))
    return Plot(
        name=f"score_evolution_{suite.name}",
        title=f"{suite.title} score evolution",
        caption=(
            "Best hidden-validation mean so far over the consumed train budget, one curve a run, rises marked; where"
            f" an agent has more than {MAX_CURVES} runs, their mean and range from where all have a score."
            " Reconstructed after the run: agents never see it. Dotted: random reference on the held-out cases."
        ),
        alt=f"Step curves for {len(envs)} environments and {len(shown)} agents.",
        data=rows(found),
        figure=figure,
        group="evolution",
    )


MAX_CURVES = 3
"""Maximum number of runs of one agent on one environment drawn separately; more are drawn as their mean and range."""


def _evolution_panel(
    panel: matplotlib.axes.Axes, env: str, found: list[Evolution], suite: Suite, looks: Mapping[str, Look]
) -> None:
    panel.set_title(title_of(env))
    by_entry: dict[str, list[Evolution]] = {}
    for one in found:
        by_entry.setdefault(one.entry, []).append(one)
    for entry, curves in by_entry.items():
        if len(curves) > MAX_CURVES:
            _mean_curve(panel, curves, looks[entry])
            continue
        thin = 1.0 if len(curves) == 1 else 0.55
        for one in curves:
            _one_curve(panel, one, looks[entry], thin)
    if suite.table.reference is not None:
        cell = suite.table.cells.get((suite.table.reference, env))
        if cell is not None and cell.mean is not None:
            panel.axhline(cell.mean, color=REFERENCE, linestyle=":", linewidth=1.1)
    panel.set_xlim(0, max(one.budget for one in found) * 1.02)
    panel.locator_params(axis="y", nbins=4)
    panel.locator_params(axis="x", nbins=4, integer=True)


def _one_curve(panel: matplotlib.axes.Axes, one: Evolution, look: Look, thin: float) -> None:
    x = [step.consumed for step in one.steps]
    y = [step.best for step in one.steps]
    panel.plot(
        [*x, max(one.budget, x[-1])], [*y, y[-1]],
        drawstyle="steps-post", color=look.colour, linestyle=look.dash, linewidth=1.5 * thin + 0.1, alpha=thin,
    )  # fmt: skip
    rises = [step for step in one.steps if step.improved]
    panel.plot(
        [step.consumed for step in rises], [step.best for step in rises],
        look.marker, color=look.colour, markersize=3.4 * thin + 0.4, alpha=thin,
    )  # fmt: skip


def _mean_curve(panel: matplotlib.axes.Axes, curves: list[Evolution], look: Look) -> None:
    """The mean curve with a band from lowest to highest, starting where every run has a score."""
    changes = sorted(
        {step.consumed for one in curves for step in one.steps} | {max(one.budget for one in curves)}
    )
    start = max(one.steps[0].consumed for one in curves)
    x = [consumed for consumed in changes if consumed >= start]
    levels = [[best_at(one.steps, consumed) for one in curves] for consumed in x]
    panel.fill_between(
        x, [min(level) for level in levels], [max(level) for level in levels],
        step="post", color=look.colour, alpha=0.13, linewidth=0,
    )  # fmt: skip
    panel.plot(
        x, [fmean(level) for level in levels], drawstyle="steps-post", color=look.colour, linestyle=look.dash,
        marker=look.marker, markersize=3.2, markevery=0.2,
    )  # fmt: skip


def _handle(entry: str, looks: Mapping[str, Look]) -> Line2D:
    look = looks[entry]
    return Line2D(
        [], [], color=look.colour, marker=look.marker, linestyle=look.dash, markersize=5, label=entry
    )


def normalised_performance(suite: Suite, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Two panels, one per demand group: each agent's mean as a bar, its environments as dots."""
    agents = suite.table.agents
    groups = {(g.demand, g.entry): g for g in suite.normalised.groups if g.value is not None}
    demands = [demand for demand in DEMANDS if any(key[0] == demand for key in groups)]
    if not demands:
        return None
    figure, axes = new_figure(
        2.0 + 3.3 * len(demands), 1.0 + 0.42 * len(agents), ncols=len(demands), sharey=True
    )
    with matplotlib.rc_context(RC):
        for panel, demand in zip(axes[0], demands, strict=True):
            n = max(g.n_environments for key, g in groups.items() if key[0] == demand)
            panel.set_title(f"{demand.capitalize()}-dominant (n = {n})")
            for place, agent in enumerate(agents):
                look = looks[agent]
                values = [
                    cell.value
                    for (entry, env), cell in suite.normalised.cells.items()
                    if entry == agent and demand_of(env) == demand and cell.value is not None
                ]
                if not values:
                    continue
                group = groups.get((demand, agent))
                mean = None if group is None else group.value
                if mean is not None:
                    panel.barh(place, mean, height=0.56, color=look.colour, alpha=0.35, linewidth=0)
                    panel.vlines(mean, place - 0.28, place + 0.28, color=look.colour, linewidth=2.0)
                panel.plot(
                    values, [place] * len(values), look.marker, color=look.colour, markersize=4.2, alpha=0.8,
                    markeredgewidth=0, clip_on=False,
                )  # fmt: skip
                panel.annotate(
                    "incomplete" if mean is None else f"{mean:.2f}",
                    (1.0, place),
                    xytext=(9, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8,
                )
            panel.axvline(1.0, color=GRID, linewidth=0.8)
            panel.set_xlim(0.0, 1.16)
            panel.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0])
            panel.grid(axis="y", visible=False)
        axes[0][0].set_yticks(range(len(agents)), agents)
        axes[0][0].set_ylim(len(agents) - 0.5, -0.5)
        figure.supxlabel("Normalised held-out return (0 = random, 1 = best agent)", fontsize=9)
    return Plot(
        name=f"normalised_{suite.name}",
        title=f"{suite.title} performance by task demand",
        caption=(
            "Held-out return between the random reference (0) and the best agent (1), clipped. Bars: mean over the "
            "environments of a demand group, given at the right. Symbols: single environments."
        ),
        alt=f"Bars of normalised performance for {len(agents)} agents in {len(demands)} demand groups.",
        data=rows(suite.normalised.groups),
        figure=figure,
        group="demand",
    )
