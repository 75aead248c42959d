"""Draws `docs/images/score.svg` from a finished run: `python docs/_site/score.py RUN docs/images/score.svg`."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot

from evopolicy_common.records.run_record import decode_run_record
from evopolicy_common.statistics import intervals


def draw(run: Path, out: Path) -> None:
    """Left: the mean of each submit on validation cases. Right: the held-out returns of the selected one, and of random
    actions."""
    outcome = decode_run_record((run / "run.json").read_bytes()).outcome
    assert outcome.random_reference is not None
    assert outcome.heldout_returns is not None
    assert outcome.val_scores is not None
    matplotlib.rcParams |= {"svg.hashsalt": "score", "font.size": 9}
    matplotlib.rcParams |= dict.fromkeys(("axes.spines.top", "axes.spines.right"), False)
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(8, 3), width_ratios=(3, 2), layout="constrained")
    submits = sorted(map(int, outcome.val_scores))
    means = [outcome.val_scores[str(each)] for each in submits]
    best = submits.index(int(outcome.best_submit_index or 0))
    left.plot(submits, means, "o", color="0.5")
    left.plot(submits[best], means[best], "o", color="#b3541e", markersize=9)
    left.annotate(
        "selected", (submits[best], means[best]), (-18, -24), textcoords="offset points", color="#b3541e"
    )
    left.set(title="1  Mean on hidden validation cases", xlabel="submit", ylabel="return", xticks=submits)
    rows = {"random": outcome.random_reference.returns, "selected": outcome.heldout_returns}
    for place, returns in enumerate(rows.values()):
        values = np.array(returns, float)
        mean = intervals.over_cases(values)
        right.plot(np.full(len(values), place), values, "_", color="0.6", markersize=14)
        ends = [[mean.value - mean.low], [mean.high - mean.value]]
        right.errorbar(place + 0.25, mean.value, ends, fmt="o", color="#b3541e", capsize=3)
        right.annotate(f"{mean.value:.1f}", (place + 0.32, mean.value), va="center", color="#b3541e")
    right.set(title="2  Returns on hidden held-out cases", xlim=(-0.4, 1.8))
    right.set(xticks=range(len(rows)), xticklabels=rows)
    figure.savefig(out, metadata={"Date": None})


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
