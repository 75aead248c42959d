"""Figures of how policies evolved: hit rates by edit type, edit size against improvement."""

from __future__ import annotations

import math
from collections.abc import Mapping

import matplotlib
from matplotlib.lines import Line2D

from evopolicy_results.behaviour.edits import EditRates
from evopolicy_results.behaviour.structure import BINS, DATA_ONLY, UNCHANGED
from evopolicy_results.figures.plot import MUTED, Plot
from evopolicy_results.figures.style import RC, new_figure
from evopolicy_results.reading.records import rows
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a proportion; n > 0. Source: E. B. Wilson, JASA 22 (1927)."""
    z = 1.959964
    share = hits / n
    centre = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, centre - half), min(1.0, centre + half)


def hit_rates(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Hit rates of synthesis and parametric edits by demand group, one panel each, with Wilson intervals and counts."""
    groups = [g for g in ("synthesis", "tuning") if any(row.demand == g for row in study.edit_rates)] or [
        "all"
    ]
    table = {(row.entry, row.demand): row for row in study.edit_rates}
    entries = sorted({entry for entry, _ in table}, key=str.casefold)
    if not any(row.n_synthesis + row.n_parametric for row in study.edit_rates):
        return None
    panels = [(group, edit) for group in groups for edit in ("synthesis", "parametric")]
    figure, axes = new_figure(
        1.8 + 2.0 * len(panels), 1.15 + 0.34 * len(entries), ncols=len(panels), sharey=True, sharex=True
    )
    with matplotlib.rc_context(RC):
        for panel, (group, edit) in zip(axes[0], panels, strict=True):
            environments = "All environments" if group == "all" else f"{group.capitalize()} tasks"
            panel.set_title(f"{environments}:\n{edit} edits")
            for place, entry in enumerate(entries):
                _hit_row(panel, place, table.get((entry, group)), edit, looks[entry])
            panel.set_xlim(0.0, 1.0)
            panel.set_xticks([0.0, 0.5, 1.0], ["0", "50", "100"])
            panel.grid(axis="y", visible=False)
        axes[0][0].set_yticks(range(len(entries)), entries)
        axes[0][0].set_ylim(len(entries) - 0.5, -0.5)
        figure.supxlabel("Edits that raise the validation best (%)", fontsize=9)
    return Plot(
        name="edit_hits",
        title="Which edits help",
        caption=(
            "Share of edits that raise the best validation mean so far, with Wilson's 95 % interval and the number of"
            " edits. Rollbacks, retests and first submits are in neither."
        ),
        alt=f"Hit rates of synthesis and parametric edits for {len(entries)} agents.",
        data=rows(study.edit_rates),
        figure=figure,
        group="edits",
    )


def _hit_row(panel: matplotlib.axes.Axes, place: int, row: EditRates | None, edit: str, look: Look) -> None:
    n = getattr(row, f"n_{edit}") if row is not None else 0
    if not n:
        panel.annotate("none", (0.02, place), va="center", fontsize=8, color=MUTED)
        return
    hits = getattr(row, f"hits_{edit}")
    low, high = wilson(hits, n)
    panel.hlines(place, low, high, color=look.colour, linewidth=1.8, alpha=0.6)
    panel.plot(hits / n, place, look.marker, color=look.colour, markersize=6.5, clip_on=False)
    panel.annotate(f"n = {n}", (1.0, place - 0.3), ha="right", va="center", fontsize=7, color=MUTED)


def edit_size(study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """Two panels: probability that the visible mean, or the validation best, improves, by edit size."""
    if not any(row.n for row in study.edit_sizes):
        return None
    entries = list(dict.fromkeys(row.entry for row in study.edit_sizes))
    figure, axes = new_figure(9.2, 3.2, ncols=2, sharey=True)
    largest = max(row.n for row in study.edit_sizes)
    has_data = any(row.n for row in study.edit_sizes if row.label == DATA_ONLY)
    labels = [label for label in BINS if label != DATA_ONLY or has_data]
    with matplotlib.rc_context(RC):
        for panel, (key, count, title) in zip(
            axes[0],
            (("p_visible", "n_visible", "Visible train mean"), ("p_validation", "n", "Validation best")),
            strict=True,
        ):
            panel.set_title(title)
            for i, entry in enumerate(entries):
                look = looks[entry]
                shift = (i - (len(entries) - 1) / 2) * min(0.12, 0.5 / max(1, len(entries)))
                own = {row.label: row for row in study.edit_sizes if row.entry == entry}
                points = [
                    (place + shift, getattr(own[label], key), getattr(own[label], count))
                    for place, label in enumerate(labels)
                    if label in own and getattr(own[label], key) is not None
                ]
                sizes = [
                    point for point in points if labels[round(point[0] - shift)] not in (UNCHANGED, DATA_ONLY)
                ]
                panel.plot(
                    [x for x, _, _ in sizes], [y for _, y, _ in sizes],
                    color=look.colour, linestyle=look.dash, linewidth=1.1, alpha=0.6,
                )  # fmt: skip
                panel.scatter(
                    [x for x, _, _ in points], [y for _, y, _ in points],
                    s=[14 + 130 * n / largest for _, _, n in points],
                    color=look.colour, marker=look.marker, alpha=0.8, linewidths=0,
                )  # fmt: skip
            panel.set_xlim(-0.6, len(labels) - 0.4)
            panel.set_xticks(range(len(labels)), [label.replace(" ", "\n") for label in labels])
            panel.set_ylim(-0.04, 1.04)
            panel.set_yticks([0.0, 0.25, 0.5, 0.75, 1.0], ["0", "25", "50", "75", "100"])
        axes[0][0].set_ylabel("Transitions that improve (%)")
        figure.supxlabel("Lines added and removed in the policy's source bundle", fontsize=9)
        handles = [
            Line2D([], [], color=looks[e].colour, marker=looks[e].marker, linestyle=looks[e].dash, label=e)
            for e in entries
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=min(5, len(handles)))
    return Plot(
        name="edit_size",
        title="Edit size and improvement",
        caption=(
            "Transitions between adjacent score-bearing submits by size of the edit; a mark's area grows with their"
            " number. An unchanged policy cannot raise the validation best; its visible mean can change, as it may play"
            " other cases. Data only: files outside the source bundle changed, such as weights."
        ),
        alt=f"Probability of improvement over {len(labels)} edit sizes for {len(entries)} agents.",
        data=rows(study.edit_sizes),
        figure=figure,
        group="edits",
    )
