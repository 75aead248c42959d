"""Figures of policies and runs: hit rates, edit sizes, realised structure, tokens, wall time by phase."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import fmean

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from evopolicy_results.behaviour.audit import PHASES
from evopolicy_results.behaviour.edits import BINS, DATA_ONLY, FEATURES, UNCHANGED
from evopolicy_results.figures.plot import INK, MUTED, Plot
from evopolicy_results.figures.style import handles_of, legend_above, new_figure, write_beside
from evopolicy_results.reading.environments import by_name
from evopolicy_results.reading.records import rows
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study

_FEATURE_TITLES = ("Functions", "Branches", "Loops", "Nesting depth", "State attributes")
_PHASE_LOOKS = (
    ("#00224e", ""),
    ("#f5e2a0", ""),
    ("#7d7c78", ""),
    ("#fdea45", "////"),
    ("#c3b369", "\\\\\\\\"),
)


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a proportion; n > 0. Source: E. B. Wilson, JASA 22 (1927)."""
    z = 1.959964
    share = hits / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, centre - half), min(1.0, centre + half)


def hit_rates(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Hit rates of synthesis and parametric edits by demand group, one panel each, with Wilson intervals and counts."""
    table = {(row.entry, row.demand): row for row in study.edit_rates}
    if not any(row.n_synthesis + row.n_parametric for row in study.edit_rates):
        return None
    entries = sorted({entry for entry, _ in table}, key=by_name)
    groups = _groups({demand for _, demand in table})
    panels = [(group, edit) for group in groups for edit in ("synthesis", "parametric")]
    size = 1.8 + 2.0 * len(panels), 1.15 + 0.34 * len(entries)
    with new_figure(*size, names=entries, ncols=len(panels), sharey=True, sharex=True) as (figure, axes):
        for panel, (group, edit) in zip(axes[0], panels, strict=True):
            environments = "All environments" if group == "all" else f"{group.capitalize()} tasks"
            panel.set_title(f"{environments}:\n{edit} edits")
            for place, entry in enumerate(entries):
                row, look = table.get((entry, group)), looks[entry]
                n, hits = getattr(row, f"n_{edit}", 0), getattr(row, f"hits_{edit}", 0)
                if not n:
                    panel.annotate("none", (0.02, place), va="center", fontsize=8, color=MUTED)
                    continue
                panel.hlines(place, *wilson(hits, n), color=look.colour, linewidth=1.8, alpha=0.6)
                panel.plot(hits / n, place, look.marker, color=look.colour, markersize=6.5, clip_on=False)
                at = (1.0, place - 0.3)
                panel.annotate(f"n = {n}", at, ha="right", va="center", fontsize=7, color=MUTED)
            panel.set_xlim(0.0, 1.0)
            panel.set_xticks([0.0, 0.5, 1.0], ["0", "50", "100"])
        figure.supxlabel("Edits that raise the validation best (%)", fontsize=9)
    return Plot(
        name="edit_hits",
        title="Which edits help",
        caption="Share of edits that raise the best validation mean so far, with Wilson's 95 % interval and"
        " the number of edits. Rollbacks, retests and first submits are in neither.",
        alt=f"Hit rates of synthesis and parametric edits for {len(entries)} agents.",
        data=rows(study.edit_rates),
        figure=figure,
    )


def _groups(demands: set[str]) -> list[str]:
    return [group for group in ("synthesis", "tuning") if group in demands] or ["all"]


def edit_size(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Two panels: probability that the visible mean, or the validation best, improves, by edit size."""
    if not any(row.n for row in study.edit_sizes):
        return None
    entries = list(dict.fromkeys(row.entry for row in study.edit_sizes))
    largest = max(row.n for row in study.edit_sizes)
    has_data = any(row.n for row in study.edit_sizes if row.label == DATA_ONLY)
    labels = [label for label in BINS if label != DATA_ONLY or has_data]
    panels = (("p_visible", "n_visible", "Visible train mean"), ("p_validation", "n", "Validation best"))
    with new_figure(9.2, 3.2, ncols=2, sharey=True) as (figure, axes):
        for panel, (key, count, title) in zip(axes[0], panels, strict=True):
            panel.set_title(title)
            for i, entry in enumerate(entries):
                look = looks[entry]
                shift = (i - (len(entries) - 1) / 2) * min(0.12, 0.5 / len(entries))
                own = {row.label: row for row in study.edit_sizes if row.entry == entry}
                marks = [
                    (label, place + shift, getattr(own[label], key), getattr(own[label], count))
                    for place, label in enumerate(labels)
                    if getattr(own[label], key) is not None
                ]
                line = [(x, y) for label, x, y, _ in marks if label not in (UNCHANGED, DATA_ONLY)]
                panel.plot(
                    [x for x, _ in line], [y for _, y in line],
                    color=look.colour, linestyle=look.dash, linewidth=1.1, alpha=0.6,
                )  # fmt: skip
                panel.scatter(
                    [x for _, x, _, _ in marks], [y for _, _, y, _ in marks],
                    s=[14 + 130 * n / largest for *_, n in marks],
                    color=look.colour, marker=look.marker, alpha=0.8, linewidths=0,
                )  # fmt: skip
            panel.set_xlim(-0.6, len(labels) - 0.4)
            panel.set_xticks(range(len(labels)), [label.replace(" ", "\n") for label in labels])
            panel.set_ylim(-0.04, 1.04)
            panel.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0], ["0", "25", "50", "75", "100"])
        axes[0][0].set_ylabel("Transitions that improve (%)")
        figure.supxlabel("Lines added and removed in the policy's source bundle", fontsize=9)
        legend_above(figure, handles_of(entries, looks))
    return Plot(
        name="edit_size",
        title="Edit size and improvement",
        caption="Transitions between adjacent score-bearing submits by size of the edit; a mark's area grows"
        " with their number. An unchanged policy cannot raise the validation best; its visible mean can"
        " change, as it may play other cases. Data only: files outside the source bundle changed, such as weights.",
        alt=f"Probability of improvement over {len(labels)} edit sizes for {len(entries)} agents.",
        data=rows(study.edit_sizes),
        figure=figure,
    )


