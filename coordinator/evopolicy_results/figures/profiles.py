"""Performance profiles: the share of an agent's runs above each normalised score."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib

from evopolicy_results.figures.plot import Plot
from evopolicy_results.figures.style import RC, new_figure
from evopolicy_results.reading.records import rows
from evopolicy_results.statistics.aggregates import TAUS
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study, Suite


def performance_profiles(suite: Suite, study: Study, looks: Mapping[str, Look]) -> Plot | None:
    """One curve per agent, with its pointwise 95 % band."""
    found = suite.statistics.aggregates
    if not found:
        return None
    figure, axes = new_figure(6.4, 3.4)
    with matplotlib.rc_context(RC):
        panel = axes[0][0]
        for one in found:
            look = looks[one.entry]
            panel.plot(
                TAUS, [share.value for share in one.profile], color=look.colour, linestyle=look.dash, marker=look.marker,  # noqa: E501
                markersize=3.2, markevery=4, label=one.entry,
            )  # fmt: skip
            bounds = [
                (
                    (share.low, share.high)
                    if share.low is not None and share.high is not None
                    else (share.value, share.value)
                )
                for share in one.profile
            ]
            low, high = zip(*bounds, strict=True)
            panel.fill_between(TAUS, low, high, color=look.colour, alpha=0.13, linewidth=0)
        panel.set_xlim(0.0, 1.0)
        panel.set_ylim(-0.02, 1.02)
        panel.set_xlabel("Normalised held-out score (0 = random, 1 = best agent's mean)")
        panel.set_ylabel("Share of runs above it")
        figure.legend(loc="outside upper center", ncols=min(4, len(found)))
    return Plot(
        name=f"profiles_{suite.name}",
        title=f"{suite.title} performance profiles",
        caption=(
            "Share of an agent's runs whose normalised score is above each value, over all environments with a scale;"
            " higher is better. Bands: pointwise 95 % intervals of a stratified bootstrap over runs and their cases, or"
            " over the cases of single runs; none where resamples show no spread."
        ),
        alt=f"Performance profiles of {len(found)} agents.",
        data=rows(found),
        figure=figure,
        group="statistics",
    )
