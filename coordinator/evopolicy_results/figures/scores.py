"""Figures of outcomes: rank scores, score evolution, performance profiles, normalised performance, worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from statistics import fmean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.figures.plot import GRID, INK, Plot
from evopolicy_results.figures.style import handles_of, legend_above, name_rows, new_figure, write_beside
from evopolicy_results.reading.environments import (
    family_of,
    family_title,
    grouped,
    ordered_environments,
    title_of,
)
from evopolicy_results.reading.records import rows
from evopolicy_results.scoring.evolution import Evolution, best_at
from evopolicy_results.scoring.scores import DEMANDS, scales_of
from evopolicy_results.statistics.aggregates import TAUS, Bounded
from evopolicy_results.studies.palette import REFERENCE, Look
from evopolicy_results.studies.study import Study, SuiteStudy

_LEFT = -1.0
"""Least end of the overview's scale."""
MAX_CURVES = 3
"""Maximum number of runs of one agent on one environment drawn separately; more are drawn as their mean and range."""


def overview(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Each agent's held-out mean on each environment between random actions (0) and the best agent (1), by family."""
    points: dict[str, list[dict[str, Any]]] = {}
    for suite in study.suites:
        for env, scale in scales_of(suite.table).items():
            width = scale.best - scale.random
            for agent in suite.table.agents:
                estimate = suite.statistics.means.get((agent, env))
                if estimate is not None:
                    ends = _ends(estimate)
                    value, low, high = ((each - scale.random) / width for each in (estimate.value, *ends))
                    known = {"env": env, "entry": agent, "value": value, "low": low, "high": high}
                    points.setdefault(env, []).append(known)
    if not points:
        return None
    families = grouped(ordered_environments(points), family_of)
    lines = [line for family, envs in families.items() for line in (f"{family_title(family)}:", *envs)]
    entries = [
        entry for entry in looks if any(entry == one["entry"] for each in points.values() for one in each)
    ]
    lowest = min(one["value"] for each in points.values() for one in each)
    left = min(-0.25, max(_LEFT, lowest - 0.05))
    step = min(0.22, 0.8 / max(1, len(entries)))
    height = 1.1 + sum(0.26 if line not in points else 0.16 + 0.13 * len(entries) for line in lines)
    names = [title_of(line) if line in points else line for line in lines]
    with new_figure(4.8, height, names=names) as (figure, axes):
        panel = axes[0][0]
        for place, line in enumerate(lines):
            panel.axhline(place - 0.5, color=GRID, linewidth=0.6)
            for one in points.get(line, ()):
                look, shift = (
                    looks[one["entry"]],
                    step * (entries.index(one["entry"]) - (len(entries) - 1) / 2.0),
                )
                panel.hlines(
                    place + shift, one["low"], one["high"], color=look.colour, linewidth=1.3, alpha=0.7
                )
                panel.plot(
                    max(left, one["value"]), place + shift, look.marker, color=look.colour, markersize=5.0
                )
        for label, line in zip(panel.get_yticklabels(), lines, strict=True):
            label.set_fontweight("normal" if line in points else "bold")
        panel.set_xlim(left, 1.25)
        panel.set_xticks([0.0, 0.5, 1.0], ["random", "0.5", "best agent"])
        legend_above(figure, handles_of(entries, looks))
    cut = any(one["low"] < left or one["high"] > 1.25 for each in points.values() for one in each)
    missing = [
        title_of(env) for suite in study.suites for env in suite.table.environments if env not in points
    ]
    return Plot(
        name="overview",
        title="Score by environment",
        caption="Held-out mean and 95 % interval, on each environment's scale from random actions to the best agent."
        + (" Intervals that reach an edge continue." if cut else "")
        + (" Scores at the left edge lie beyond it." if lowest < left else "")
        + (f" Without a scale, as no agent beats random actions: {', '.join(missing)}." if missing else ""),
        alt=f"Scores of {len(entries)} agents on {len(points)} environments between random actions and the best agent.",
        data=[one for each in points.values() for one in each],
        figure=figure,
    )


def rank_scores(suite: SuiteStudy, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Suite and family rank scores, one panel each, agents from best to worst."""
    standings, estimates = suite.board.standings, suite.statistics.standings
    if not any(row.score is not None for row in standings):
        return None
    families = list(dict.fromkeys(family_of(env) for env in suite.table.environments))
    panels = ["", *families] if len(families) > 1 else [""]
    names = [row.entry for row in standings]
    size = 2.1 + 1.75 * len(panels), 0.9 + 0.3 * len(standings)
    with new_figure(*size, names=names, ncols=len(panels), sharey=True, sharex=True) as (figure, axes):
        for panel, family in zip(axes[0], panels, strict=True):
            panel.set_title(suite.title if not family else family_title(family))
            for place, row in enumerate(standings):
                value = row.families.get(family) if family else row.score
                if value is None:
                    continue
                look, end = looks[row.entry], value
                panel.hlines(place, 0.0, value, color=look.colour, linewidth=2.2, alpha=0.55)
                panel.plot(value, place, look.marker, color=look.colour, markersize=6.5)
                if not family and (estimate := estimates.of(row.entry)) is not None:
                    ends = [estimate.score_low, estimate.score_high]
                    panel.plot(ends, [place, place], "|-", color=INK, markersize=9, linewidth=1.2, zorder=1.9)
                    end = estimate.score_high
                write_beside(panel, end, place, f"{value:.3f}", 6)
            panel.set_xlim(-0.03, 1.32)
            panel.set_xticks([0.0, 0.5, 1.0])
        figure.supxlabel("Mean rank score (1 = best on every environment)", fontsize=9)
    best = standings[0]
    return Plot(
        name=f"rank_scores_{suite.name}",
        title=f"{suite.title} rank scores",
        caption="Mean rank score over the suite and over each family of environments."
        + (f" Bars with ends: 95 % interval over {estimates.over}." if estimates.rows else ""),
        alt=f"Dot plot of rank scores, suite and {len(families)} families. Best: {best.entry}"
        + (f" at {best.score:.2f}." if best.score is not None else "."),
        data=rows(standings),
        figure=figure,
    )


def score_evolution(suite: SuiteStudy, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Small multiples, one per environment: best validation mean over consumed episodes, one step curve per run."""
    curves = [one for one in study.evolutions if one.env in suite.table.environments and one.steps]
    by_env = grouped(curves, lambda one: one.env)
    envs = [env for env in suite.table.environments if env in by_env]
    if not envs:
        return None
    n_columns = min(4, len(envs))
    n_rows = math.ceil(len(envs) / n_columns)
    shown = [entry for entry in suite.table.agents if any(one.entry == entry for one in curves)]
    size = 2.6 * n_columns if n_columns > 1 else 5.2, 0.7 + 1.75 * n_rows
    with new_figure(*size, nrows=n_rows, ncols=n_columns) as (figure, axes):
        for panel, env in zip_longest(axes.flat, envs):
            if env is None:
                panel.set_visible(False)
            else:
                _evolution_panel(panel, env, by_env[env], suite, looks)
        figure.supxlabel("Train episodes consumed", fontsize=9)
        below = " " if n_rows > 1 else "\n"
        figure.supylabel(f"Best validation mean{below}return so far", fontsize=9)
        handles = handles_of(shown, looks)
        if suite.table.reference is not None:
            handles.append(Line2D([], [], color=REFERENCE, linestyle=":", label=suite.table.reference))
        legend_above(figure, handles)
    return Plot(
        name=f"score_evolution_{suite.name}",
        title=f"{suite.title} score evolution",
        caption="Best hidden-validation mean so far over the consumed train budget, one curve a run, rises"
        f" marked; where an agent has more than {MAX_CURVES} runs, their mean and range from where all have a score."
        " Reconstructed after the run: agents never see it. Dotted: random reference on the held-out cases.",
        alt=f"Step curves for {len(envs)} environments and {len(shown)} agents.",
        data=rows(curves),
        figure=figure,
    )


def _evolution_panel(
    panel: Axes, env: str, curves: Sequence[Evolution], suite: SuiteStudy, looks: Mapping[str, Look]
) -> None:
    panel.set_title(title_of(env))
    for entry, own in grouped(curves, lambda one: one.entry).items():
        if len(own) > MAX_CURVES:
            _mean_curve(panel, own, looks[entry])
        else:
            for one in own:
                _one_curve(panel, one, looks[entry], 1.0 if len(own) == 1 else 0.55)
    cell = None if suite.table.reference is None else suite.table.cells.get((suite.table.reference, env))
    if cell is not None and cell.mean is not None:
        panel.axhline(cell.mean, color=REFERENCE, linestyle=":", linewidth=1.1)
    panel.set_xlim(0, max(one.budget for one in curves) * 1.02)
    panel.locator_params(axis="y", nbins=4)
    panel.locator_params(axis="x", nbins=4, integer=True)


def _one_curve(panel: Axes, one: Evolution, look: Look, thin: float) -> None:
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


def _mean_curve(panel: Axes, curves: Sequence[Evolution], look: Look) -> None:
    """The mean curve with a band from lowest to highest, starting where every run has a score."""
    changes = {step.consumed for one in curves for step in one.steps} | {max(one.budget for one in curves)}
    start = max(one.steps[0].consumed for one in curves)
    x = sorted(consumed for consumed in changes if consumed >= start)
    levels = [[best_at(one.steps, consumed) for one in curves] for consumed in x]
    panel.fill_between(
        x, [min(level) for level in levels], [max(level) for level in levels],
        step="post", color=look.colour, alpha=0.13, linewidth=0,
    )  # fmt: skip
    panel.plot(
        x, [fmean(level) for level in levels], drawstyle="steps-post", color=look.colour, linestyle=look.dash,
        marker=look.marker, markersize=3.2, markevery=0.2,
    )  # fmt: skip


def performance_profiles(suite: SuiteStudy, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """By agent, the share of its runs above each normalised score, with a pointwise 95 % band."""
    aggregates = suite.statistics.aggregates
    if not aggregates:
        return None
    with new_figure(6.4, 3.4) as (figure, axes):
        panel = axes[0][0]
        for one in aggregates:
            look = looks[one.entry]
            panel.plot(
                TAUS, [share.value for share in one.profile], color=look.colour, linestyle=look.dash,
                marker=look.marker, markersize=3.2, markevery=4, label=one.entry,
            )  # fmt: skip
            low, high = zip(*map(_ends, one.profile), strict=True)
            panel.fill_between(TAUS, low, high, color=look.colour, alpha=0.13, linewidth=0)
        panel.set_xlim(0.0, 1.0)
        panel.set_ylim(-0.02, 1.02)
        panel.set_xlabel("Normalised held-out score (0 = random, 1 = best agent's mean)")
        panel.set_ylabel("Share of runs above it")
        figure.legend(loc="outside upper center", ncols=min(4, len(aggregates)))
    return Plot(
        name=f"profiles_{suite.name}",
        title=f"{suite.title} performance profiles",
        caption="Share of an agent's runs whose normalised score is above each value, over all environments"
        " with a scale; higher is better. Bands: pointwise 95 % intervals of a stratified bootstrap over runs"
        " and their cases, or over the cases of single runs; none where resamples show no spread.",
        alt=f"Performance profiles of {len(aggregates)} agents.",
        data=rows(aggregates),
        figure=figure,
    )


def _ends(estimate: Estimate | Bounded) -> tuple[float, float]:
    """The interval; the value alone where there is none."""
    if estimate.low is None or estimate.high is None:
        return estimate.value, estimate.value
    return estimate.low, estimate.high


def normalised_performance(suite: SuiteStudy, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Two panels, one per demand group: each agent's mean as a bar, its environments as dots."""
    agents = suite.table.agents
    groups = {(g.demand, g.entry): g for g in suite.normalised.groups if g.value is not None}
    demands = [demand for demand in DEMANDS if any(key[0] == demand for key in groups)]
    if not demands:
        return None
    size = 2.0 + 3.3 * len(demands), 1.0 + 0.42 * len(agents)
    with new_figure(*size, names=agents, ncols=len(demands), sharey=True) as (figure, axes):
        for panel, demand in zip(axes[0], demands, strict=True):
            n = max(g.n_environments for key, g in groups.items() if key[0] == demand)
            panel.set_title(f"{demand.capitalize()}-dominant (n = {n})")
            for place, agent in enumerate(agents):
                values = [
                    value
                    for (entry, env), value in suite.normalised.cells.items()
                    if entry == agent and demand_of(env) == demand and value is not None
                ]
                if not values:
                    continue
                colour, group = looks[agent].colour, groups.get((demand, agent))
                mean = None if group is None else group.value
                if mean is not None:
                    panel.barh(place, mean, height=0.56, color=colour, alpha=0.35, linewidth=0)
                    panel.vlines(mean, place - 0.28, place + 0.28, color=colour, linewidth=2.0)
                panel.plot(
                    values, [place] * len(values), looks[agent].marker, color=colour, markersize=4.2, alpha=0.8,
                    markeredgewidth=0, clip_on=False,
                )  # fmt: skip
                write_beside(panel, 1.0, place, "incomplete" if mean is None else f"{mean:.2f}", 9)
            panel.axvline(1.0, color=GRID, linewidth=0.8)
            panel.set_xlim(0.0, 1.16)
            panel.set_xticks([0.0, 0.25, 0.5, 0.75, 1.0])
        figure.supxlabel("Normalised held-out return (0 = random, 1 = best agent)", fontsize=9)
    return Plot(
        name=f"normalised_{suite.name}",
        title=f"{suite.title} performance by task demand",
        caption="Held-out return between the random reference (0) and the best agent (1), clipped. Bars: mean over the "
        "environments of a demand group, given at the right. Symbols: single environments.",
        alt=f"Bars of normalised performance for {len(agents)} agents in {len(demands)} demand groups.",
        data=rows(suite.normalised.groups),
        figure=figure,
    )


def worlds(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Left: each entry's means, unchanged and in worlds. Right: its best so far over episodes."""
    if study.worlds is None:
        return None
    overall = {one.entry: one for one in reversed(study.worlds.paired)}  # an entry's first row is its widest
    entries = [entry for entry in looks if entry in overall]
    with new_figure(9.0, max(2.8, 1.2 + 0.45 * len(entries)), ncols=2) as (figure, axes):
        left, right = axes[0]
        for place, entry in enumerate(entries):
            look, row = looks[entry], overall[entry]
            for shift, estimate, face in ((-0.12, row.unchanged, look.colour), (0.12, row.worlds, "none")):
                left.hlines(place + shift, *_ends(estimate), color=look.colour, linewidth=1.4, alpha=0.7)
                left.plot(estimate.value, place + shift, look.marker, color=look.colour, markerfacecolor=face)
        for entry, points in study.worlds.curves.items():
            x, colour = [point.episodes for point in points], looks[entry].colour
            _curve(right, x, [point.unchanged for point in points], colour, "-")
            _curve(right, x, [point.worlds for point in points], colour, "--")
        for end in (0.0, 1.0):
            left.axvline(end, color=GRID, linewidth=0.9)
        name_rows(left, entries)
        left.grid(axis="y", visible=False)
        left.set_xlabel("Held-out score (0 = random, 1 = best known)")
        right.set_xlabel("Train episodes consumed")
        right.set_ylabel("Best validation so far")
        right.set_ylim(bottom=-0.02)
    return Plot(
        name="worlds",
        title="Environments and their worlds",
        caption="Left: filled in unchanged environments, open in their worlds, mean over environments with 95"
        " % intervals. Right: best validation mean so far, solid in unchanged environments, dashed in worlds;"
        " random actions count from the start. Bands: pointwise 95 % intervals over new worlds and runs; none"
        " where there is one of each.",
        alt=f"Scores and learning curves of {len(entries)} entries in unchanged environments and in worlds.",
        data={
            "scores": rows(overall[entry] for entry in entries),
            "curves": {entry: rows(points) for entry, points in study.worlds.curves.items()},
        },
        figure=figure,
    )


def _curve(panel: Axes, x: list[int], estimates: Sequence[Estimate], colour: str, style: str) -> None:
    panel.plot(x, [each.value for each in estimates], style, drawstyle="steps-post", color=colour)
    low, high = zip(*map(_ends, estimates), strict=True)
    panel.fill_between(x, low, high, step="post", color=colour, alpha=0.1, linewidth=0)