def structure(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """One panel per feature, one row per demand group and agent: group means of the selected policies."""
    if not study.structure:
        return None
    groups = _groups({row.demand for row in study.structure})
    lines = [row for group in groups for row in study.structure if row.demand == group]
    places = [i + 0.6 * groups.index(row.demand) for i, row in enumerate(lines)]
    size = 2.6 + 1.5 * len(FEATURES), 1.0 + 0.3 * len(lines)
    with new_figure(*size, ncols=len(FEATURES), sharey=True) as (figure, axes):
        for panel, feature, title in zip(axes[0], FEATURES, _FEATURE_TITLES, strict=True):
            panel.set_title(title)
            top = max(getattr(row, feature) for row in lines) or 1.0
            for place, row in zip(places, lines, strict=True):
                look, value = looks[row.entry], getattr(row, feature)
                panel.hlines(place, 0.0, value, color=look.colour, linewidth=2.0, alpha=0.55)
                panel.plot(value, place, look.marker, color=look.colour, markersize=5.5)
                write_beside(panel, value, place, f"{value:.1f}", 5, 7.5)
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
        caption="AST features of validation-selected policies (policy.py and the local modules it reaches),"
        " mean over each demand group's environments.",
        alt=f"Dot plots of five code features for {len(lines)} rows of agents and demand groups.",
        data=rows(lines),
        figure=figure,
    )


def tokens(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Three panels on a log scale: a run's non-cached input, cache and output; dots are environments, bars the mean."""
    counted = [row for row in study.tokens if row.n_runs]
    if not counted:
        return None
    entries = sorted({row.entry for row in counted}, key=by_name)
    kinds = {"input_noncached": "Non-cached input", "cache": "Cache read + creation", "output": "Output"}
    size = 2.0 + 2.3 * len(kinds), 1.1 + 0.34 * len(entries)
    with new_figure(*size, names=entries, ncols=len(kinds), sharey=True) as (figure, axes):
        for panel, (key, title) in zip(axes[0], kinds.items(), strict=True):
            panel.set_title(title)
            for place, entry in enumerate(entries):
                colour = looks[entry].colour
                millions = [getattr(row, key) for row in counted if row.entry == entry]
                values = [each for each in millions if each and each > 0]
                dots = [place] * len(values)
                panel.plot(values, dots, looks[entry].marker, color=colour, markersize=4, alpha=0.5)
                if values:
                    panel.vlines(fmean(values), place - 0.3, place + 0.3, color=colour, linewidth=2.2)
            panel.set_xscale("log")
            low, high = panel.get_xlim()
            is_short = not 0.0 < low < high or math.log10(high / low) < 2.2
            panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if is_short else (1.0,)))
            panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            panel.xaxis.set_minor_formatter(NullFormatter())
        figure.supxlabel("Tokens of a run (millions, log scale)", fontsize=9)
    return Plot(
        name="tokens",
        title="Tokens",
        caption="Tokens of a run by environment (symbols) and their mean (bars). Diagnostic: no part of a"
        " score. Agents without token counts are absent.",
        alt=f"Token use of {len(entries)} agents in three kinds.",
        data=rows(counted),
        figure=figure,
    )


def wall_time(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Stacked bars, one per agent: mean wall time of a run by phase."""
    means, entries = study.phases, list(study.phases)
    if not any(value for phases in means.values() for value in phases.values()):
        return None
    with new_figure(7.2, 1.2 + 0.34 * len(entries), names=entries) as (figure, axes):
        panel = axes[0][0]
        ends = [0.0] * len(entries)
        for phase, (colour, hatch) in zip(PHASES, _PHASE_LOOKS, strict=True):
            widths = [means[entry][phase] / 60.0 for entry in entries]
            panel.barh(
                range(len(entries)), widths, left=ends, height=0.6, color=colour, hatch=hatch,
                label=phase.removesuffix("_s"), edgecolor=INK, linewidth=0.4,
            )  # fmt: skip
            ends = [a + b for a, b in zip(ends, widths, strict=True)]
        panel.set_xlabel("Mean wall time of a run (minutes)")
        figure.legend(loc="outside upper center", ncols=len(PHASES))
    return Plot(
        name="wall_time",
        title="Wall time by phase",
        caption="Mean wall time of a run: the agent alone, waiting for a slot, train episodes, feedback, and"
        " hidden evaluation.",
        alt=f"Stacked bars of wall time for {len(entries)} agents.",
        data=means,
        figure=figure,
    )
