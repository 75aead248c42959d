"""The smallest gap that an experiment resolves at 95 %, and the number of repeats that a given gap would need."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from statistics import fmean, median
from typing import Literal

import msgspec

from evopolicy_results.scoring.normalised import Scale
from evopolicy_results.statistics.pairs import Pair
from evopolicy_results.statistics.repeats import Spread, repeats_needed, spread_of
from evopolicy_results.statistics.samples import Sample, matched

GAPS = (0.05, 0.1, 0.2)
"""Gaps on the random-to-best scale for which a report gives the repeats."""


class Resolution(msgspec.Struct, frozen=True, kw_only=True):
    """The gap that one environment can resolve between agents."""

    env: str
    gap: float | None
    """Half width of the 95 % intervals of the differences, median over the pairs of agents, in returns."""
    scale: float | None
    """Best agent's mean minus the random reference's, in returns; None without such a scale."""
    n_cases: int
    n_runs: tuple[int, int]
    """Fewest and most runs of an agent."""
    spread: Spread | None
    """None unless every agent has two or more runs on the same cases: one run does not show how runs vary."""

    @property
    def normalised_gap(self) -> float | None:
        """`gap` as a share of the scale."""
        return None if self.gap is None or self.scale is None else self.gap / self.scale

    def repeats(self, share: float) -> int | Literal["more cases"] | None:
        """Runs per agent that resolve a gap of `share` of the scale, or that no number does; None if unknown."""
        if self.spread is None or self.scale is None:
            return None
        return repeats_needed(self.spread, share * self.scale) or "more cases"


def resolutions(
    samples: Mapping[tuple[str, str], Sample],
    compared: Sequence[Pair],
    agents: Sequence[str],
    scales: Mapping[str, Scale],
    environments: Sequence[str],
) -> list[Resolution]:
    """One for each environment that two or more agents have played."""
    out: list[Resolution] = []
    for env in environments:
        here = [samples[agent, env] for agent in agents if (agent, env) in samples]
        own = [pair for pair in compared if pair.env == env and {pair.first, pair.second} <= set(agents)]
        if len(here) < 2:
            continue
        halves = [
            0.5 * (pair.gap.high - pair.gap.low)
            for pair in own
            if pair.gap is not None and pair.gap.low is not None and pair.gap.high is not None
        ]
        scale = scales.get(env)
        out.append(
            Resolution(
                env=env,
                gap=median(halves) if halves else None,
                scale=None if scale is None else scale.best - scale.random,
                n_cases=max((pair.n_cases for pair in own), default=0),
                n_runs=(min(len(s.runs) for s in here), max(len(s.runs) for s in here)),
                spread=_spread(here),
            )
        )
    return out


def overall(resolved: Sequence[Resolution]) -> Resolution | None:
    """Resolution of the mean of normalised scores over environments, on which the scale is 1; None unless each
    environment has a scale and a gap. Environments are fixed: the suite is not a sample."""
    gaps = [one.normalised_gap for one in resolved]
    known = [gap for gap in gaps if gap is not None]
    if not known or len(known) < len(gaps):
        return None
    n = len(resolved)
    spreads = [
        (one.spread, one.scale**2) for one in resolved if one.spread is not None and one.scale is not None
    ]
    spread = Spread(
        run=sum(one.run / square for one, square in spreads) / n**2,
        case=sum(one.case / square for one, square in spreads) / n**2,
        n_cases=sum(one.n_cases for one, _ in spreads),
    )
    return Resolution(
        env="",
        gap=math.sqrt(sum(gap**2 for gap in known)) / n,
        scale=1.0,
        n_cases=sum(one.n_cases for one in resolved),
        n_runs=(min(one.n_runs[0] for one in resolved), max(one.n_runs[1] for one in resolved)),
        spread=spread if len(spreads) == n else None,
    )


def _spread(samples: Sequence[Sample]) -> Spread | None:
    common = matched(samples)
    if common is None or any(len(matrix) < 2 for matrix in common.returns):
        return None
    spreads = [spread_of(one, other) for one, other in itertools.combinations(common.returns, 2)]
    return Spread(
        run=fmean(one.run for one in spreads),
        case=fmean(one.case for one in spreads),
        n_cases=common.returns[0].shape[1],
    )
